"""Find the bottleneck of the service, in one sentence, and what to do about it. Pure: it follows from shares of time.

    consumers wait     as they report: time in which they needed a batch and had none
    workers wait       time in which they held no lease
    workers queue      time in which they could have worked and got no core
    workers work       decoding, simulating, delivering: each result says how long
    the broker works   time in which its loop did not wait for a message

If consumers hardly wait, they are the bottleneck. Otherwise the first of these that holds decides: the broker has no
idle time (the broker); workers have idle time (the network); else the activity that takes most of the workers' time.

Totals are noted once a second; shares and rates are their differences over the last seconds.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.session import AWAY_SECONDS
from v2v_server.system.status_fields import gauge, states, text, values

WINDOW_SECONDS = 10.0
NOTE_SECONDS = 1.0
_LEAST_PRESENT_SECONDS = 1.0
"""Shortest time that the rates of a new consumer are measured over."""


NOTICEABLE_SHARE = 0.1
"""Share of its time that a consumer may wait without being called stalled."""
_IDLE_SHARE = 0.3
"""Workers that are idle for a larger share of their time are not the bottleneck."""
_FULL_SHARE = 0.85
"""A broker that is busy for a larger share of its time is the bottleneck."""
_LEAST_SECONDS = 2.0
"""Shortest window that allows a conclusion."""
_QUEUED_SHARE = 0.4
"""If workers wait for a core for a larger share of their time, their host has too few cores."""
_SPARE_SHARE = 0.5
"""If workers are idle for a larger share of their time, fewer of them would do."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The totals at one time.

    Attributes:
        now: monotonic time, seconds.
        totals: the counters; and, of the time in which there was a consumer, ``attended``, ``broker`` (the loop did not
            wait for a message), ``worker`` and ``consumer`` (times their number), ``idle`` (of ``worker``, without a
            lease), in seconds.
        peers: totals of each peer, the first of them a clock: ``now`` for a worker, the seconds that it was there for a
            consumer. Then busy and processor seconds of a worker, by routing id, or samples, seconds waited and indices
            passed of a consumer, by number.
    """

    now: float
    totals: Mapping[str, float]
    peers: Mapping[bytes | int, tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """The time between two moments."""

    before: Moment
    last: Moment

    @property
    def seconds(self) -> float:
        """Return the length of the window, seconds."""
        return self.last.now - self.before.now

    def change(self, name: str) -> float:
        """Return by how much a total grew."""
        return self.last.totals.get(name, 0.0) - self.before.totals.get(name, 0.0)

    def rate(self, name: str) -> float:
        """Return the same per second; 0 for an empty window."""
        return self.change(name) / self.seconds if self.seconds > 0.0 else 0.0

    def share(self, part: str, whole: str) -> float:
        """Return the growth of one total as a share of another's, 0 to 1."""
        return min(1.0, max(0.0, self.change(part) / self.change(whole))) if self.change(whole) > 0.0 else 0.0

    def rates_of(self, peer: bytes | int) -> list[float]:
        """Return the rates of a peer's totals: a worker's over the window, a consumer's over its time in the window."""
        present, *totals = self.last.peers[peer]
        before_present, *before = self.before.peers.get(peer, (0.0,) * (1 + len(totals)))
        seconds = min(self.seconds, max(_LEAST_PRESENT_SECONDS, present - before_present))
        return [(now - then) / seconds if seconds > 0.0 else 0.0 for now, then in zip(totals, before, strict=True)]


class History:
    """The last ten seconds of a dispatcher.

    Args:
        dispatcher: whose totals are noted.
        now: monotonic time, seconds.
    """

    def __init__(self, dispatcher: Dispatcher, now: float) -> None:
        self._dispatcher = dispatcher
        self._moments: deque[Moment] = deque()
        self._noted = self._note_at = now
        self._clocks: defaultdict[str, float] = defaultdict(float)
        self._broker_seconds = 0.0
        self._attended_at = -math.inf

    def note(self, now: float, broker_seconds: float) -> None:
        """Note the time that passed. Call a few times a second.

        Args:
            now: monotonic time, seconds.
            broker_seconds: time since the start in which the loop did not wait for a message.
        """
        passed, self._noted = max(0.0, now - self._noted), now
        busy, self._broker_seconds = broker_seconds - self._broker_seconds, broker_seconds
        if consumers := self._dispatcher.consumers:
            # Idle workers matter only while there is a consumer.
            self._attended_at = now
            worker = passed * self._dispatcher.workers
            idle = worker * self._dispatcher.idle_share
            clocks = {
                "attended": passed,
                "broker": busy,
                "worker": worker,
                "idle": idle,
                "consumer": passed * consumers,
            }
            for name, seconds in clocks.items():
                self._clocks[name] += seconds
        if now >= self._note_at:
            self._note_at = now + NOTE_SECONDS
            self._moments.append(self._moment(now))
            while len(self._moments) > 2 and now - self._moments[1].now >= WINDOW_SECONDS:
                self._moments.popleft()

    def is_attended(self, now: float) -> bool:
        """Return whether there is a consumer, or was a moment ago: between epochs they leave and return."""
        return now - self._attended_at < AWAY_SECONDS or self._dispatcher.consumers > 0

    def window(self, now: float) -> TimeWindow:
        """Return the last ten seconds, or the time since the start."""
        last = self._moment(now)
        return TimeWindow(self._moments[0] if self._moments else last, last)

    def _moment(self, now: float) -> Moment:
        peers: dict[bytes | int, tuple[float, ...]] = {
            identity: (now, member.work.busy_seconds, member.work.cpu_seconds)
            for identity, member in self._dispatcher.registry.members.items()
        }
        for each in self._dispatcher.sessions.totals():
            peers[each.number] = each.present(now), each.served, each.waited_seconds, each.passed
        return Moment(now, values(self._dispatcher.counters) | self._clocks, peers)


def _share(help: str, part: str, words: str) -> Any:
    return gauge(help, "time_ratio", unit="0 to 1", part=part, words=words, default=0.0)


@dataclass(frozen=True, slots=True)
class Shares:
    """Shares of the last ten seconds in which there was a consumer."""

    seconds: float = gauge("Seconds of the last ten in which there was a consumer.", unit="s", default=0.0)
    consumers: float = _share(
        "Share of the consumers' time in which they waited for batches.", "consumers", "consumers wait"
    )
    idle: float = _share("Share of the workers' time in which they held no lease.", "idle", "workers idle")
    broker: float = _share(
        "Share of the time in which the server's loop did not wait for a message.", "broker", "server's loop busy"
    )
    decode: float = _share("Share of the workers' time that decoding took.", "decode", "workers decode")
    simulate: float = _share("Share of the workers' time that simulating took.", "simulate", "workers simulate")
    handover: float = _share("Share of the workers' time that delivering took.", "handover", "workers deliver")
    queued: float = _share(
        "Share of all workers' time in which those of this server waited for a core.",
        "queued",
        "workers wait for a core",
    )
    cores: float = gauge("Processor time of the workers by their time.", unit="cores", default=0.0)

    @classmethod
    def of(cls, window: TimeWindow) -> Shares:
        """Compute the shares of a window."""
        parts = {
            name: window.share(f"{total}_seconds", "worker")
            for name, total in (
                ("decode", "decode"),
                ("simulate", "simulate"),
                ("handover", "handover"),
                ("queued", "queued"),
                ("cores", "cpu"),
            )
        }
        return cls(
            seconds=window.change("attended"),
            consumers=window.share("waited_seconds", "consumer"),
            idle=window.share("idle", "worker"),
            broker=window.share("broker", "attended"),
            **parts,
        )


@dataclass(frozen=True, slots=True)
class Bottleneck:
    """The bottleneck of the service."""

    part: str = states(
        "1 for the part that is the bottleneck.",
        "slow_part",
        "no_consumers",  # none is connected
        "start",  # too early to say
        "workers",  # none can make a sample
        "consumers",
        "cores",  # the workers' host has too few
        "decode",
        "simulate",
        "handover",
        "broker",
        "transit",  # requests and samples take long to arrive
        "even",  # no notable waiting
    )
    sentence: str = text("What waits for what.")
    remedy: str = text("What to do about it; empty if nothing is needed.", default="")


def find_bottleneck(
    shares: Shares,
    *,
    is_attended: bool,
    workers: int,
    starting: int = 0,
    trouble: str = "",
    has_cache: bool = False,
) -> Bottleneck:
    """Find the bottleneck.

    Args:
        shares: shares of the last seconds.
        is_attended: whether there are consumers.
        workers: number of connected workers.
        starting: number of the server's own worker processes that are not connected yet.
        trouble: why no worker can make a sample; empty if one can.
        has_cache: whether the server's workers cache decoded clips.
    """
    if not is_attended:
        return Bottleneck("no_consumers", "No consumer is connected.")
    if trouble:
        if starting and not workers:
            return Bottleneck("workers", f"Consumers wait for workers: {starting} are starting.")
        return Bottleneck("workers", f"Consumers wait for workers: {trouble}.")
    if shares.seconds < _LEAST_SECONDS:
        return Bottleneck("start", "It is too early to say what is slow: samples have just begun to flow.")
    wait = f"{shares.consumers:.0%}"
    if shares.consumers < NOTICEABLE_SHARE:
        if shares.idle < _IDLE_SHARE:
            return Bottleneck(
                "even", f"Hardly any waiting: consumers {wait} of their time, workers {shares.idle:.0%}.", ""
            )
        spare = "fewer workers would do" if shares.idle >= _SPARE_SHARE else ""
        return Bottleneck(
            "consumers",
            f"Workers wait for consumers, which use samples as fast as they can (they wait {wait} of their time); "
            f"workers are idle {shares.idle:.0%} of theirs.",
            spare,
        )
    if shares.broker >= _FULL_SHARE:
        return Bottleneck(
            "broker",
            f"Consumers wait {wait} of their time for the server's own loop, which is busy {shares.broker:.0%} of its "
            "time.",
            "give its host a free core, let consumers on this host use shared memory, or split the consumers between "
            "two servers",
        )
    if shares.idle >= _IDLE_SHARE:
        return Bottleneck(
            "transit",
            f"Consumers wait {wait} of their time although workers are idle {shares.idle:.0%} of theirs: samples take "
            "long to arrive, or too few are requested ahead.",
            "check the network between them; raise --max-credit-bytes or --expect-workers so that more samples are "
            "requested ahead",
        )
    if shares.queued >= _QUEUED_SHARE:
        return Bottleneck(
            "cores",
            f"The workers' host is overloaded: consumers wait {wait} of their time for workers, which wait "
            f"{shares.queued:.0%} of theirs for a core and get {shares.cores:.2f} of a core each.",
            "stop other programs there, or start v2v-worker on other hosts; more workers on this host would not help",
        )
    part = max(("decode", "simulate", "handover"), key=lambda name: getattr(shares, name))
    activity, remedy = {
        "decode": (
            "decode",
            "start more workers (--workers, v2v-worker on other hosts)"
            + ("" if has_cache else ", cache decoded clips (--cache)")
            + ", prepare the videos once (v2v-prepare), or take more samples of each clip (samples_per_decode)",
        ),
        "simulate": (
            "simulate",
            "start more workers (--workers, v2v-worker on other hosts), or ask for less: a smaller crop, fewer "
            "voxels_per_clip, fewer effects, no flow",
        ),
        "handover": (
            "deliver samples",
            "run consumers on the workers' host, where samples are in shared memory, or use a faster network",
        ),
    }[part]
    sentence = (
        f"Consumers wait {wait} of their time for workers, which {activity} {getattr(shares, part):.0%} of theirs."
    )
    return Bottleneck(part, sentence, remedy)
