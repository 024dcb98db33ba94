"""Show the status as text: in lines of the running server, in its shutdown summary, and in tables for `v2v-top`.

Names are untrusted: cells hold them as text, never as markup.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from v2v_protocol.programs import counted, printable
from v2v_protocol.progress import format_duration
from v2v_server.status.snapshot import StatusFields, events, meanings_at
from v2v_server.system.log import GIB, Log, write

_MOST_ROWS = 30
_COLOURS = {
    "working": "green",
    "taking": "green",
    "stalled": "yellow",
    "resting": "yellow",
    "lost": "red",
    "gone": "red",
}
_TERMINAL_SECONDS, _LOG_SECONDS = 0.5, 10.0
_MOST_CONSUMERS = 8


def figures(status: StatusFields) -> str:
    """Return rates and counts in one line."""
    totals, decodes = status["totals"], status["totals"]["decodes"]
    processes = max(status["worker_processes"], status["worker_count"])
    parts = [
        f"{status['batches_per_second']:.2f} batches/s",
        f"{status['samples_per_second']:.1f} samples/s",
        f"{totals['samples'] / decodes:.1f} samples per decode" if 0 < decodes < totals["samples"] else "",
        # Left out where all samples come in messages: consumers on other hosts, or in another container.
        f"{totals['in_slots'] / totals['samples']:.0%} by shared memory" if totals["in_slots"] else "",
        format_cache(status),
        f"workers {status['worker_count']}/{processes}",
        f"consumers {status['consumer_count']}",
        f"queue {status['queue']}",
        f"faults {totals['faults']}",
        f"total {counted(totals['samples'], 'sample')}",
        *events(status),
    ]
    return "  ".join(filter(None, parts))


def format_cache(status: StatusFields) -> str:
    """Return how well the cache serves; empty if there is none, or it was not used yet."""
    cache = status["cache"]
    if cache is None or not (read := cache["hits"] + cache["misses"]):
        return ""
    held = f", {cache['held_gib']:.2f} of {cache['most_gib']:g} GiB" if cache["folder"] else ""
    return f"cache {cache['hits'] / read:.0%} hits{held}" + (f" ({cache['trouble']})" if cache["trouble"] else "")


def format_shutdown_summary(status: StatusFields) -> list[str]:
    """Return lines on all that a server did.

    Args:
        status: its last.
    """
    totals, seconds = status["totals"], status["uptime_seconds"]
    rate = totals["samples"] / seconds if seconds > 0.0 else 0.0
    clips = f", from {totals['decodes']} decoded clips" if totals["decodes"] < totals["samples"] else ""
    happened = events(status)
    lines = [
        f"in total {counted(totals['samples'], 'sample')} ({totals['batches']:.1f} batches, "
        f"{totals['bytes'] / GIB:.2f} GiB{clips}) in {format_duration(seconds)}: {rate:.2f} samples/s",
        f"faults {totals['faults']}" + (f"; {', '.join(happened)}" if happened else ""),
    ]
    busy = totals["decode_seconds"] + totals["simulate_seconds"] + totals["handover_seconds"]
    if busy > 0.0:
        lines.append(
            f"workers spent {format_duration(busy)} on them: decoding {totals['decode_seconds'] / busy:.0%}, "
            f"simulating {totals['simulate_seconds'] / busy:.0%}, delivering {totals['handover_seconds'] / busy:.0%}; "
            f"consumers waited {format_duration(totals['waited_seconds'])}"
        )
    return lines


def line(status: StatusFields) -> str:
    """Return the status in one line, where there is no terminal."""
    return printable(f"{status['time']}  {figures(status)}  {status['waiting']['sentence']}")


def draw(status: StatusFields, note: str = "") -> RenderableType:
    """Draw the status as tables.

    Args:
        status: the status.
        note: why it is old; empty if it is current.
    """
    waiting = status["waiting"]
    head = _text(f"v2v-serve {status['program']} on {status['host']}  {status['address']}  {status['videos']}", "dim")
    parts: list[RenderableType] = [head]
    if note:
        parts.append(_text(note, "bold red"))
    parts.append(_text(waiting["sentence"], "bold"))
    if waiting["remedy"]:
        parts.append(_text(f"What helps: {waiting['remedy']}."))
    shares = Table.grid(padding=(0, 2))
    named = {
        meaning.words: waiting["shares"][key] for key, meaning in meanings_at("waiting.shares").items() if meaning.words
    }
    shares.add_row(*(f"{words} {share:.0%}" for words, share in named.items()))
    shares.add_row(*(ProgressBar(total=1.0, completed=share, width=16) for share in named.values()))
    said = f"{figures(status)}  {status['bytes_per_second'] / 1e6:.1f} MB/s"
    parts += [shares, _text(said), consumers_table(status["consumer_count"], status["consumers"]), _workers(status)]
    if status["refusals"]:
        skipped = _table(f"skipped {status['totals']['refused_candidates']} times, the last", "video", "frame", "why")
        for each in status["refusals"][:5]:
            skipped.add_row(_text(each["video"]), _plain(each["frame"]), _text(each["reason"]))
        parts.append(skipped)
    return Group(*parts)


def consumers_table(count: int, consumers: Sequence[StatusFields]) -> Table:
    """Draw how far each consumer is.

    Args:
        count: number of connected consumers.
        consumers: the rows to draw.
    """
    table = _table(
        counted(count, "consumer"),
        *("name", "state", "epoch", "", "position", "left", "batches/s", "waits", "in work + queued"),
    )
    for each in _shown(table, consumers):
        table.add_row(
            _text(f"{each['name'] or each['id'][:8]} on {each['host']}"),
            Text(each["state"], style=_COLOURS.get(each["state"], "")),
            str(each["epoch"]),
            ProgressBar(total=1.0, completed=each.get("epoch_share", 0.0), width=20),  # servers before 0.2.0 lack it
            f"{each['position']}/{each['sequences']}",
            "" if each["eta_seconds"] is None else format_duration(each["eta_seconds"]),
            f"{each['batches_per_second']:.2f}",
            f"{each['waiting_share']:.0%}",
            f"{each['in_flight']} + {each['waiting']}",
        )
    return table


def _workers(status: StatusFields) -> Table:
    table = _table(
        counted(status["worker_count"], "worker"),
        *("name", "host", "state", "clip", "busy", "cores", "GiB", "restarts"),
    )
    for each in _shown(table, status["workers"]):
        table.add_row(
            _text(each["name"]),
            _text(each["host"]),
            Text(each["state"], style=_COLOURS.get(each["state"], "")),
            _text(each["unreadable"] or each["clip"]),
            f"{each['busy_share']:.0%}",
            f"{each['cpu_share']:.2f}",
            f"{each['memory_gib']:.2f}",
            _plain(each["restarts"]),
        )
    return table


def _shown(table: Table, rows: Sequence[StatusFields]) -> Sequence[StatusFields]:
    if len(rows) > _MOST_ROWS:
        table.caption = f"and {len(rows) - _MOST_ROWS} more"
    return rows[:_MOST_ROWS]


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, header_style="dim")
    return table


def _text(value: str, style: str = "") -> Text:
    """Return text without control characters, which could move the terminal's cursor."""
    return Text(printable(value), style=style)


def _plain(value: int | None) -> str:
    return "" if value is None else str(value)


class StatusView:
    """Show the status at intervals. A terminal gets a few lines, replaced in place.

    Args:
        log: gets the status if it writes JSON lines; before each of its lines, what is shown is cleared.
        stream: gets it as text.
    """

    def __init__(self, log: Log, stream: TextIO) -> None:
        self._log, self._stream = log, stream
        is_terminal = stream.isatty() and os.environ.get("TERM") != "dumb" and not log.is_json
        self._console = Console(file=stream, highlight=False) if is_terminal else None
        self._next = 0.0
        self._lines, self._text = 0, ""
        log.before_line = self.interrupt

    def is_due(self, now: float) -> bool:
        """Return whether it is time to show the status again."""
        return now >= self._next

    def show(self, now: float, status: StatusFields) -> None:
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
            with self._log.lock:
                write(self._stream, self._clearing() + text)
                self._lines = text.count("\n")

    def interrupt(self) -> None:
        """Clear the lines, because another line follows. The log calls it, with its lock."""
        if self._lines:
            write(self._stream, self._clearing())
            self._lines = 0

    def close(self) -> None:
        """Leave what was shown last."""
        self._lines = 0

    def _clearing(self) -> str:
        return f"\x1b[{self._lines}F\x1b[J" if self._lines else ""


def _for_programs(status: StatusFields) -> dict[str, Any]:
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


def _drawn(console: Console, status: StatusFields) -> str:
    cores = sum(worker["cpu_share"] for worker in status["workers"])
    with console.capture() as drawn:
        console.print(Text(printable(status["waiting"]["sentence"]), style="bold"))
        console.print(Text(printable(f"{figures(status)}  {cores:.1f} cores"), style="dim"))
        if status["consumers"]:
            console.print(consumers_table(status["consumer_count"], status["consumers"][:_MOST_CONSUMERS]))
    return drawn.get()
