"""The progress of the catalogue: a bar on a terminal; in a log, a line every ten seconds of a long scan."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from v2v_server.status import write

_LOG_SECONDS = 10.0


@contextlib.contextmanager
def catalogue_progress(clock: Callable[[], float] = time.monotonic) -> Iterator[Callable[[int, int], None]]:
    """A ``progress(done, total)`` callback for ``open_catalogue``, shown on stderr while anything is probed.

    Args:
        clock: seconds.
    """
    if not sys.stderr.isatty():
        yield _in_lines(clock)
        return
    columns = (TextColumn("probing videos"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(file=sys.stderr), transient=True)
    task = bar.add_task("probe", total=None)

    def progress(done: int, total: int) -> None:
        if not bar.live.is_started and total:
            bar.start()
        bar.update(task, completed=done, total=total)

    try:
        yield progress
    finally:
        bar.stop()


def _in_lines(clock: Callable[[], float]) -> Callable[[int, int], None]:
    due = clock() + _LOG_SECONDS

    def progress(done: int, total: int) -> None:
        nonlocal due
        now = clock()
        if now >= due:
            due = now + _LOG_SECONDS
            write(sys.stderr, f"probing videos: {done} of {total}\n")

    return progress
