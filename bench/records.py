"""What the measuring commands share: their flags for output, tables on the terminal, records on disk."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from v2v_client.tools import loadtest
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.recipe import Recipe
from v2v_protocol.records import write_json
from v2v_protocol.spec import StreamSpec

Record = Mapping[str, Any]
"""Flat: names in SI units -> text, numbers, truth values or None."""
Column = tuple[str, str, str, float]
"""Key of a record, title, format, and the factor from SI units to what is shown."""


def plain_parser(doc: str | None, name: str) -> argparse.ArgumentParser:
    """A parser with ``--json``.

    Args:
        doc: the module's docstring: its first paragraph describes the command, the rest follows the flags.
        name: of the benchmark.
    """
    first, _, rest = (doc or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog=f"v2v-bench {name}",
        description=first,
        epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    return parser


def parser_of(doc: str | None, name: str, *, seconds: float, what: str) -> argparse.ArgumentParser:
    """A parser with the flags of commands that measure for some time.

    Args:
        doc, name: see :func:`plain_parser`.
        seconds: default of ``--seconds``.
        what: is bounded by ``--seconds``.
    """
    parser = plain_parser(doc, name)
    parser.add_argument("--seconds", type=float, default=seconds, metavar="S", help=f"of {what} (default {seconds:g})")
    parser.add_argument(
        "--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="change a recipe field"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw them")
    return parser


def run(
    parser: argparse.ArgumentParser, work: Callable[[argparse.Namespace], int], arguments: Sequence[str] | None
) -> int:
    """Parses and works; an error of ours, or of the operating system, becomes one line and status 2.

    A SIGTERM ends it as an exception does, so that whatever was started is stopped.

    Raises:
        SystemExit: argparse's own, for flags that it does not understand.
    """
    asked = parser.parse_args(arguments)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        if not 0 < getattr(asked, "seconds", 1.0) < math.inf:
            raise UsageError(f"--seconds {asked.seconds:g}: give more than 0")
        return work(asked)
    except (V2VError, OSError) as error:
        print(f"{parser.prog.rpartition(' ')[2]}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def at_least(asked: argparse.Namespace, **least: int) -> None:
    """Refuses numbers that are too small.

    Args:
        asked: the command line.
        least: the least value of each flag, by its name in ``asked``.

    Raises:
        UsageError: one is smaller; the message names the flag.
    """
    for name, bound in least.items():
        value = getattr(asked, name)
        if value < bound:
            raise UsageError(f"--{name.replace('_', '-')} {value}: give {bound} or more")


def recipe_of(changes: Sequence[str]) -> Recipe:
    """The paper's recipe with the changes of ``--set``.

    Raises:
        RecipeError, UsageError: a change that is none.
    """
    return StreamSpec.from_dict({"recipe": loadtest.recipe_of("paper", changes)}).recipe


def server_flags(changes: Sequence[str]) -> list[str]:
    """The same changes for ``v2v-serve``."""
    return [flag for change in changes for flag in ("--set", change)]


def counts(text: str) -> tuple[int, ...]:
    """An argparse type: numbers from 1, separated by commas."""
    numbers = tuple(int(part) for part in text.split(","))
    if min(numbers) < 1:
        raise ValueError
    return numbers


def show(records: Sequence[Record], columns: Sequence[Column]) -> None:
    """Prints a table; what a record lacks, or has as None, is shown as a dash."""
    table = Table(box=None, pad_edge=False)
    for number, (_, title, _, _) in enumerate(columns):
        table.add_column(title, justify="right" if number else "left", no_wrap=True)
    for record in records:
        table.add_row(*(_cell(record.get(key), form, factor) for key, _, form, factor in columns))
    Console(width=None if sys.stdout.isatty() else 200, highlight=False).print(table)


def _cell(value: Any, form: str, factor: float) -> str:
    if value is None:
        return "-"
    return form.format(value if isinstance(value, str) else value * factor)


def write(records: Sequence[Record], file: Path | None) -> None:
    """Writes the records as a JSON list, where a file is given."""
    if file is not None:
        write_json(file, records)


def say_missed(missed: Sequence[str]) -> int:
    """Prints the bars that were missed; returns the exit status."""
    for text in missed:
        print(f"bar missed: {text}", file=sys.stderr)
    return 1 if missed else 0
