"""What a terminal shows of a running server: a few lines that are kept up to date in place."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import TextIO

from rich.console import Console, Group
from rich.text import Text

from v2v_server.corpus.files import printable
from v2v_server.status.line import StatusLine, figures
from v2v_server.status.log import StatusLog
from v2v_server.status.state import ServiceState
from v2v_server.status.top import consumers_table
from v2v_server.system.log import Log, write

_SECONDS = 0.5
_MOST_CONSUMERS = 8


def make_status(log: Log, stream: TextIO) -> StatusBlock | StatusLine | StatusLog:
    """How a server shows its state: for programs, on a terminal, or in a file."""
    if log.is_json:
        return StatusLog(log)
    is_terminal = stream.isatty() and os.environ.get("TERM") != "dumb"
    return StatusBlock(stream) if is_terminal else StatusLine(stream)


class StatusBlock:
    """Who waits for whom, the figures, and how far each consumer is in its epoch.

    Args:
        stream: a terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._console = Console(file=stream, highlight=False)
        self._next = 0.0
        self._lines = 0

    def is_due(self, now: float) -> bool:
        """Whether it is time to show the state again."""
        return now >= self._next

    def show(self, now: float, state: ServiceState) -> None:
        """Shows the state in the place of the one before."""
        self._next = now + _SECONDS
        cores = sum(worker.cpu_share for worker in state.workers)
        parts = [
            Text(printable(state.waiting.sentence), style="bold"),
            Text(printable(f"{figures(state)}  {cores:.1f} cores"), style="dim"),
        ]
        with self._console.capture() as drawn:
            self._console.print(Group(*parts))
            if state.consumers:
                shown = [asdict(each) for each in state.consumers[:_MOST_CONSUMERS]]
                self._console.print(consumers_table(state.consumer_count, shown))
        text = drawn.get()
        write(self._stream, self._clearing() + text)
        self._lines = text.count("\n")

    def interrupt(self) -> None:
        """Clears the lines, because something else is about to be printed."""
        if self._lines:
            write(self._stream, self._clearing())
            self._lines = 0

    def close(self) -> None:
        """Leaves what was shown last."""
        self._lines = 0

    def _clearing(self) -> str:
        return f"\x1b[{self._lines}F\x1b[J" if self._lines else ""
