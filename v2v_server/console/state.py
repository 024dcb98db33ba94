"""The state of the service: one model, which the terminal, the page and the metrics read. Pure; times are passed in.

Every number has one owner (counters, sessions, the registry of workers, the book of leases, the history of the last ten
seconds) and is copied here. What a field means is said here, and nowhere else. A field may be added without a word;
whoever changes or removes one raises :data:`STATE_VERSION`.

Cost: a few microseconds for each worker and consumer, of which the first :data:`MOST_SHOWN` are told one by one.
"""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from v2v_protocol import PROTOCOL_VERSION, __version__
from v2v_protocol.wire import LARGEST_HEADER_BYTES
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.quarantine import Quarantine
from v2v_server.broker.session import Session
from v2v_server.broker.worker_registry import Member
from v2v_server.catalogue.catalogue import Catalogue
from v2v_server.config import ServeConfig
from v2v_server.console.history import History, Moment
from v2v_server.console.waiting import Shares, Waiting, who_waits
from v2v_server.store.cache import GIB, used_bytes
from v2v_server.supervise.protocol import Supervisor

STATE_VERSION = 1
MOST_SHOWN = 1000
"""Workers, and as many consumers, that are told one by one; the others are only counted."""
_MOST_SPECS = 8
_MOST_VERDICTS = 20
_LONGEST_TEXT = 200
_STALLED_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class WorkerState:
    """One worker.

    Attributes:
        name, host: as it calls itself.
        state: "working"; "idle": it has nothing to do; "resting": its host cannot read a video, see ``unreadable``;
            "lost": it hangs or is silent, and its process is being ended.
        clip: what it is at: catalogue id of the video; empty where it is at nothing that anybody waits for.
        frame: first frame of the clip; None without one.
        clip_seconds: for so long.
        leases: clips that it holds.
        samples: made so far.
        busy_share: of the last ten seconds, in which it made samples, 0 to 1.
        cpu_share: processor time of the last ten seconds, in cores.
        memory_gib: of its process; 0: not known.
        silent_seconds: since it was heard.
        restarts: processes that ended in its place before; None: it is none of this server's own.
        unreadable: what its host could not read last; empty where it can.
    """

    name: str
    host: str
    state: str
    clip: str
    frame: int | None
    clip_seconds: float
    leases: int
    samples: int
    busy_share: float
    cpu_share: float
    memory_gib: float
    silent_seconds: float
    restarts: int | None
    unreadable: str


@dataclass(frozen=True, slots=True)
class ConsumerState:
    """One consumer: a session.

    Attributes:
        id: of its connection, in hexadecimal digits.
        name, host: as it calls itself: "rank 0 of 2".
        state: "stalled": it waits for samples a tenth of the time or more; "taking"; "idle": it has asked for nothing;
            "gone": its connection has ended, and it may come back for ten seconds.
        epoch: that it is in.
        position: index after the highest of the epoch that was answered, 0 to ``sequences``.
        sequences: of one epoch, of all ranks together.
        eta_seconds: until the end of the epoch at the rate of the last ten seconds; None: not known.
        batch_size: of its batches.
        credit: most samples it may have asked for and not been answered.
        in_flight: that it has asked for and workers have.
        waiting: that it has asked for and nobody works on.
        served: samples sent so far.
        samples_per_second, batches_per_second: over the last ten seconds.
        waiting_share: of the last ten seconds, in which it waited for batches, as it says, 0 to 1.
        waited_seconds: the same since its session began.
        silent_seconds: since it was heard.
        spec: digest of what it asks for, see ``ServiceState.specs``.
        seed: of its stream.
        quarantine: number of the snapshot that its samples are made under.
    """

    id: str
    name: str
    host: str
    state: str
    epoch: int
    position: int
    sequences: int
    eta_seconds: float | None
    batch_size: int
    credit: int
    in_flight: int
    waiting: int
    served: int
    samples_per_second: float
    batches_per_second: float
    waiting_share: float
    waited_seconds: float
    silent_seconds: float
    spec: str
    seed: int
    quarantine: int


@dataclass(frozen=True, slots=True)
class RefusalState:
    """One of the last candidates that was passed over: when (ISO 8601, UTC), which video, from which frame, why; kind
    is "failed", "quarantined" or another :class:`v2v_protocol.refusal.RefusalKind`."""

    time: str
    video: str
    frame: int | None
    reason: str
    kind: str


@dataclass(frozen=True, slots=True)
class VerdictState:
    """One of the last verdicts of the quarantine that is in force."""

    snapshot: int
    time: str
    video: str
    frame: int
    reason: str


@dataclass(frozen=True, slots=True)
class CacheState:
    """The cache of what was decoded.

    Attributes:
        folder: on this host; empty where only workers of other hosts have one.
        held_gib, most_gib: how much lies there and may.
        hits, misses: clips that were read from one, and that had to be decoded.
        trouble: why one keeps no more, when last heard of; empty where it does.
    """

    folder: str
    held_gib: float
    most_gib: float
    hits: int
    misses: int
    trouble: str


@dataclass(frozen=True, slots=True)
class Totals:
    """Since the start; see :class:`v2v_server.broker.counters.Counters`. ``faults`` is everything that went wrong and
    was survived."""

    samples: int
    batches: float
    decodes: int
    bytes: int
    in_slots: int
    cpu_seconds: float
    decode_seconds: float
    simulate_seconds: float
    handover_seconds: float
    waited_seconds: float
    refused_candidates: int
    unavailable: int
    returned_leases: int
    second_leases: int
    late_results: int
    workers_lost: int
    missing_videos: int
    malformed: int
    faults: int


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The whole service.

    Attributes:
        version: :data:`STATE_VERSION`.
        time: of the state, ISO 8601, UTC.
        program, protocol: versions.
        host: of the server.
        uptime_seconds: since the server could be asked for anything.
        is_ready: workers are there, or none are to be started.
        address, worker_address: where consumers and workers connect.
        videos: the folder.
        video_count: of the catalogue.
        unusable_count: files of it that cannot be used at all.
        spec: the resolved default for consumers, with the recipe.
        specs: what consumers ask for, by digest; the first few.
        waiting: who waits for whom, in one sentence, and the shares behind it.
        samples_per_second, batches_per_second, bytes_per_second, decodes_per_second: over the last ten seconds.
        queue: asked samples that nobody works on.
        queued_share: consumers with such samples, of all that are connected, 0 to 1, now.
        worker_count: that have said hello.
        worker_processes: that the server runs itself; more than ``worker_count`` while some start.
        workers_wanted: least and most of its own.
        consumer_count: that are connected.
        totals: since the start.
        cache: None where there is none.
        workers, consumers: the first thousand of each.
        refusals: the last few, newest first.
        quarantine_snapshot: number of the newest.
        quarantined: verdicts in it.
        verdicts: its last few, newest first.
    """

    version: int
    time: str
    program: str
    protocol: int
    host: str
    uptime_seconds: float
    is_ready: bool
    address: str
    worker_address: str
    videos: str
    video_count: int
    unusable_count: int
    spec: Mapping[str, Any]
    specs: Mapping[str, Mapping[str, Any]]
    waiting: Waiting
    samples_per_second: float
    batches_per_second: float
    bytes_per_second: float
    decodes_per_second: float
    queue: int
    queued_share: float
    worker_count: int
    worker_processes: int
    workers_wanted: tuple[int, int]
    consumer_count: int
    totals: Totals
    cache: CacheState | None
    workers: tuple[WorkerState, ...]
    consumers: tuple[ConsumerState, ...]
    refusals: tuple[RefusalState, ...]
    quarantine_snapshot: int
    quarantined: int
    verdicts: tuple[VerdictState, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        values = _plain(self)
        values["waiting"] = _plain(self.waiting) | {"shares": _plain(self.waiting.shares)}
        values["totals"] = _plain(self.totals)
        values["cache"] = None if self.cache is None else _plain(self.cache)
        for many in ("workers", "consumers", "refusals", "verdicts"):
            values[many] = [_plain(each) for each in values[many]]
        return values

    def to_json(self, most_bytes: int = LARGEST_HEADER_BYTES - 1024) -> bytes:
        """The same as JSON, UTF-8. Where that would be too much for a message, fewer workers and consumers are told one
        by one."""
        values = self.to_dict()
        while len(encoded := json.dumps(values, ensure_ascii=False).encode(errors="replace")) > most_bytes:
            shown = max(len(values["workers"]), len(values["consumers"])) // 2
            values["workers"], values["consumers"] = values["workers"][:shown], values["consumers"][:shown]
        return encoded


@dataclass(frozen=True, slots=True)
class Service:
    """Where the state is read from.

    Attributes:
        config, catalogue, dispatcher, supervisor, quarantine: of the server.
        history: of the last ten seconds.
        address, worker_address: where consumers and workers connect.
        started: when, by the clock of the loop.
    """

    config: ServeConfig
    catalogue: Catalogue
    dispatcher: Dispatcher
    supervisor: Supervisor
    quarantine: Quarantine
    history: History
    address: str
    worker_address: str
    started: float


def service_state(service: Service, now: float, time: str, *, is_ready: bool) -> ServiceState:
    """The state of now.

    Args:
        service: see there.
        now: the time by the loop's clock, seconds.
        time: of day, ISO 8601.
        is_ready: whether the server has said so.
    """
    config, dispatcher, catalogue = service.config, service.dispatcher, service.catalogue
    before, last = service.history.window(now, dispatcher)
    seconds = last.now - before.now
    sessions = list(dispatcher.sessions)
    return ServiceState(
        version=STATE_VERSION,
        time=time,
        program=__version__,
        protocol=PROTOCOL_VERSION,
        host=platform.node(),
        uptime_seconds=now - service.started,
        is_ready=is_ready,
        address=service.address,
        worker_address=service.worker_address,
        videos=str(catalogue.root),
        video_count=len(catalogue.videos),
        unusable_count=len(catalogue.refusals),
        spec=config.spec.to_dict(),
        specs={each.spec.digest: each.spec.to_dict() for each in _first_of_each_spec(sessions)},
        waiting=_waiting(service, now, before, last),
        samples_per_second=_rate(last.samples - before.samples, seconds),
        batches_per_second=_rate(last.batches - before.batches, seconds),
        bytes_per_second=_rate(last.array_bytes - before.array_bytes, seconds),
        decodes_per_second=_rate(last.decodes - before.decodes, seconds),
        queue=dispatcher.waiting,
        queued_share=dispatcher.waiting_share,
        worker_count=dispatcher.workers,
        worker_processes=service.supervisor.running,
        workers_wanted=config.workers,
        consumer_count=dispatcher.consumers,
        totals=_totals(dispatcher),
        cache=_cache(config, dispatcher),
        workers=_workers(service, now, before, last),
        consumers=tuple(_consumer(each, now, before, seconds) for each in sessions[:MOST_SHOWN]),
        refusals=tuple(
            RefusalState(when, each.video[:_LONGEST_TEXT], each.frame, each.reason[:_LONGEST_TEXT], str(each.kind))
            for when, each in reversed(dispatcher.candidates.latest)
        ),
        quarantine_snapshot=service.quarantine.latest,
        quarantined=len(service.quarantine.verdicts(service.quarantine.latest)),
        verdicts=tuple(
            VerdictState(each.snapshot, each.time, each.path[:_LONGEST_TEXT], each.frame, each.reason[:_LONGEST_TEXT])
            for each in reversed(service.quarantine.verdicts(service.quarantine.latest)[-_MOST_VERDICTS:])
        ),
    )


def _first_of_each_spec(sessions: list[Session]) -> list[Session]:
    found: dict[str, Session] = {}
    for session in sessions:
        if len(found) < _MOST_SPECS:
            found.setdefault(session.spec.digest, session)
    return list(found.values())


def _waiting(service: Service, now: float, before: Moment, last: Moment) -> Waiting:
    dispatcher = service.dispatcher
    return who_waits(
        Shares.of(before, last),
        is_attended=service.history.is_attended(now) or dispatcher.consumers > 0,
        workers=dispatcher.workers,
        starting=max(0, service.supervisor.running - dispatcher.workers),
        trouble=dispatcher.held_up or dispatcher.registry.trouble(service.config.workers_in_all),
        has_cache=bool(service.config.cache),
    )


def _totals(dispatcher: Dispatcher) -> Totals:
    counters = dispatcher.counters
    work = counters.work
    return Totals(
        samples=counters.samples,
        batches=counters.batches,
        decodes=counters.decodes,
        bytes=counters.bytes,
        in_slots=counters.in_slots,
        cpu_seconds=work.cpu_seconds,
        decode_seconds=work.decode_seconds,
        simulate_seconds=work.simulate_seconds,
        handover_seconds=work.handover_seconds,
        waited_seconds=counters.waited_seconds,
        refused_candidates=counters.refused_candidates,
        unavailable=counters.unavailable,
        returned_leases=counters.returned_leases,
        second_leases=counters.second_leases,
        late_results=counters.late_results,
        workers_lost=counters.workers_lost,
        missing_videos=counters.missing_videos,
        malformed=counters.malformed,
        faults=counters.faults,
    )


def _cache(config: ServeConfig, dispatcher: Dispatcher) -> CacheState | None:
    counters = dispatcher.counters
    if not config.cache and not counters.cache_hits + counters.cache_misses:
        return None
    held = used_bytes(Path(config.cache)) / GIB if config.cache else 0.0
    most = config.cache_gib if config.cache else 0.0
    return CacheState(config.cache, held, most, counters.cache_hits, counters.cache_misses, counters.cache_trouble)


def _workers(service: Service, now: float, before: Moment, last: Moment) -> tuple[WorkerState, ...]:
    restarts = service.supervisor.restarts
    members = list(service.dispatcher.registry.members().items())[:MOST_SHOWN]
    seconds = last.now - before.now
    return tuple(
        _worker(
            service.dispatcher, name, member, now, restarts.get(name),
            _rate(last.busy[name] - before.busy.get(name, 0.0), seconds),
            _rate(last.cpu[name] - before.cpu.get(name, 0.0), seconds),
        )
        for name, member in members
    )  # fmt: skip


def _worker(
    dispatcher: Dispatcher,
    name: bytes,
    member: Member,
    now: float,
    restarts: int | None,
    busy_share: float,
    cpu_share: float,
) -> WorkerState:
    at = dispatcher.leases.in_work(name)
    request, since = (None, now) if at is None else at
    clip = None if request is None else dispatcher.clip_of(request)
    if member.given_up:
        state = "lost"
    elif dispatcher.registry.is_resting(name):
        state = "resting"
    else:
        state = "working" if dispatcher.leases.holds(name) else "idle"
    return WorkerState(
        name=name.decode(errors="replace"),
        host=member.host,
        state=state,
        clip="" if clip is None else clip[0][:_LONGEST_TEXT],
        frame=None if clip is None else clip[1],
        clip_seconds=now - since,
        leases=dispatcher.leases.held_by(name),
        samples=member.work.samples,
        busy_share=min(1.0, busy_share),
        cpu_share=cpu_share,
        memory_gib=member.memory_bytes / GIB,
        silent_seconds=member.liveness.silence(now),
        restarts=restarts,
        unreadable=member.unreadable[:_LONGEST_TEXT],
    )


def _consumer(session: Session, now: float, before: Moment, seconds: float) -> ConsumerState:
    # One that came a moment ago has rates of its own time, a second at least.
    seconds = min(seconds, max(1.0, now - session.since))
    samples = _rate(session.served - before.served.get(session.identity, 0), seconds)
    waited = _rate(session.waited_seconds - before.waited.get(session.identity, 0.0), seconds)
    left = session.schedule.count - session.position
    share = min(1.0, max(0.0, waited))
    if session.left_at is not None:
        state = "gone"
    elif share >= _STALLED_SHARE:
        state = "stalled"
    else:
        state = "taking" if session.unanswered or samples else "idle"
    epoch, position = before.positions.get(session.identity, (session.epoch, 0))
    progress = _rate(session.position - (position if epoch == session.epoch else 0), seconds)
    return ConsumerState(
        id=session.identity.hex(),
        name=session.name,
        host=session.host,
        state=state,
        epoch=session.epoch,
        position=session.position,
        sequences=session.schedule.count,
        eta_seconds=left / progress if progress > 0.0 else None,
        batch_size=session.batch_size,
        credit=session.credit,
        in_flight=len(session.unanswered) - len(session.waiting),
        waiting=len(session.waiting),
        served=session.served,
        samples_per_second=samples,
        batches_per_second=samples / session.batch_size,
        waiting_share=share,
        waited_seconds=session.waited_seconds,
        silent_seconds=session.liveness.silence(now),
        spec=session.spec.digest,
        seed=session.seed,
        quarantine=session.quarantine,
    )


def _plain(item: Any) -> dict[str, Any]:
    """A dataclass's fields; ``dataclasses.asdict`` looks into all of them, for 35 ms with two thousand peers."""
    kind: Any = type(item)
    return {name: getattr(item, name) for name in _names(kind)}


@cache
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


def _rate(amount: float, seconds: float) -> float:
    return amount / seconds if seconds > 0.0 else 0.0
