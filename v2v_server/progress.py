"""The progress bar of the catalogue: shown on a terminal, or a line at the end of a long scan."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


@contextlib.contextmanager
def catalogue_progress() -> Iterator[Callable[[int, int], None]]:
    """A ``progress(done, total)`` callback for ``open_catalogue``, drawn on stderr while anything is probed."""
    columns = (TextColumn("probing videos"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(file=sys.stderr), transient=True, disable=not sys.stderr.isatty())
    task = bar.add_task("probe", total=None)

    def progress(done: int, total: int) -> None:
        if not bar.live.is_started and total:
            bar.start()
        bar.update(task, completed=done, total=total)

    try:
        yield progress
    finally:
        bar.stop()
