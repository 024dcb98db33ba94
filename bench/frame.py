"""The frame of every bench: its parser, its tables and plots, its records on disk, its exit status."""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import JSON, write_aside_and_rename, write_json
from v2v_tools.tradeoff.report import format_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Record = Mapping[str, Any]  # Flat: keys with SI units -> text, number, bool or None
Column = tuple[str, str, str, float]  # Key of a record, title, format, and the factor from SI units to what is shown


@dataclass(frozen=True, slots=True)
class Report:
    """What a bench measured.

    Attributes:
        records: what ``--json`` writes and ``--plot`` draws.
        tables: printed one after the other, each as records and columns.
        lines: printed below the tables.
        missed: stated bars that were missed; any makes the exit status 1.
    """

    records: Sequence[Record]
    tables: Sequence[tuple[Sequence[Record], Sequence[Column]]]
    lines: Sequence[str] = ()
    missed: Sequence[str] = ()


def parser_of(name: str, bench: ModuleType) -> Parser:
    """Return the parser of a bench: its docstring as help, its own flags, and ``--json``, ``--plot``, ``--debug``."""
    first, _, rest = (bench.__doc__ or "").partition("\n\n")
    parser = Parser(f"python -m bench {name}", "[flags]", first, [])
    parser.epilog = rest
    bench.add_flags(parser)
    parser.add_output("Output", "--json", JSON, "write the records to this file")
    if hasattr(bench, "plot"):
        parser.add_output("Output", "--plot", (".png",), "draw the records")
    return parser


def report(bench: ModuleType, asked: argparse.Namespace) -> int:
    """Measure, print the tables, write the files; return the exit status, 1 where a bar was missed.

    Raises:
        UsageError: wrong input, or a file that cannot be written.
    """
    try:
        found: Report = bench.measure(asked)
        for records, columns in found.tables:
            show(records, columns)
        print(*found.lines, sep="\n", end="\n" if found.lines else "")
        if asked.json is not None:
            write_json(asked.json, found.records)
        if getattr(asked, "plot", None) is not None:
            bench.plot(found.records, asked.plot)
    except OSError as error:
        raise UsageError(str(error)) from error
    for text in found.missed:
        print(f"bar missed: {text}", file=sys.stderr)
    return 1 if found.missed else 0


def show(records: Sequence[Record], columns: Sequence[Column]) -> None:
    """Print a table; a value that is missing or None is a dash; a column without values is left out."""
    shown = [column for column in columns if any(record.get(column[0]) is not None for record in records)]
    print(format_table(records, shown), end="")


def beyond(name: str, record: Record, *, least: Mapping[str, float] = {}, most: Mapping[str, float] = {}) -> list[str]:
    """Return a text for each figure of a record that is beyond its bar; a figure that is not there misses none."""
    return [
        f"{name}: {key} {value:.3g}; the bar is at {word} {bar:.3g}"
        for word, sign, bars in (("least", 1, least), ("most", -1, most))
        for key, bar in bars.items()
        if (value := record.get(key)) is not None and sign * value < sign * bar
    ]


def medians(turns: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return the median over the turns of each figure."""
    return {key: statistics.median(turn[key] for turn in turns) for key in turns[0]}


def beside(turns: Sequence[Mapping[str, float]], base: str, most: Mapping[str, float]) -> Report:
    """Return the report of ways to make samples, beside one of them.

    Args:
        turns: processor time of a sample in each turn, by the name of the way.
        base: the way that the others are compared with.
        most: bars: the largest ratio, by name.
    """
    records: list[Record] = [
        {
            "samples": name,
            "cpu_seconds": min(turn[name] for turn in turns),
            "ratio": statistics.median(turn[name] / turn[base] for turn in turns),
        }
        for name in turns[0]
    ]
    columns: list[Column] = [
        ("samples", "samples", "{}", 1.0),
        ("cpu_seconds", "cpu ms", "{:.1f}", 1e3),
        ("ratio", f"x {base}", "{:.2f}", 1.0),
    ]
    judged = [each for each in records if each["samples"] in most]
    missed = [text for each in judged for text in beyond(each["samples"], each, most={"ratio": most[each["samples"]]})]
    return Report(records, [(records, columns)], [], missed)


def ratios(name: str, mine: Iterable[float], base: Iterable[float]) -> dict[str, float]:
    """Return the ratios within turns, so that a drift of the machine cancels: median, lowest and highest."""
    each = [one / other for one, other in zip(mine, base, strict=True)]
    return {name: statistics.median(each), f"{name}_lowest": min(each), f"{name}_highest": max(each)}


@contextmanager
def panels(file: Path, count: int, *, title: str, height_inches: float = 4.0) -> Iterator[Sequence[Axes]]:
    """Yield axes side by side; write the PNG when the block ends without an error."""
    import matplotlib  # lazily: a bench without --plot must not need it

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, count, figsize=(2.2 + 4.6 * count, height_inches), squeeze=False)
    try:
        figure.suptitle(title)
        yield list(axes[0])
        figure.tight_layout()
        with write_aside_and_rename(file) as partial:
            figure.savefig(partial, dpi=110, format="png")
    finally:
        pyplot.close(figure)


def key_values(record: Record) -> tuple[list[Record], list[Column]]:
    """Return a table with one line for each key of a record."""
    lines: list[Record] = [
        {"key": key, "value": f"{value:.4g}" if isinstance(value, float) else str(value)}
        for key, value in record.items()
    ]
    return lines, [("key", "", "{}", 1), ("value", "", "{}", 1)]


def progress(text: str) -> None:
    """Print a line about a bench that still runs to stderr."""
    print(text, file=sys.stderr, flush=True)


def whole(least: int) -> Callable[[str], int]:
    """Return an argparse type: whole numbers from ``least`` on."""

    def read(text: str) -> int:
        if int(text) < least:
            raise argparse.ArgumentTypeError(f"{text}: give {least} or more")
        return int(text)

    return read


def positive(text: str) -> float:
    """Read a finite number above 0: an argparse type."""
    if not 0 < float(text) < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: give a finite number above 0")
    return float(text)


def whole_numbers(text: str) -> tuple[int, ...]:
    """Read whole numbers from 1 on, separated by commas: an argparse type."""
    return tuple(map(whole(1), text.split(",")))


def chosen(text: str | None, possible: Iterable[str], flag: str) -> tuple[str, ...]:
    """Return the words of a flag, separated by commas; all possible ones if it is not given.

    Raises:
        UsageError: an unknown word.
    """
    words = tuple(possible) if text is None else tuple(text.split(","))
    if unknown := set(words) - set(possible):
        raise UsageError(f"{flag} {','.join(sorted(unknown))}: choose from {', '.join(possible)}")
    return words


def add_whole(parser: Parser, flag: str, default: int, what: str, least: int = 1) -> None:
    """Add a flag for a whole number."""
    parser.add_argument(flag, type=whole(least), default=default, metavar="N", help=f"{what} (default {default})")


def add_positive(parser: Parser, flag: str, default: float, what: str) -> None:
    """Add a flag for a number above 0."""
    parser.add_argument(flag, type=positive, default=default, metavar="X", help=f"{what} (default {default:g})")


def add_videos(parser: Parser, what: str = "corpus to serve", rows: str | None = None) -> None:
    """Add ``--videos``, and ``--rows`` with this default where it is given."""
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR", help=what)
    if rows is not None:
        parser.add_argument("--rows", default=rows, help=f"rows of --videos to use (default {rows})")
