"""Makes the state of the service from the server's parts. Pure; times are passed in.

Every number has one owner (counters, sessions, the registry of workers, the book of leases, the history of the last ten
seconds) and is copied from there. It costs a few microseconds for each worker and consumer, of which the first
:data:`MOST_SHOWN` are told one by one.
"""

from __future__ import annotations

import hashlib
import os
import platform
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol import PROTOCOL_VERSION, __version__
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.quarantine import Quarantine
from v2v_server.broker.session import Session
from v2v_server.broker.worker_registry import Member, clean_name
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.status.bottleneck import Shares, Waiting, find_bottleneck
from v2v_server.status.history import History, Moment
from v2v_server.status.state import (
    STATE_VERSION,
    CacheState,
    ConsumerState,
    QuarantineState,
    RefusalState,
    ServiceState,
    Totals,
    WorkerState,
)
from v2v_server.store.cache import GIB
from v2v_server.store.used import used_bytes
from v2v_server.supervise.protocol import Supervisor

MOST_SHOWN = 1000
"""Workers, and as many consumers, that are told one by one; the others are only counted."""
_MOST_SPECS = 8
_MOST_VERDICTS = 20
_LONGEST_TEXT = 200
_STALLED_SHARE = 0.1
_ID_KEY = os.urandom(32)


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
        quarantined=len(service.quarantine.entries(service.quarantine.latest)),
        verdicts=tuple(
            QuarantineState(
                each.snapshot, each.time, each.path[:_LONGEST_TEXT], each.frame, each.reason[:_LONGEST_TEXT]
            )
            for each in reversed(service.quarantine.entries(service.quarantine.latest)[-_MOST_VERDICTS:])
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
    return find_bottleneck(
        Shares.of(before, last),
        is_attended=service.history.is_attended(now) or dispatcher.consumers > 0,
        workers=dispatcher.workers,
        starting=max(0, service.supervisor.running - dispatcher.workers),
        trouble=dispatcher.blocked_reason or dispatcher.registry.trouble(service.config.workers_in_all),
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
            service.dispatcher, identity, member, now, restarts.get(member.name.encode()),
            _rate(last.busy[identity] - before.busy.get(identity, 0.0), seconds),
            _rate(last.cpu[identity] - before.cpu.get(identity, 0.0), seconds),
        )
        for identity, member in members
    )  # fmt: skip


def _worker(
    dispatcher: Dispatcher,
    identity: bytes,
    member: Member,
    now: float,
    restarts: int | None,
    busy_share: float,
    cpu_share: float,
) -> WorkerState:
    at = dispatcher.leases.in_work(identity)
    request, since = (None, now) if at is None else at
    clip = None if request is None else dispatcher.clip_of(request)
    if member.given_up:
        state = "lost"
    elif dispatcher.registry.is_resting(identity):
        state = "resting"
    else:
        state = "working" if dispatcher.leases.holds(identity) else "idle"
    return WorkerState(
        name=clean_name(member.name),
        host=member.host,
        state=state,
        clip="" if clip is None else clip[0][:_LONGEST_TEXT],
        frame=None if clip is None else clip[1],
        clip_seconds=now - since,
        leases=dispatcher.leases.held_by(identity),
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
        id=_public_id(session.identity),
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


def _public_id(identity: bytes) -> str:
    """Name a session without its routing id: a peer that knows the id can act for the session."""
    return hashlib.blake2b(identity, key=_ID_KEY, digest_size=8).hexdigest()


def _rate(amount: float, seconds: float) -> float:
    return amount / seconds if seconds > 0.0 else 0.0
