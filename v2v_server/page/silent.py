"""Bound the connections to the page that have not sent a request."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

SILENT_SECONDS = 5.0
MOST_SILENT = 64
"""Connections without a complete request. One more ends the oldest of them."""


class BoundedProtocol(H11Protocol):
    """Close connections that send no complete request in time, so that they cannot keep out health checks."""

    silent: ClassVar[dict[BoundedProtocol, asyncio.TimerHandle]] = {}

    def connection_made(self, transport: Any) -> None:
        """Start the timer of a connection, see asyncio.Protocol."""
        super().connection_made(transport)
        self.silent[self] = self.loop.call_later(SILENT_SECONDS, transport.abort)
        if len(self.silent) > MOST_SILENT:
            oldest = next(iter(self.silent))
            oldest._settle()
            oldest.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Handle received data, see asyncio.Protocol."""
        super().data_received(data)
        if self.cycle is not None:
            self._settle()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer of a connection, see asyncio.Protocol."""
        self._settle()
        super().connection_lost(exc)

    def _settle(self) -> None:
        timer = self.silent.pop(self, None)
        if timer is not None:
            timer.cancel()
