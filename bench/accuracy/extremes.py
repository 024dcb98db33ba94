"""Check the simulation at the edges of what a recipe may ask for.

    python -m bench extremes --json extremes.json --plot extremes.png

Each row (`tests/oracles/extremes.py`) measures one figure against a bound that follows from the arithmetic. Bar: every
row keeps its bound.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from bench.frame import Column, Record, Report, panels
from tests.oracles.extremes import record_of, rows
from v2v_protocol.command import Parser

_COLUMNS: tuple[Column, ...] = (
    ("row", "", "{}", 1),
    ("expected", "expected", "{}", 1),
    ("precision", "arithmetic", "{}", 1),
    ("measured", "measured", "{:.2g}", 1),
    ("bound", "bound", "{:.2g}", 1),
    ("quantity", "", "{}", 1),
    ("note", "", "{}", 1),
)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags: there are none."""


def measure(asked: argparse.Namespace) -> Report:
    """Run the rows."""
    records = [record_of(row) for row in rows()]
    missed = [f"{record['row']}: {record['note']}" for record in records if not record["passed"]]
    return Report(records, [(records, _COLUMNS)], missed=missed)


def plot(records: Sequence[Record], file: Path) -> None:
    """Draw each measured figure as a share of its bound, where the bound is not 0."""
    shown = {r["row"]: max(r["measured"] / r["bound"], 1e-6) for r in reversed(records) if r["bound"] > 0}
    title = "Error of extreme settings against its bound (line)"
    with panels(file, 1, title=title, height_inches=0.28 * len(shown) + 1.5) as (axes,):
        axes.barh(list(shown), list(shown.values()))
        axes.axvline(1.0, color="black", lw=1)
        axes.set(xscale="log", xlim=(1e-6, 2), xlabel="measured / bound")
