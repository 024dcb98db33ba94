"""Get the newest status of the service on demand: a page without viewers costs nothing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from v2v_protocol.errors import V2VError

FRESH_SECONDS = 0.4
"""A status of at most this age is reused."""
_ANSWER_SECONDS = 3.0
KNOWN_SECONDS = 15.0
"""A health check accepts a status of this age."""


class GetsStatus(Protocol):
    """Source of statuses, such as :class:`v2v_server.status.client.StatusClient`."""

    def get_status(self, timeout_seconds: float) -> dict[str, Any]:
        """See :meth:`v2v_server.status.client.StatusClient.get_status`."""


@dataclass(frozen=True, slots=True)
class LatestStatus:
    """The last answer of the server.

    Attributes:
        status: see :mod:`v2v_server.status.parts`; None if the server did not answer.
        trouble: why it did not answer; empty if it did.
        at: time of the answer, seconds.
    """

    status: dict[str, Any] | None
    trouble: str
    at: float


class Source:
    """Request the status from a server, one request at a time and at most a few per second.

    Args:
        client: sends the requests; used by one thread at a time.
        clock: returns monotonic time, seconds.
    """

    def __init__(self, client: GetsStatus, clock: Callable[[], float] = time.monotonic) -> None:
        self._client = client
        self._clock = clock
        self._lock = asyncio.Lock()
        self._latest: LatestStatus | None = None
        self._answered: LatestStatus | None = None
        self._asking: asyncio.Future[LatestStatus] | None = None

    async def latest(self) -> LatestStatus:
        """Return the newest status, which is at most :data:`FRESH_SECONDS` old."""
        async with self._lock:
            if self._latest is None or self._clock() - self._latest.at >= FRESH_SECONDS:
                self._latest = await asyncio.to_thread(self._request)
            return self._latest

    async def known(self) -> LatestStatus:
        """Return what is known without waiting for the server, unless nothing recent is known.

        A status up to :data:`KNOWN_SECONDS` old counts; the next one is asked for in the background.
        """
        if self._asking is None or self._asking.done():
            self._asking = asyncio.ensure_future(self.latest())
        if self._answered is not None and self._clock() - self._answered.at < KNOWN_SECONDS:
            return self._answered
        if self._latest is not None and self._clock() - self._latest.at < KNOWN_SECONDS:
            return self._latest
        return await asyncio.shield(self._asking)

    def _request(self) -> LatestStatus:
        try:
            status = self._client.get_status(_ANSWER_SECONDS)
        except V2VError as error:
            return LatestStatus(None, str(error), self._clock())
        answered = self._answered = LatestStatus(status, "", self._clock())
        return answered
