"""The progress of the catalogue: a bar on a terminal; in a log, a line every ten seconds of a long scan."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.status import Status
from rich.text import Text

from v2v_server.status.shutdown_summary import format_duration
from v2v_server.system.log import Log

_LOG_SECONDS = 10.0
_SHOWN_AFTER_SECONDS = 1.0


class CatalogueProgress(Protocol):
    """What ``open_catalogue`` tells as its ``progress``, and as its ``notice``."""

    def __call__(self, done: int, total: int) -> None:
        """So many of the files to probe are probed."""

    def notice(self, text: str) -> None:
        """That is looked at now."""


@contextlib.contextmanager
def catalogue_progress(
    clock: Callable[[], float] = time.monotonic, log: Log | None = None
) -> Iterator[CatalogueProgress]:
    """The progress of ``open_catalogue``, shown on stderr while anything is probed or looked at for long.

    Args:
        clock: seconds.
        log: for lines, where it is no terminal or programs read along; None takes plain text.
    """
    if log is None:
        log = Log()
    if log.is_json or not sys.stderr.isatty():
        yield _Lines(clock, log)
        return
    bar = _Bar(clock)
    try:
        yield bar
    finally:
        bar.stop()


class _Lines:
    def __init__(self, clock: Callable[[], float], log: Log) -> None:
        self._clock, self._log = clock, log
        self._due = clock() + _LOG_SECONDS
        self._begun: tuple[int, float] | None = None  # files that were done when, to take the rate from

    def __call__(self, done: int, total: int) -> None:
        now = self._clock()
        if self._begun is None or done < self._begun[0]:
            self._begun = done, now
        first, begun = self._begun
        rate = (done - first) / (now - begun) if now > begun else 0.0
        left = f", {rate:.3g} a second, {format_duration((total - done) / rate)} left" if rate and done < total else ""
        self.notice(f"probing videos: {done} of {total}{left}")

    def notice(self, text: str) -> None:
        now = self._clock()
        if now >= self._due:
            self._due = now + _LOG_SECONDS
            self._log.say(text)


class _Rate(ProgressColumn):
    """Files a second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.3g}/s")


class _Bar:
    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._due = clock() + _SHOWN_AFTER_SECONDS
        console = Console(file=sys.stderr)
        self._bar = Progress(
            TextColumn("probing videos"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn(),
            console=console, transient=True,
        )  # fmt: skip
        self._task = self._bar.add_task("probe", total=None)
        self._status = Status("", console=console)

    def __call__(self, done: int, total: int) -> None:
        self._status.stop()
        if not self._bar.live.is_started and total:
            self._bar.start()
        self._bar.update(self._task, completed=done, total=total)

    def notice(self, text: str) -> None:
        now = self._clock()
        if now >= self._due:
            self._due = now + _SHOWN_AFTER_SECONDS
            self._stop_bar()  # which was begun with an index that turned out to be unusable
            self._status.update(text)
            self._status.start()

    def stop(self) -> None:
        self._status.stop()
        self._stop_bar()

    def _stop_bar(self) -> None:
        if self._bar.live.is_started:
            self._bar.stop()
