"""What the simulation does at the edges of what may be asked for.

    v2v-bench extremes --json extremes.json --plot extremes.png

Each row (``extreme_rows.py``) is a check that can fail; the exit status is 1 when one does.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.accuracy.extreme_rows import Row, rows
from v2v_protocol.errors import UsageError
from v2v_protocol.records import write_json


def measure(chosen: Sequence[Row]) -> list[dict[str, Any]]:
    """Flat records, one a row."""
    records = []
    for row in chosen:
        found = row.check()
        records.append(
            {"row": row.name, "expected": row.expected, "quantity": row.quantity, "measured": float(found.measured),
             "bound": float(found.bound), "precision": found.precision, "note": found.note,
             "passed": bool(found.measured <= found.bound)}
        )  # fmt: skip
    return records


def report(records: Sequence[dict[str, Any]]) -> str:
    """The records, for people."""
    lines = [f"{'':34s}{'':10s}{'':9s}{'measured':>10s}{'bound':>10s}  "]
    for r in records:
        lines.append(
            f"{r['row']:34s}{r['expected']:10s}{r['precision']:9s}{r['measured']:10.2g}{r['bound']:10.2g}  "
            f"{'ok  ' if r['passed'] else 'FAIL'} {r['quantity']}{'; ' if r['note'] else ''}{r['note']}"
        )
    return "\n".join(lines)


def plot(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Measured against bound, where the bound is not zero."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = [r for r in records if r["bound"] > 0][::-1]
    figure, axis = pyplot.subplots(figsize=(7.5, 0.28 * len(shown) + 1))
    axis.barh([r["row"] for r in shown], [max(r["measured"] / r["bound"], 1e-6) for r in shown])
    axis.set_title("Error of extreme settings against its bound (line)")
    axis.axvline(1.0, color="black", lw=1)
    axis.set(xscale="log", xlim=(1e-6, 2), xlabel="measured / bound")
    axis.tick_params(axis="y", labelsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns 0, 1 (a row failed) or 2 (wrong usage or input)."""
    parser = argparse.ArgumentParser(prog="v2v-bench extremes", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rows", metavar="WORD", default="", help="only rows whose name holds this")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    asked = parser.parse_args(arguments)
    chosen = [row for row in rows() if asked.rows in row.name]
    if not chosen:
        print(f"v2v-bench extremes: --rows {asked.rows}: no row has that in its name", file=sys.stderr)
        return 2
    records = measure(chosen)
    print(report(records))
    try:
        if asked.json is not None:
            write_json(asked.json, records)
        if asked.plot is not None:
            plot(records, asked.plot)
    except (UsageError, OSError) as error:
        print(f"v2v-bench extremes: {error}", file=sys.stderr)
        return 2
    failed = [r["row"] for r in records if not r["passed"]]
    if failed:
        print(f"bar missed: {len(failed)} rows fail: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
