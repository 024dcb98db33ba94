"""The newest state of the service, asked for only when somebody wants it: a page that nobody looks at costs nothing."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from v2v_protocol.errors import V2VError

FRESH_SECONDS = 0.4
"""A state of this age is as good as a new one, however many ask."""
_ANSWER_SECONDS = 3.0


class Looks(Protocol):
    """Where states come from: a :class:`v2v_server.console.asking.Looker`."""

    def look(self, timeout_seconds: float) -> dict[str, Any]:
        """See :meth:`v2v_server.console.asking.Looker.look`."""


@dataclass(frozen=True, slots=True)
class Glimpse:
    """What was seen last.

    Attributes:
        state: ``v2v_server.console.state.ServiceState.to_dict()``; None when the server did not answer.
        trouble: why it did not; empty where it did.
        at: when, seconds.
    """

    state: dict[str, Any] | None
    trouble: str
    at: float


class Source:
    """Asks a server, at most once at a time and a few times a second.

    Args:
        looker: asks; used by one thread at a time.
        clock: seconds.
    """

    def __init__(self, looker: Looks, clock: Callable[[], float] = time.monotonic) -> None:
        self._looker = looker
        self._clock = clock
        self._lock = asyncio.Lock()
        self._latest: Glimpse | None = None

    async def latest(self) -> Glimpse:
        """The newest state, which is at most :data:`FRESH_SECONDS` old."""
        async with self._lock:
            if self._latest is None or self._clock() - self._latest.at >= FRESH_SECONDS:
                self._latest = await asyncio.to_thread(self._look)
            return self._latest

    def _look(self) -> Glimpse:
        try:
            state = self._looker.look(_ANSWER_SECONDS)
        except V2VError as error:
            return Glimpse(None, str(error), self._clock())
        return Glimpse(state, "", self._clock())
