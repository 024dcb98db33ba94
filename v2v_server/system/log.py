"""Log lines of a service: plain text for people, or one JSON object per line for log collectors; and how long the steps
of its start took.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

import psutil

from v2v_protocol.errors import V2VError
from v2v_protocol.programs import printable

LOG_FORMATS = ("text", "json")
Level = Literal["info", "warning", "error"]


def write(stream: TextIO, text: str) -> None:
    """Write to a log stream, ignoring errors. A full disk or a closed terminal must not end a service, and there is no
    other place to report it.
    """
    with suppress(OSError):
        stream.write(text)
        stream.flush()


class Log:
    """Log on standard error.

    Args:
        is_json: one JSON object per line, with ``time`` (ISO 8601, UTC), ``level``, ``text``, and fields that describe
            the subject of the line.
        wall_clock: returns the time.

    Attributes:
        before_line: called before each line; a display that is replaced in place clears itself.
        lock: held while text is written: lines come from several threads.
    """

    def __init__(self, *, is_json: bool = False, wall_clock: Callable[[], str] | None = None) -> None:
        self.is_json = is_json
        self.before_line: Callable[[], None] = lambda: None
        self.lock = threading.Lock()
        self._wall_clock = wall_clock or _utc_now

    def say(self, text: str, level: Level = "info", **about: Any) -> None:
        """Write one line.

        Args:
            text: for people.
            level: severity.
            about: plain values for programs; left out of plain text, which states the same in words.
        """
        if self.is_json:
            text = json.dumps({"time": self._wall_clock(), "level": level, "text": text, **about}, default=str)
        elif sys.stderr.isatty():
            text = f"{datetime.now():%H:%M:%S} {text}"
        with self.lock:
            self.before_line()
            write(sys.stderr, printable(text) + "\n")


@contextmanager
def report_errors(log_format: Callable[[], str | None]) -> Iterator[None]:
    """Write an error that ends a command as a JSON line, instead of the plain text for people.

    Args:
        log_format: returns the format, once it is known.
    """
    try:
        yield
    except V2VError as error:
        if log_format() == "json":
            Log(is_json=True).say(" ".join(str(error).split()), "error")
            error.is_reported = True
        raise


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class StartTimes:
    """How long each step of a program's start takes, for ``--debug``, from the creation of the process on.

    Args:
        is_logged: whether the program logs them.

    Attributes:
        steps: name and seconds of each step, in order.
    """

    def __init__(self, *, is_logged: bool = False) -> None:
        self.is_logged = is_logged
        self.steps: list[tuple[str, float]] = []
        self._since = psutil.Process().create_time()

    def mark(self, step: str) -> None:
        """Note the end of a step, which began at the end of the one before."""
        now = time.time()
        self.steps.append((step, now - self._since))
        self._since = now

    def __str__(self) -> str:
        whole = sum(seconds for _, seconds in self.steps)
        return f"start: {', '.join(f'{step} {seconds:.2f} s' for step, seconds in self.steps)}; {whole:.2f} s in all"
