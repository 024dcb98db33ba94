"""Draw the status on a terminal, for `v2v-top`. Pure: from a status as JSON has it to what rich draws.

Names are untrusted: cells hold them as text, never as markup.
"""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from v2v_protocol.programs import printable
from v2v_protocol.progress import format_duration
from v2v_server.status.parts import Status, meanings_at
from v2v_server.status.text import figures

_MOST_ROWS = 30
_COLOURS = {
    "working": "green",
    "taking": "green",
    "stalled": "yellow",
    "resting": "yellow",
    "lost": "red",
    "gone": "red",
}


def line(status: Status) -> str:
    """Return the status in one line, where there is no terminal."""
    return printable(f"{status['time']}  {figures(status)}  {status['waiting']['sentence']}")


def draw(status: Status, note: str = "") -> RenderableType:
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


def consumers_table(count: int, consumers: Sequence[Status]) -> Table:
    """Draw how far each consumer is.

    Args:
        count: number of connected consumers.
        consumers: the rows to draw.
    """
    table = _table(
        f"{count} consumers",
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


def _workers(status: Status) -> Table:
    table = _table(
        f"{status['worker_count']} workers", *("name", "host", "state", "clip", "busy", "cores", "GiB", "restarts")
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


def _shown(table: Table, rows: Sequence[Status]) -> Sequence[Status]:
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
