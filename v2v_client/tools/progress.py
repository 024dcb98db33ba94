"""Show a measurement's progress on a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

ReportProgress = Callable[[float, int], None]
"""Progress callback: called with the seconds measured so far, and the batches received in them."""


@contextlib.contextmanager
def show_progress(what: str, seconds: float) -> Iterator[ReportProgress]:
    """Show a progress bar on stderr, with batches per second and time left, if stderr is a terminal.

    Args:
        what: name of the measurement.
        seconds: its duration, without warm-up.
    """
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=Console(file=sys.stderr), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(f"{what}: warm-up", total=seconds)

        def report(measured: float, batches: int) -> None:
            rate = f"{batches / measured:.1f} batches/s" if measured > 0 and batches else "warm-up"
            bar.update(task, completed=min(measured, seconds), description=f"{what}: {rate}")

        yield report
