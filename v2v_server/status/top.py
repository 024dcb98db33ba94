"""The state of a service on a terminal, for `v2v-top`. Pure: from a state as JSON has it to what rich draws.

Names come from strangers: they are put into cells as text, never as markup.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from v2v_server.corpus.files import printable
from v2v_server.status.shutdown_summary import format_duration

_MOST_ROWS = 30
_COLOURS = {
    "working": "green",
    "taking": "green",
    "stalled": "yellow",
    "resting": "yellow",
    "lost": "red",
    "gone": "red",
}
_SHARES = (
    ("consumers wait", "consumers"),
    ("workers idle", "idle"),
    ("decode", "decode"),
    ("simulate", "simulate"),
    ("hand over", "handover"),
    ("no core", "queued"),
    ("server busy", "broker"),
)


def line(state: Mapping[str, Any]) -> str:
    """The state in one line, for what is no terminal."""
    return printable(
        f"{state['time']}  {state['batches_per_second']:.2f} batches/s  {state['samples_per_second']:.1f} samples/s  "
        f"workers {state['worker_count']}  consumers {state['consumer_count']}  queue {state['queue']}  "
        f"faults {state['totals']['faults']}  {state['waiting']['sentence']}"
    )


def draw(state: Mapping[str, Any], note: str = "") -> RenderableType:
    """The state as tables.

    Args:
        state: ``ServiceState.to_dict()``.
        note: that it is old, and why; empty where it is of now.
    """
    waiting, totals, cache = state["waiting"], state["totals"], state["cache"]
    head = _text(f"v2v-serve {state['program']} on {state['host']}  {state['address']}  {state['videos']}", "dim")
    parts: list[RenderableType] = [head]
    if note:
        parts.append(_text(note, "bold red"))
    parts.append(_text(waiting["sentence"], "bold"))
    if waiting["remedy"]:
        parts.append(_text(f"What helps: {waiting['remedy']}."))
    shares = Table.grid(padding=(0, 2))
    shares.add_row(*(f"{name} {waiting['shares'][key]:.0%}" for name, key in _SHARES))
    shares.add_row(*(ProgressBar(total=1.0, completed=waiting["shares"][key], width=16) for _, key in _SHARES))
    said = (
        f"{state['batches_per_second']:.2f} batches/s   {state['samples_per_second']:.1f} samples/s   "
        f"{state['bytes_per_second'] / 1e6:.1f} MB/s   queue {state['queue']}   total {totals['samples']} samples   "
        f"faults {totals['faults']}"
    )
    if cache is not None and (read := cache["hits"] + cache["misses"]):
        said += f"   cache {cache['hits'] / read:.0%} hits, {cache['held_gib']:.2f} of {cache['most_gib']:g} GiB"
        said += f" ({cache['trouble']})" if cache["trouble"] else ""
    parts += [shares, _text(said), consumers_table(state["consumer_count"], state["consumers"]), _workers(state)]
    if state["refusals"]:
        passed = _table(f"passed over {totals['refused_candidates']} times, the last", "video", "frame", "why")
        for each in state["refusals"][:5]:
            passed.add_row(_text(each["video"]), _plain(each["frame"]), _text(each["reason"]))
        parts.append(passed)
    return Group(*parts)


def consumers_table(count: int, consumers: Sequence[Mapping[str, Any]]) -> Table:
    """How far each consumer is.

    Args:
        count: of those that are connected.
        consumers: some of them, as ``ServiceState`` has them.
    """
    table = _table(
        f"{count} consumers",
        *("who", "state", "epoch", "", "position", "left", "batches/s", "waits", "on its way"),
    )
    for each in _shown(table, consumers):
        share = each["position"] / each["sequences"] if each["sequences"] else 0.0
        table.add_row(
            _text(f"{each['name'] or each['id'][:8]} on {each['host']}"),
            Text(each["state"], style=_COLOURS.get(each["state"], "")),
            str(each["epoch"]),
            ProgressBar(total=1.0, completed=share, width=20),
            f"{each['position']}/{each['sequences']}",
            "" if each["eta_seconds"] is None else format_duration(each["eta_seconds"]),
            f"{each['batches_per_second']:.2f}",
            f"{each['waiting_share']:.0%}",
            f"{each['in_flight']}+{each['waiting']}",
        )
    return table


def _workers(state: Mapping[str, Any]) -> Table:
    table = _table(
        f"{state['worker_count']} workers", *("name", "host", "state", "clip", "busy", "cores", "GiB", "restarts")
    )
    for each in _shown(table, state["workers"]):
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


def _shown(table: Table, rows: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    if len(rows) > _MOST_ROWS:
        table.caption = f"and {len(rows) - _MOST_ROWS} more"
    return rows[:_MOST_ROWS]


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, header_style="dim")
    return table


def _text(value: str, style: str = "") -> Text:
    """As text, and without what would move the terminal's cursor."""
    return Text(printable(value), style=style)


def _plain(value: int | None) -> str:
    return "" if value is None else str(value)
