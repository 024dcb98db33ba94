"""Sort events that arrive slightly late, with bounded memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings.items import EventChunk

FLUSH_EVENTS = 1 << 19
REORDER_EVENTS = 1 << 17


class InOrder:
    """Pass chunks of events on in the order of time, from a buffer of FLUSH_EVENTS + REORDER_EVENTS.

    Args:
        source: name of the recording, for messages.

    Attributes:
        reordered: number of events that came earlier in time than their predecessor.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._pending: list[EventChunk] = []
        self._count = self._passed = self.reordered = 0
        self._last_ns: int | None = None

    def add(self, chunk: EventChunk) -> Iterator[EventChunk]:
        """Take the next events, at least one, and yield those whose place is certain.

        Raises:
            UsageError: events are further out of order than the buffer can sort.
        """
        self._pending.append(chunk)
        self._count += len(chunk)
        if self._count >= FLUSH_EVENTS + REORDER_EVENTS:
            yield self._flush(REORDER_EVENTS)

    def end(self) -> Iterator[EventChunk]:
        """Yield the remaining events. Errors: :meth:`add`."""
        if self._pending:
            yield self._flush(0)

    def _flush(self, keep: int) -> EventChunk:
        """Return all pending events except the last ``keep``."""
        events = EventChunk.join(self._pending)
        if backward := int(np.count_nonzero(np.diff(events.t_ns) < 0)):
            events = events.take(np.argsort(events.t_ns, kind="stable"))
        if self._last_ns is not None and events.t_ns[0] < self._last_ns:
            seconds = (self._last_ns - events.t_ns[0]) * 1e-9
            raise UsageError(
                f"{self._source}: near event {self._passed} the time goes back by {seconds:.6f} s over more than "
                f"{REORDER_EVENTS} events; sort the recording, or split it there"
            )
        self.reordered += backward
        count = len(events) - keep
        # A copy: a view would keep the whole buffer alive.
        self._pending = [events.take(np.arange(count, len(events)))] if keep else []
        self._count, self._passed, self._last_ns = keep, self._passed + count, int(events.t_ns[count - 1])
        return events.part(0, count)
