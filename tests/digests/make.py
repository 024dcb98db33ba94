"""Write the table of digests, and say what changed.

    python -m tests.digests.make               the committed table
    python -m tests.digests.make --host FILE   flow, resizing and MJPEG: FILE, for a comparison on one host

A row that is there already must keep its bytes: this exits with 1, and writes it only with ``--replace``, which takes a
new NUMERICS_VERSION. New rows are added. ``--drop NAME`` drops a row of what no longer exists.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from tests.digests.rows import OF_THIS_HOST, PORTABLE, Made, Row, Ways, compared, digest

TABLE = Path(__file__).parent / "table.json"


class Table:
    """Rows as written: digests and draws in a JSON file, and in an archive beside it the values of each digest.

    Args:
        path: the JSON file; the archive is ``.npz`` of the same name.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._values = path, path.with_suffix(".npz")
        self.rows: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    def row(self, name: str) -> Made:
        """Return what a row holds.

        Raises:
            ValueError: the values are not those of their digest.
        """
        row, arrays = self.rows[name], {}
        with np.load(self._values) as values:
            for array, stated in row["arrays"].items():
                arrays[array] = values[stated]
                if digest(arrays[array]) != stated:
                    raise ValueError(f"{self._values}: {stated} has other values: restore it and {self.path.name}")
        return arrays, row["draws"]

    def write(self, rows: Mapping[str, Made]) -> None:
        """Write rows in place of all others. Equal rows give equal files."""
        values = {digest(array): array for arrays, _ in rows.values() for array in arrays.values()}
        lines = []
        for name, (arrays, draws) in rows.items():
            named = json.dumps({array: digest(value) for array, value in arrays.items()})
            each = ",\n  ".join(map(json.dumps, draws))
            lines.append(f' {json.dumps(name)}: {{"arrays": {named}, "draws": [\n  {each}]}}')
        self.path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        with zipfile.ZipFile(self._values, "w", zipfile.ZIP_LZMA) as archive:
            for name, array in values.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as file:  # without the time of day
                    npy.write_array(file, np.ascontiguousarray(array))


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Write the table of digests, and say what changed.")
    parser.add_argument("--host", type=Path, metavar="FILE", help="compare and write what only one host agrees with")
    parser.add_argument("--replace", action="store_true", help="write rows that changed, too")
    parser.add_argument("--drop", action="append", default=[], metavar="NAME", help="drop this row of the table")
    options = parser.parse_args()
    table = Table(options.host or TABLE)
    rows = OF_THIS_HOST | PORTABLE if options.host else PORTABLE
    changed = False
    found: dict[str, Made] = {}
    with tempfile.TemporaryDirectory() as folder:
        ways = Ways(Path(folder), lossy=options.host is not None)
        try:
            for name, row in rows.items():
                found[name], differences = _one(ways, row, table.row(name) if name in table.rows else None)
                for difference in differences:
                    print(f"{name}: {difference}")
                if name not in table.rows:
                    print(f"{name}: new")
                changed |= bool(differences)
        finally:
            ways.close()
    for name in table.rows.keys() - rows.keys():
        print(f"{name}: no such row any more")
        changed |= name not in options.drop
    if changed and not options.replace:
        print("rows changed: nothing is written", file=sys.stderr)
        return 1
    table.write(found)
    print(f"{len(found)} rows: {table.path}")
    return 0


def _one(ways: Ways, row: Row, expected: Made | None) -> tuple[Made, list[str]]:
    """Return a row from the videos, and what differs: from the table, or in another way from the videos."""
    found = {way: make(row) for way, make in ways.of(row).items()}
    first = found["video"]
    against = first if expected is None else expected
    return first, [f"{way}: {each}" for way, one in found.items() for each in compared(against, one)]


if __name__ == "__main__":
    sys.exit(main())
