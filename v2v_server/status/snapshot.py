"""Build the status from the server's parts on request, and answer the requests.

Every number has one owner (counters, sessions, the registry of workers, the leases, the history) and is read there. It
costs a few microseconds for each worker and consumer, of which the first :data:`MOST_SHOWN` are listed. A status is
built at most a few times a second, whatever the number of clients and requests, and all of them get the same bytes. So
every request is answered: a client has one at a time, and connections are limited.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from v2v_protocol import PROTOCOL_VERSION, __version__
from v2v_protocol.messages import LARGEST_HEADER_BYTES, encode
from v2v_protocol.messages import Status as StatusMessage
from v2v_server.broker.actions import SendStatus, ToConsumer, ToWorker
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.session import Session
from v2v_server.broker.state import FaultTotal
from v2v_server.broker.transport import ServerTransport
from v2v_server.broker.worker_registry import Member, clean_name
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.status.bottleneck import Bottleneck, History, Shares, TimeWindow, find_bottleneck
from v2v_server.status.parts import STATUS_VERSION, ConsumerPart, LoadPart, ServerPart, StatusFields, WorkerPart
from v2v_server.store.quota import cache_part
from v2v_server.supervise.pool import Pool
from v2v_server.system.status_fields import GIB, short, values

ANSWER_SECONDS = 0.4
LARGEST_SHARE = 0.02
"""Share of the loop's time that building may take; with thousands of workers and consumers it happens less often."""


MOST_SHOWN = 1000
"""Largest number of workers listed, and of consumers; the others are only counted."""
_MOST_SPECS = 8


@dataclass(frozen=True, slots=True)
class Service:
    """What the status is read from: the server's parts."""

    config: ServeConfig
    catalogue: Catalogue
    dispatcher: Dispatcher
    pool: Pool
    transport: ServerTransport

    def status(
        self, window: TimeWindow, time: str, *, uptime_seconds: float, is_ready: bool, is_attended: bool
    ) -> StatusFields:
        """Return the status at the end of a window.

        Args:
            window: the last ten seconds.
            time: time of day, ISO 8601.
            uptime_seconds: time since the start.
            is_ready: whether the server has announced that it is ready.
            is_attended: whether there are consumers, apart from moments between epochs.
        """
        counters, shares = self.dispatcher.counters, Shares.of(window)
        cache = cache_part(
            self.config.cache, self.config.cache_gib, counters.cache_hits, counters.cache_misses, counters.cache_trouble
        )
        return {
            **values(self._server(time, uptime_seconds, is_ready=is_ready)),
            **values(self.catalogue.part()),
            **values(self._load(window)),
            **values(self.dispatcher.quarantine.part()),
            "waiting": values(self._bottleneck(shares, is_attended=is_attended)) | {"shares": values(shares)},
            "totals": values(counters) | values(FaultTotal(counters.faults)),
            "cache": None if cache is None else values(cache),
            "workers": self._workers(window),
            "consumers": [values(_consumer(each, window)) for each in list(self.dispatcher.sessions)[:MOST_SHOWN]],
            "refusals": [values(each) for each in reversed(self.dispatcher.refusals)],
            "verdicts": [values(each) for each in self.dispatcher.quarantine.verdict_parts()],
        }

    def _server(self, time: str, uptime_seconds: float, *, is_ready: bool) -> ServerPart:
        return ServerPart(
            version=STATUS_VERSION,
            time=time,
            program=__version__,
            protocol=PROTOCOL_VERSION,
            host=platform.node(),
            uptime_seconds=uptime_seconds,
            is_ready=is_ready,
            address=self.transport.address,
            worker_address=self.transport.worker_address,
            spec=self.config.spec.to_dict(),
        )

    def _load(self, window: TimeWindow) -> LoadPart:
        dispatcher = self.dispatcher
        specs = {each.spec.digest: each.spec for each in dispatcher.sessions}
        return LoadPart(
            specs={digest: spec.to_dict() for digest, spec in list(specs.items())[:_MOST_SPECS]},
            samples_per_second=window.rate("samples"),
            batches_per_second=window.rate("batches"),
            bytes_per_second=window.rate("bytes"),
            decodes_per_second=window.rate("decodes"),
            shared_share=window.rate("shared") / max(window.rate("samples"), 1e-9),
            queue=dispatcher.waiting,
            queued_share=dispatcher.waiting_share,
            worker_count=dispatcher.workers,
            worker_processes=self.pool.running,
            workers_wanted=self.config.workers,
            consumer_count=dispatcher.consumers,
        )

    def _bottleneck(self, shares: Shares, *, is_attended: bool) -> Bottleneck:
        dispatcher = self.dispatcher
        return find_bottleneck(
            shares,
            is_attended=is_attended,
            workers=dispatcher.workers,
            starting=max(0, self.pool.running - dispatcher.workers),
            trouble=dispatcher.blocked_reason or dispatcher.registry.trouble(self.config.workers_in_all),
            has_cache=bool(self.config.cache),
        )

    def _workers(self, window: TimeWindow) -> list[dict[str, Any]]:
        members, restarts = self.dispatcher.registry.members, self.pool.restarts
        return [
            values(_worker(self.dispatcher, identity, member, restarts.get(member.name.encode()), window))
            for identity, member in list(members.items())[:MOST_SHOWN]
        ]


def to_json(status: StatusFields, most_bytes: int = LARGEST_HEADER_BYTES - 1024) -> bytes:
    """Encode a status, UTF-8. Fewer workers and consumers are listed if it is too large for a message otherwise."""
    plain = dict(status)
    while len(encoded := json.dumps(plain, ensure_ascii=False).encode(errors="replace")) > most_bytes:
        shown = max(len(plain["workers"]), len(plain["consumers"])) // 2
        plain["workers"], plain["consumers"] = plain["workers"][:shown], plain["consumers"][:shown]
    return encoded


def _worker(
    dispatcher: Dispatcher, identity: bytes, member: Member, restarts: int | None, window: TimeWindow
) -> WorkerPart:
    now, leases = window.last.now, dispatcher.leases
    request, since = leases.in_work(identity) or (None, now)
    video, frame = (None if request is None else dispatcher.clip_of(request)) or ("", None)
    busy, cores = window.rates_of(identity)
    if member.given_up:
        state = "lost"
    elif dispatcher.registry.is_resting(identity):
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
    """Answer requests for the status of one service.

    Args:
        service: what the status is read from.
        now: monotonic time of the server's start, seconds.
        wall_clock: returns the time of day, ISO 8601.
        processor_clock: returns the processor seconds of this thread.

    Attributes:
        is_ready: whether the server has announced that it is ready.
    """

    def __init__(
        self,
        service: Service,
        now: float,
        wall_clock: Callable[[], str],
        processor_clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._service = service
        self._started = now
        self._waited_before = service.transport.waited_seconds
        self._history = History(service.dispatcher, now)
        self._wall_clock = wall_clock
        self._processor_clock = processor_clock
        self._waiting: dict[SendStatus, None] = {}
        self._answer_at = now
        self.is_ready = False

    def status(self, now: float) -> StatusFields:
        """Return the current status."""
        return self._service.status(
            self._history.window(now),
            self._wall_clock(),
            uptime_seconds=now - self._started,
            is_ready=self.is_ready,
            is_attended=self._history.is_attended(now),
        )

    def ask(self, request: SendStatus) -> None:
        """Take a request, which :meth:`tick` answers."""
        self._waiting[request] = None

    def tick(self, now: float) -> list[ToConsumer | ToWorker]:
        """Return the answers that are due. Call a few times a second."""
        waited_seconds = self._service.transport.waited_seconds - self._waited_before
        self._history.note(now, max(0.0, now - self._started - waited_seconds))
        if not self._waiting or now < self._answer_at:
            return []
        began = self._processor_clock()
        waiting, self._waiting = self._waiting, {}
        frames = encode(StatusMessage(to_json(self.status(now))))
        self._answer_at = now + max(ANSWER_SECONDS, (self._processor_clock() - began) / LARGEST_SHARE)
        return [(ToWorker if each.is_worker_side else ToConsumer)(each.identity, frames) for each in waiting]
