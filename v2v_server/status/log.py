"""The status as a line of a log that programs read."""

from __future__ import annotations

from v2v_server.status.state import ServiceState
from v2v_server.system.log import Log

_LOG_SECONDS = 10.0


class StatusLog:
    """A line every ten seconds, with its numbers beside the text. Has the methods of
    :class:`v2v_server.status.line.StatusLine`.

    Args:
        log: where to.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self._next = 0.0

    def is_due(self, now: float) -> bool:
        """Whether it is time for the next line."""
        return now >= self._next

    def show(self, now: float, state: ServiceState) -> None:
        """Says the state."""
        self._next = now + _LOG_SECONDS
        self._log.say(
            state.waiting.sentence,
            slow_part=state.waiting.part,
            samples_per_second=round(state.samples_per_second, 3),
            batches_per_second=round(state.batches_per_second, 3),
            workers=state.worker_count,
            consumers=state.consumer_count,
            queue=state.queue,
            faults=state.totals.faults,
            samples=state.totals.samples,
        )

    def interrupt(self) -> None:
        """Nothing is in the way of another line."""

    def close(self) -> None:
        """Nothing is left open."""
