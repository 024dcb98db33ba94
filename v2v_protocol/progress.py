"""Show how far a long task is: a bar on a terminal; in a log, a line every ten seconds.

This is the only file of the package that uses rich, which every command line's extra installs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, TypeVar

from v2v_protocol.programs import printable, show

_Item = TypeVar("_Item")
LOG_SECONDS = 10.0
_FIRST_SECONDS = 1.0
"""A task that ends sooner shows nothing."""
_REFRESH_SECONDS = 0.1


class Progress(AbstractContextManager["Progress"]):
    """Show the progress of one task on standard error. Call it with the amount done; a context manager.

    Args:
        what: the task, for instance "probing videos".
        unit: unit of the amounts, plural; "%" shows their share only.
        say: writes a log line; then there is no bar. None: a bar on a terminal, plain lines elsewhere.
        console: a rich console to draw on, in place of standard error; its bar stays when the task ends.
        shows_rate: whether to add the rate and the time left.
        clock: returns monotonic time, seconds.
    """

    def __init__(
        self,
        what: str,
        unit: str = "",
        *,
        say: Callable[[str], object] | None = None,
        console: Any = None,
        shows_rate: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what, self._unit, self._shows_rate = what, unit, shows_rate
        self._clock = clock
        self._say = say or partial(show, stream=sys.stderr)
        has_bar = say is None and (sys.stderr.isatty() if console is None else console.is_terminal)
        self._bar = _make_bar(console) if has_bar else None
        self._task = None if self._bar is None else self._bar.add_task(what, total=None, text="")
        self._due = clock() + (LOG_SECONDS if self._bar is None else _FIRST_SECONDS)
        self._begun: tuple[float, float] | None = None  # (amount, time) from which the rate is measured

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the bar."""
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, done: float, total: float | None = None, note: str = "", what: str = "") -> None:
        """Show an amount.

        Args:
            done: the amount done.
            total: the whole amount; None: unknown.
            note: a text to add.
            what: the part of the task that this is about, in place of its name.
        """
        now = self._clock()
        if self._begun is None or done <= self._begun[0]:
            self._begun = done, now
        if now >= self._due or (done == total and self._is_shown):
            self._show(now, what or self._what, self._text(done, total, note, now), done, total)

    def notice(self, text: str, *, is_urgent: bool = False) -> None:
        """Show a step whose total is not known, if it is time to or ``is_urgent``."""
        if (now := self._clock()) >= self._due or is_urgent:
            self._show(now, text, "", 0.0, None)

    @classmethod
    def over(cls, what: str, unit: str, items: Iterable[_Item], total: int) -> Iterator[_Item]:
        """Yield items, and show how many there were."""
        with cls(what, unit) as progress:
            for done, item in enumerate(items, 1):
                progress(done, total)
                yield item

    @property
    def _is_shown(self) -> bool:
        return self._bar is not None and self._bar.live.is_started

    def _show(self, now: float, what: str, text: str, done: float, total: float | None) -> None:
        if self._bar is None:
            self._due = now + LOG_SECONDS
            self._say(f"{what}: {text}" if text else what)
            return
        self._due = now + _REFRESH_SECONDS
        self._bar.update(self._task, description=printable(what), text=printable(text), completed=done, total=total)
        if not self._is_shown:
            self._bar.start()

    def _text(self, done: float, total: float | None, note: str, now: float) -> str:
        unit = f" {self._unit}" if self._unit not in ("", "%") else ""
        first, began = self._begun or (done, now)
        rate = (done - first) / (now - began) if now > began else 0.0
        if self._unit == "%":
            parts = [f"{done / total:.0%}" if total else ""]
        else:
            parts = [f"{done:.0f}{unit}" if total is None else f"{done:.0f} of {total:.0f}{unit}"]
        if self._shows_rate and rate and self._unit != "%" and done != total:
            parts.append(f"{rate:.3g}{unit} a second")
        parts.append(note)
        if self._shows_rate and rate and total is not None and done < total:
            parts.append(f"{format_duration((total - done) / rate)} left")
        return ", ".join(filter(None, parts))


def format_duration(seconds: float) -> str:
    """Format a time for people."""
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _make_bar(console: Any) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[text]}", markup=False),
    )
    return Bar(*columns, console=console or Console(file=sys.stderr), transient=console is None)
