"""Show the status of a running server on standard error: on a terminal, in a log, or for programs."""

from __future__ import annotations

import os
from typing import Any, TextIO

from rich.console import Console
from rich.text import Text

from v2v_protocol.programs import printable
from v2v_server.status.parts import Status, meanings_at
from v2v_server.status.text import figures
from v2v_server.status.top import consumers_table
from v2v_server.system.log import Log, write

_TERMINAL_SECONDS, _LOG_SECONDS = 0.5, 10.0
_MOST_CONSUMERS = 8


class StatusView:
    """Show the status at intervals. A terminal gets a few lines, replaced in place.

    Args:
        log: gets the status if it writes JSON lines.
        stream: gets it as text.
    """

    def __init__(self, log: Log, stream: TextIO) -> None:
        self._log, self._stream = log, stream
        is_terminal = stream.isatty() and os.environ.get("TERM") != "dumb" and not log.is_json
        self._console = Console(file=stream, highlight=False) if is_terminal else None
        self._next = 0.0
        self._lines, self._text = 0, ""

    def is_due(self, now: float) -> bool:
        """Return whether it is time to show the status again."""
        return now >= self._next

    def show(self, now: float, status: Status) -> None:
        """Show the status."""
        self._next = now + (_LOG_SECONDS if self._console is None else _TERMINAL_SECONDS)
        if self._log.is_json:
            self._log.say(status["waiting"]["sentence"], **_for_programs(status))
        elif self._console is None:
            before, self._text = self._text, figures(status)
            if self._text != before:  # an idle server says so once
                write(self._stream, self._text + "\n")
        else:
            text = _drawn(self._console, status)
            write(self._stream, self._clearing() + text)
            self._lines = text.count("\n")

    def interrupt(self) -> None:
        """Clear the lines, because another line follows."""
        if self._lines:
            write(self._stream, self._clearing())
            self._lines = 0

    def close(self) -> None:
        """Leave what was shown last."""
        self._lines = 0

    def _clearing(self) -> str:
        return f"\x1b[{self._lines}F\x1b[J" if self._lines else ""


def _for_programs(status: Status) -> dict[str, Any]:
    totals = status["totals"]
    gauges = {name: status[name] for name, meaning in meanings_at("").items() if meaning.kind == "gauge"}
    return {
        "slow_part": status["waiting"]["part"],
        "workers": status["worker_count"],
        "consumers": status["consumer_count"],
        "samples": totals["samples"],
        "faults": totals["faults"],
        **{name: round(value, 3) if isinstance(value, float) else value for name, value in gauges.items()},
        "totals": totals,
    }


def _drawn(console: Console, status: Status) -> str:
    cores = sum(worker["cpu_share"] for worker in status["workers"])
    with console.capture() as drawn:
        console.print(Text(printable(status["waiting"]["sentence"]), style="bold"))
        console.print(Text(printable(f"{figures(status)}  {cores:.1f} cores"), style="dim"))
        if status["consumers"]:
            console.print(consumers_table(status["consumer_count"], status["consumers"][:_MOST_CONSUMERS]))
    return drawn.get()
