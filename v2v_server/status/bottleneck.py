"""Who waits for whom, in one sentence, and what to do about it. Pure: computed from shares of time, nothing guessed.

    consumers wait     they say so themselves: time in which they stood still for want of a batch
    workers wait       time in which they held nothing to make
    workers queue      time in which they could have worked and got no core
    workers work       decoding, simulating, handing over: each result says how long
    the broker works   time in which its loop did not wait for a message

Where consumers hardly wait, they are the slow part themselves. Where they do, it is for workers that have no time left,
and then for what takes most of it; or for the broker, if that has no time left; or else for what is on its way.
"""

from __future__ import annotations

from dataclasses import dataclass

from v2v_server.status.history import Moment

NOTICEABLE_SHARE = 0.1
"""Of its time that a consumer may wait without a word about it."""
_IDLE_SHARE = 0.3
"""Of the workers' time: with more to spare they are not what consumers wait for."""
_FULL_SHARE = 0.85
"""Of the broker's time: with so little to spare it is."""
_LEAST_SECONDS = 2.0
"""Of a window that says anything."""
_QUEUED_SHARE = 0.4
"""Of the workers' time, in which they wait for a core: with more, the host has more to do than cores for it."""
_SPARE_SHARE = 0.5
"""Of the workers' time, in which they are idle, for fewer of them to do."""


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of the time in which there was a consumer, each 0 to 1.

    Attributes:
        seconds: of that time, within the last ten.
        consumers: of all consumers' time, in which they waited for batches.
        idle: of all workers' time, in which they held nothing to make.
        broker: of the server's loop, in which it did not wait for a message.
        decode, simulate, handover: of all workers' time.
        queued: of all workers' time, in which those of this server waited for a core.
        cores: processor time of all workers by their time, which is cores for each.
    """

    seconds: float = 0.0
    consumers: float = 0.0
    idle: float = 0.0
    broker: float = 0.0
    decode: float = 0.0
    simulate: float = 0.0
    handover: float = 0.0
    queued: float = 0.0
    cores: float = 0.0

    @classmethod
    def of(cls, before: Moment, last: Moment) -> Shares:
        """Those of the time between two moments."""
        attended = last.attended_seconds - before.attended_seconds
        workers = last.worker_seconds - before.worker_seconds
        return cls(
            seconds=attended,
            consumers=_share(
                last.waited_seconds - before.waited_seconds, last.consumer_seconds - before.consumer_seconds
            ),
            idle=_share(last.idle_seconds - before.idle_seconds, workers),
            broker=_share(last.broker_seconds - before.broker_seconds, attended),
            decode=_share(last.decode_seconds - before.decode_seconds, workers),
            simulate=_share(last.simulate_seconds - before.simulate_seconds, workers),
            handover=_share(last.handover_seconds - before.handover_seconds, workers),
            queued=_share(last.queued_seconds - before.queued_seconds, workers),
            cores=_share(last.cpu_seconds - before.cpu_seconds, workers),
        )


@dataclass(frozen=True, slots=True)
class Waiting:
    """The verdict.

    Attributes:
        part: the slow one: "nobody" (no consumer is connected), "start" (too early to say), "workers" (none can
            work), "consumers", "cores" (the workers' host has too few of them), "decode", "simulate", "handover",
            "broker", "way" (requests and samples are on their way for long), "even" (no wait to speak of).
        sentence: who waits for whom.
        remedy: what to do about it; empty where nothing need be done.
        shares: that it follows from.
    """

    part: str
    sentence: str
    remedy: str
    shares: Shares


def find_bottleneck(
    shares: Shares,
    *,
    is_attended: bool,
    workers: int,
    starting: int = 0,
    trouble: str = "",
    has_cache: bool = False,
) -> Waiting:
    """The slow part of the service.

    Args:
        shares: of the last seconds.
        is_attended: whether there are consumers.
        workers: that have said hello.
        starting: processes of the server's own that have not said hello yet.
        trouble: why no worker can make a sample; empty where one can.
        has_cache: whether the server's workers keep what was decoded.
    """
    part, sentence, remedy = _verdict(shares, is_attended, workers, starting, trouble, has_cache)
    return Waiting(part, sentence, remedy, shares)


def _verdict(
    shares: Shares, is_attended: bool, workers: int, starting: int, trouble: str, has_cache: bool
) -> tuple[str, str, str]:
    if not is_attended:
        return "nobody", "Nobody is connected: the service waits for consumers.", ""
    if trouble:
        if starting and not workers:
            return "workers", f"Consumers wait for workers: {starting} are starting.", ""
        return "workers", f"Consumers wait for workers: {trouble}.", ""
    if shares.seconds < _LEAST_SECONDS:
        return "start", "It is too early to say who waits: samples have just begun to flow.", ""
    wait = f"{shares.consumers:.0%}"
    if shares.consumers < NOTICEABLE_SHARE:
        if shares.idle < _IDLE_SHARE:
            return "even", f"Nobody waits to speak of: consumers {wait} of their time, workers {shares.idle:.0%}.", ""
        spare = "fewer workers would do" if shares.idle >= _SPARE_SHARE else ""
        return (
            "consumers",
            f"Workers wait for consumers: these take samples as fast as they can use them (they wait {wait} of their "
            f"time), and workers are idle {shares.idle:.0%} of theirs.",
            spare,
        )
    if shares.broker >= _FULL_SHARE:
        return (
            "broker",
            f"Consumers wait {wait} of their time for the server's own loop, which is busy {shares.broker:.0%} of its.",
            "give its host a free core, let consumers on this host use shared memory, or split the consumers between "
            "two servers",
        )
    if shares.idle >= _IDLE_SHARE:
        return (
            "way",
            f"Consumers wait {wait} of their time although workers are idle {shares.idle:.0%} of theirs: samples are "
            "on their way for long, or too few are asked ahead.",
            "look at the network between them, and raise --max-credit-bytes or --expect-workers so that more is asked "
            "ahead",
        )
    if shares.queued >= _QUEUED_SHARE:
        return (
            "cores",
            f"The workers' host is overloaded: consumers wait {wait} of their time for workers, which wait "
            f"{shares.queued:.0%} of theirs for a core and get {shares.cores:.2f} of a core each.",
            "more workers on this host would not help: stop other programs there, or start v2v-worker on other hosts",
        )
    part = max(("decode", "simulate", "handover"), key=lambda name: getattr(shares, name))
    doing, remedy = {
        "decode": (
            "decode",
            "start more workers (--workers, v2v-worker on other hosts)"
            + ("" if has_cache else ", keep what is decoded (--cache)")
            + ", prepare the videos once (v2v-prepare), or take more samples of each clip (samples_per_decode)",
        ),
        "simulate": (
            "simulate",
            "start more workers (--workers, v2v-worker on other hosts), or ask for less: a smaller crop, fewer "
            "voxels_per_clip, fewer effects, no flow",
        ),
        "handover": (
            "hand over",
            "run consumers on the workers' host, where samples lie in shared memory, or give the network more room",
        ),
    }[part]
    share = {"decode": shares.decode, "simulate": shares.simulate, "handover": shares.handover}[part]
    return part, f"Consumers wait {wait} of their time for workers, which {doing} {share:.0%} of theirs.", remedy


def _share(part: float, whole: float) -> float:
    return min(1.0, max(0.0, part / whole)) if whole > 0.0 else 0.0
