"""The status of a server: its fields, its bottleneck, how it is built, and who gets it.

Every number has one owner (counters, sessions, workers, leases, the history) and is read there. :data:`PARTS` says
where each field is in JSON; all views walk the fields. A field may be added at any time. Raise :data:`STATUS_VERSION`
if you change or remove one.

Building a status costs a few microseconds for each worker and consumer, of which the first :data:`MOST_SHOWN` are
listed. It is built at most a few times a second, whatever the number of clients and requests, and all of them get the
same bytes. So every request is answered: a client has one at a time, and connections are limited.

The bottleneck follows from shares of time, the differences of totals over the last seconds:

    consumers wait     as they report: time in which they needed a batch and had none
    workers wait       time in which they held no lease
    workers queue      time in which they could have worked and got no core
    workers work       decoding, simulating, delivering: each result says how long
    the broker works   time in which its loop did not wait for a message

If consumers hardly wait, they are the bottleneck. Otherwise the first of these that holds decides: the broker has no
idle time (the broker); workers have idle time (the network); else the activity that takes most of the workers' time.
"""

from __future__ import annotations

import json
import math
import platform
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from v2v_protocol import PROTOCOL_VERSION, __version__
from v2v_protocol.link.router import Sockets
from v2v_protocol.messages import LARGEST_HEADER_BYTES, Status, encode
from v2v_server.broker.leases import Member, clean_name
from v2v_server.broker.session import AWAY_SECONDS, Session
from v2v_server.broker.state import Broker, Counters, FaultTotal, RefusalPart, SendStatus, ToConsumer, ToWorker
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue, CorpusPart
from v2v_server.quarantine import QuarantinePart, VerdictPart
from v2v_server.store.quota import CachePart, cache_part
from v2v_server.supervise.pool import Pool
from v2v_server.system.log import GIB, Meaning, counter, gauge, meanings, short, states, text, values

STATUS_VERSION = 1
StatusFields: TypeAlias = Mapping[str, Any]
"""A whole status as plain values, fit for JSON."""
ANSWER_SECONDS = 0.4
LARGEST_SHARE = 0.02
"""Share of the loop's time that building may take; with thousands of workers and consumers it happens less often."""
MOST_SHOWN = 1000
"""Largest number of workers listed, and of consumers; the others are only counted."""
_MOST_SPECS = 8
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
    """The last ten seconds of a broker.

    Args:
        broker: whose totals are noted.
        now: monotonic time, seconds.
    """

    def __init__(self, broker: Broker, now: float) -> None:
        self._broker = broker
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
        if consumers := self._broker.consumers:
            # Idle workers matter only while there is a consumer.
            self._attended_at = now
            worker = passed * self._broker.workers
            idle = worker * self._broker.idle_share
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
        return now - self._attended_at < AWAY_SECONDS or self._broker.consumers > 0

    def window(self, now: float) -> TimeWindow:
        """Return the last ten seconds, or the time since the start."""
        last = self._moment(now)
        return TimeWindow(self._moments[0] if self._moments else last, last)

    def _moment(self, now: float) -> Moment:
        peers: dict[bytes | int, tuple[float, ...]] = {
            identity: (now, member.work.busy_seconds, member.work.cpu_seconds)
            for identity, member in self._broker.registry.members.items()
        }
        for each in self._broker.sessions.totals():
            peers[each.number] = each.present(now), each.served, each.waited_seconds, each.passed
        return Moment(now, values(self._broker.counters) | self._clocks, peers)


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


@dataclass(frozen=True, slots=True)
class ServerPart:
    """The server."""

    version: int = text("Version of this form of the status.")
    time: str = text("Time of the status, ISO 8601, UTC.")
    program: str = text("Version of the program.")
    protocol: int = text("Version of the protocol.")
    host: str = text("Host of the server.")
    uptime_seconds: float = gauge("Time since the server was ready to accept consumers.", None, unit="s")
    is_ready: bool = gauge("Whether workers are connected, or none are to be started.", "ready")
    address: str = text("Where consumers connect.")
    worker_address: str = text("Where workers connect.")
    spec: Mapping[str, Any] = text("The complete default spec of consumers, with the recipe.")


@dataclass(frozen=True, slots=True)
class LoadPart:
    """What is requested, what is made, and by how many."""

    specs: Mapping[str, Mapping[str, Any]] = text("What consumers requested, by digest; the first few.")
    samples_per_second: float = gauge("Samples sent, over the last ten seconds.", unit="/s")
    batches_per_second: float = gauge("Batches sent, over the last ten seconds.", unit="/s")
    bytes_per_second: float = gauge("Bytes of arrays sent, over the last ten seconds.", unit="bytes/s")
    decodes_per_second: float = gauge("Clips decoded, over the last ten seconds.", unit="/s")
    shared_share: float = gauge(
        "Share of the samples sent over the last ten seconds that were made for another consumer already.",
        "shared_ratio",
        unit="0 to 1",
    )
    queue: int = gauge("Requested samples that are not leased to a worker.", "queued_samples")
    queued_share: float = gauge(
        "Share of connected consumers with requests that are not leased to a worker.", "waiting_share", unit="0 to 1"
    )
    worker_count: int = gauge("Workers that have said hello.")
    worker_processes: int = gauge("Worker processes that the server runs itself.", None)
    workers_wanted: Sequence[int] = text("Lowest and highest number of the server's own workers.")
    consumer_count: int = gauge("Consumers that are connected.")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerPart:
    """One worker."""

    name: str = text("Name that it gives itself.")
    host: str = text("Host that it names.")
    state: str = states(
        "Workers that have said hello.",
        "workers",
        "working",
        "idle",  # it holds no lease
        "resting",  # its host cannot read a video, see unreadable
        "lost",  # it hangs or is silent, and its process is being ended
    )
    clip: str = text("Catalogue id of the video in work; empty if it works on nothing that a consumer waits for.")
    frame: int | None = text("First frame of the clip in work.")
    clip_seconds: float = gauge("Time since it began the clip.", unit="s")
    leases: int = gauge("Leases that it holds.")
    samples: int = counter("Samples that the worker made.", is_routine=True)
    busy_share: float = gauge(
        "Share of the last ten seconds in which the worker made samples.", "busy_ratio", unit="0 to 1"
    )
    cpu_share: float = gauge("Processor time, over the last ten seconds.", unit="cores")
    memory_gib: float = gauge("Resident memory of the worker's process; 0: not known.", "memory_bytes", unit="GiB")
    silent_seconds: float = gauge("Time since it was last heard.", unit="s")
    restarts: int | None = gauge("Processes that ended in its place before; None: it is not the server's own.")
    unreadable: str = text("What its host could not read last; empty if it can read all.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsumerPart:
    """One consumer: a session."""

    id: str = text("Names the consumer until the server ends. It is not its routing id.")
    name: str = text('Name that it gives itself: "rank 0 of 2".')
    host: str = text("Host that it names.")
    state: str = states(
        "Consumers.",
        "consumers",
        "stalled",  # it waits for samples most of its time
        "taking",
        "idle",  # it has requested nothing
        "gone",  # its connection has ended; it may return for ten seconds
    )
    epoch: int = gauge("Epoch that the consumer is in.", None, merge=max)
    position: int = gauge("Index after the highest one of the epoch that was answered.")
    sequences: int = gauge("Sequences of one epoch, of all ranks together.")
    epoch_share: float = gauge(
        "Share of the epoch that the consumer has received.", "epoch_ratio", unit="0 to 1", merge=min
    )
    eta_seconds: float | None = gauge("Time until the end of the epoch at the rate of the last ten seconds.", unit="s")
    batch_size: int = gauge("Samples of one of its batches.")
    credit: int = gauge("Largest number of samples that the consumer may have outstanding.", "credit_samples")
    in_flight: int = gauge("Samples requested by the consumer and leased to workers.", "in_flight_samples")
    waiting: int = gauge("Samples requested by the consumer and not leased to a worker.", "queued_samples")
    served: int = counter("Samples sent to the consumer.", "samples", is_routine=True)
    samples_per_second: float = gauge("Samples sent to it, over the last ten seconds.", unit="/s")
    batches_per_second: float = gauge("Batches sent to it, over the last ten seconds.", unit="/s")
    waiting_share: float = gauge(
        "Share of the last ten seconds in which the consumer waited for batches.",
        "waiting_ratio",
        unit="0 to 1",
        merge=max,
    )
    waited_seconds: float = gauge("Time that it waited for batches, in all of its sessions.", unit="s")
    silent_seconds: float = gauge("Time since it was last heard.", unit="s")
    spec: str = text("Digest of the spec that it requested.")
    seed: int = text("Seed of its stream.")
    quarantine: int = text("Number of the quarantine snapshot that its samples are made under.")


PARTS: Mapping[str, tuple[type, ...]] = {
    "": (ServerPart, CorpusPart, LoadPart, QuarantinePart),
    "totals": (Counters, FaultTotal),
    "waiting": (Bottleneck,),
    "waiting.shares": (Shares,),
    "cache": (CachePart,),
    "workers": (WorkerPart,),
    "consumers": (ConsumerPart,),
    "refusals": (RefusalPart,),
    "verdicts": (VerdictPart,),
}
"""Where each part is in the status. "cache" may be null; the last four are lists."""


def meanings_at(place: str) -> dict[str, Meaning]:
    """Return the meaning of each field at a place of :data:`PARTS`."""
    return {name: meaning for part in PARTS[place] for name, meaning in meanings(part).items()}


def rows_at(status: StatusFields, place: str) -> list[StatusFields]:
    """Return the values at a place of :data:`PARTS`: one row, or those of a list, or none."""
    found: Any = status
    for key in filter(None, place.split(".")):
        found = found[key]
    return [] if found is None else list(found) if isinstance(found, list | tuple) else [found]


def events(status: StatusFields) -> list[str]:
    """Name the unusual events since the start, those that happened: "2 refused candidates"."""
    named = meanings_at("totals").items()
    return [
        f"{status['totals'][name]} {meaning.words or name.replace('_', ' ')}"
        for name, meaning in named
        if meaning.is_event and status["totals"].get(name)
    ]


def to_json(status: StatusFields, most_bytes: int = LARGEST_HEADER_BYTES - 1024) -> bytes:
    """Encode a status, UTF-8. Fewer workers and consumers are listed if it is too large for a message otherwise."""
    plain = dict(status)
    while len(encoded := json.dumps(plain, ensure_ascii=False).encode(errors="replace")) > most_bytes:
        shown = max(len(plain["workers"]), len(plain["consumers"])) // 2
        plain["workers"], plain["consumers"] = plain["workers"][:shown], plain["consumers"][:shown]
    return encoded


def _worker(broker: Broker, identity: bytes, member: Member, restarts: int | None, window: TimeWindow) -> WorkerPart:
    now, leases = window.last.now, broker.leases
    request, since = leases.in_work(identity) or (None, now)
    video, frame = (None if request is None else broker.clip_of(request)) or ("", None)
    busy, cores = window.rates_of(identity)
    if member.given_up:
        state = "lost"
    elif identity in broker.registry.resting:
        state = "resting"
    else:
        state = "working" if identity in leases.held else "idle"
    return WorkerPart(
        name=clean_name(member.name),
        host=member.host,
        state=state,
        clip=short(video),
        frame=frame,
        clip_seconds=now - since,
        leases=leases.held_by(identity),
        samples=member.work.samples,
        busy_share=min(1.0, busy),
        cpu_share=cores,
        memory_gib=member.memory_bytes / GIB,
        silent_seconds=member.liveness.silence(now),
        restarts=restarts,
        unreadable=short(member.unreadable),
    )


def _consumer(session: Session, window: TimeWindow) -> ConsumerPart:
    now, totals = window.last.now, session.totals
    samples, waited, passed = window.rates_of(totals.number)
    share, left = min(1.0, waited), session.schedule.count - session.position
    if session.left_at is not None:
        state = "gone"
    elif share > 0.5:
        state = "stalled"
    else:
        state = "taking" if session.unanswered or samples else "idle"
    return ConsumerPart(
        id=f"{totals.number:08x}",
        name=session.name,
        host=session.host,
        state=state,
        epoch=session.epoch,
        position=session.position,
        sequences=session.schedule.count,
        epoch_share=session.position / max(1, session.schedule.count),
        eta_seconds=left / passed if passed > 0.0 else None,
        batch_size=session.batch_size,
        credit=session.credit,
        in_flight=len(session.unanswered) - len(session.waiting),
        waiting=len(session.waiting),
        served=totals.served,
        samples_per_second=samples,
        batches_per_second=samples / session.batch_size,
        waiting_share=share,
        waited_seconds=totals.waited_seconds,
        silent_seconds=session.liveness.silence(now),
        spec=session.spec.digest,
        seed=session.seed,
        quarantine=session.quarantine,
    )


class StatusPublisher:
    """Build the status of one server, and answer requests for it.

    Args:
        config, catalogue, broker, pool, sockets: what the status is read from.
        now: monotonic time of the server's start, seconds.
        wall_clock: returns the time of day, ISO 8601.

    Attributes:
        is_ready: whether the server has announced that it is ready.
    """

    def __init__(
        self,
        config: ServeConfig,
        catalogue: Catalogue,
        broker: Broker,
        pool: Pool,
        sockets: Sockets,
        now: float,
        wall_clock: Callable[[], str],
    ) -> None:
        self._config, self._catalogue, self._broker = config, catalogue, broker
        self._pool, self._sockets, self._wall_clock = pool, sockets, wall_clock
        self._started = now
        self._waited_before = sockets.waited_seconds
        self._history = History(broker, now)
        self._processor_clock = time.thread_time
        self._waiting: dict[SendStatus, None] = {}
        self._answer_at = now
        self.is_ready = False

    def status(self, now: float) -> StatusFields:
        """Return the current status."""
        broker, window = self._broker, self._history.window(now)
        counters, shares = broker.counters, Shares.of(window)
        cache = cache_part(
            self._config.cache,
            self._config.cache_gib,
            counters.cache_hits,
            counters.cache_misses,
            counters.cache_trouble,
        )
        restarts = self._pool.restarts
        return {
            **values(self._server(now)),
            **values(self._catalogue.part()),
            **values(self._load(window)),
            **values(broker.quarantine.part()),
            "waiting": values(self._bottleneck(shares, now)) | {"shares": values(shares)},
            "totals": values(counters) | values(FaultTotal(counters.faults)),
            "cache": None if cache is None else values(cache),
            "workers": [
                values(_worker(broker, identity, member, restarts.get(member.name.encode()), window))
                for identity, member in list(broker.registry.members.items())[:MOST_SHOWN]
            ],
            "consumers": [values(_consumer(each, window)) for each in list(broker.sessions)[:MOST_SHOWN]],
            "refusals": [values(each) for each in reversed(broker.refusals)],
            "verdicts": [values(each) for each in broker.quarantine.verdict_parts()],
        }

    def _server(self, now: float) -> ServerPart:
        return ServerPart(
            version=STATUS_VERSION,
            time=self._wall_clock(),
            program=__version__,
            protocol=PROTOCOL_VERSION,
            host=platform.node(),
            uptime_seconds=now - self._started,
            is_ready=self.is_ready,
            address=self._sockets.address,
            worker_address=self._sockets.worker_address,
            spec=self._config.spec.to_dict(),
        )

    def _load(self, window: TimeWindow) -> LoadPart:
        broker = self._broker
        specs = {each.spec.digest: each.spec for each in broker.sessions}
        return LoadPart(
            specs={digest: spec.to_dict() for digest, spec in list(specs.items())[:_MOST_SPECS]},
            samples_per_second=window.rate("samples"),
            batches_per_second=window.rate("batches"),
            bytes_per_second=window.rate("bytes"),
            decodes_per_second=window.rate("decodes"),
            shared_share=window.rate("shared") / max(window.rate("samples"), 1e-9),
            queue=broker.waiting,
            queued_share=broker.waiting_share,
            worker_count=broker.workers,
            worker_processes=self._pool.running,
            workers_wanted=self._config.workers,
            consumer_count=broker.consumers,
        )

    def _bottleneck(self, shares: Shares, now: float) -> Bottleneck:
        broker = self._broker
        return find_bottleneck(
            shares,
            is_attended=self._history.is_attended(now),
            workers=broker.workers,
            starting=max(0, self._pool.running - broker.workers),
            trouble=broker.blocked_reason or broker.registry.trouble(self._config.workers_in_all),
            has_cache=bool(self._config.cache),
        )

    def ask(self, request: SendStatus) -> None:
        """Take a request, which :meth:`tick` answers."""
        self._waiting[request] = None

    def tick(self, now: float) -> list[ToConsumer | ToWorker]:
        """Return the answers that are due. Call a few times a second."""
        waited_seconds = self._sockets.waited_seconds - self._waited_before
        self._history.note(now, max(0.0, now - self._started - waited_seconds))
        if not self._waiting or now < self._answer_at:
            return []
        began = self._processor_clock()
        waiting, self._waiting = self._waiting, {}
        frames = encode(Status(to_json(self.status(now))))
        self._answer_at = now + max(ANSWER_SECONDS, (self._processor_clock() - began) / LARGEST_SHARE)
        return [(ToWorker if each.is_worker_side else ToConsumer)(each.identity, frames) for each in waiting]
