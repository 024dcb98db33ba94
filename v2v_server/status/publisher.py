"""Keep the history of a service, build its status on request, and answer the requests.

A status is built at most a few times a second, whatever the number of clients and requests, and all of them get the
same bytes. So every request is answered: a client has one at a time, and connections are limited.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from v2v_protocol.messages import Status as StatusMessage
from v2v_protocol.wire import Frames, encode
from v2v_server.broker.actions import SendStatus, ToConsumer, ToWorker
from v2v_server.status.history import History
from v2v_server.status.parts import Status
from v2v_server.status.snapshot import Service, to_json

ANSWER_SECONDS = 0.4
LARGEST_SHARE = 0.02
"""Share of the loop's time that building may take; with thousands of workers and consumers it happens less often."""


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

    def status(self, now: float) -> Status:
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
        return [_to(request, frames) for request in waiting]


def _to(request: SendStatus, frames: Frames) -> ToConsumer | ToWorker:
    return ToWorker(request.identity, frames) if request.is_worker_side else ToConsumer(request.identity, frames)
