"""Whoever looks at the service: keeps the history, makes the state when somebody wants it, and answers those who asked.

A state is made at most a few times a second, however many look and however often they ask.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from v2v_protocol.messages import ErrorCode, Status
from v2v_protocol.wire import Frames, encode
from v2v_server.broker.actions import SendStatus, ToConsumer, ToWorker, denial
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.quarantine import Quarantine
from v2v_server.broker.transport import ServerTransport
from v2v_server.config import ServeConfig
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.status.history import History
from v2v_server.status.snapshot import Service, service_state
from v2v_server.status.state import ServiceState
from v2v_server.supervise.protocol import Supervisor

ANSWER_SECONDS = 0.4
LARGEST_SHARE = 0.02
"""Of the loop's time that states may take: with thousands of workers and consumers they come less often."""
MOST_LOOKERS = 64
"""Peers that are answered with one state."""


class StatusPublisher:
    """One service, looked at.

    Args:
        service: where the state is read from.
        waited_seconds: for how long the loop has waited for messages in all.
        wall_clock: gives the time of day, ISO 8601.
        processor_clock: seconds that this thread has worked.

    Attributes:
        is_ready: whether the server has said so.
    """

    def __init__(
        self,
        service: Service,
        waited_seconds: Callable[[], float],
        wall_clock: Callable[[], str],
        processor_clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self._service = service
        self._waited_seconds = waited_seconds
        self._wall_clock = wall_clock
        self._processor_clock = processor_clock
        self._lookers: dict[SendStatus, None] = {}
        self._answer_at = service.started
        self.is_ready = False

    def state(self, now: float) -> ServiceState:
        """The state of now."""
        return service_state(self._service, now, self._wall_clock(), is_ready=self.is_ready)

    def ask(self, show: SendStatus) -> list[ToConsumer | ToWorker]:
        """Somebody looks; returns what is to be sent at once, which is nothing as a rule."""
        if show in self._lookers or len(self._lookers) < MOST_LOOKERS:
            self._lookers[show] = None
            return []
        return [_to(show, denial(ErrorCode.BUSY, f"{MOST_LOOKERS} others look at this server at this moment"))]

    def tick(self, now: float) -> list[ToConsumer | ToWorker]:
        """To be called a few times a second; returns the answers that are due."""
        self._service.history.look(now, self._service.dispatcher, self._broker_seconds(now))
        if not self._lookers or now < self._answer_at:
            return []
        began = self._processor_clock()
        lookers, self._lookers = self._lookers, {}
        frames = encode(Status(self.state(now).to_json()))
        self._answer_at = now + max(ANSWER_SECONDS, (self._processor_clock() - began) / LARGEST_SHARE)
        return [_to(show, frames) for show in lookers]

    def _broker_seconds(self, now: float) -> float:
        return max(0.0, now - self._service.started - self._waited_seconds())


def make_publisher(
    config: ServeConfig,
    catalogue: Catalogue,
    dispatcher: Dispatcher,
    supervisor: Supervisor,
    quarantine: Quarantine,
    transport: ServerTransport,
    now: float,
    wall_clock: Callable[[], str],
) -> StatusPublisher:
    """The watch over a server that starts at ``now``."""
    addresses = transport.address, transport.worker_address
    service = Service(config, catalogue, dispatcher, supervisor, quarantine, History(now), *addresses, started=now)
    before = transport.waited_seconds
    return StatusPublisher(service, lambda: transport.waited_seconds - before, wall_clock)


def _to(show: SendStatus, frames: Frames) -> ToConsumer | ToWorker:
    return ToWorker(show.identity, frames) if show.is_worker_side else ToConsumer(show.identity, frames)
