"""What a service says: log lines, plain text for people or one JSON object per line for log collectors; and the fields
of its status.

A part of the server describes its state as a dataclass of such fields. Each field states once what its value means, its
unit, and its metric. ``/state``, ``/metrics``, page, terminal, log and shutdown summary walk the fields. So a new
counter is two edits: declare the field, and count.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import threading
from argparse import Namespace
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any, Literal, TextIO

from v2v_protocol.errors import V2VError
from v2v_protocol.programs import printable

LOG_FORMATS = ("text", "json")
GIB = 1 << 30
_LONGEST_TEXT = 200
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

    Attributes:
        before_line: called before each line; a display that is replaced in place clears itself.
        lock: held while text is written: lines come from several threads.
    """

    def __init__(self, *, is_json: bool = False) -> None:
        self.is_json = is_json
        self.before_line: Callable[[], None] = lambda: None
        self.lock = threading.Lock()

    def say(self, text: str, level: Level = "info", **about: Any) -> None:
        """Write one line.

        Args:
            text: for people.
            level: severity.
            about: plain values for programs; left out of plain text, which states the same in words.
        """
        if self.is_json:
            text = json.dumps(
                {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "level": level, "text": text, **about},
                default=str,
            )
        elif sys.stderr.isatty():
            text = f"{datetime.now():%H:%M:%S} {text}"
        with self.lock:
            self.before_line()
            write(sys.stderr, printable(text) + "\n")


def report_errors(run: Callable[[Namespace], int | None]) -> Callable[[Namespace], int | None]:
    """Return a command's function that writes an error as a JSON line, instead of the plain text for people, if its
    ``--log-format`` is ``json``.
    """

    def run_and_report(arguments: Namespace) -> int | None:
        try:
            return run(arguments)
        except V2VError as error:
            if arguments.log_format == "json":
                Log(is_json=True).say(" ".join(str(error).split()), "error")
                error.is_reported = True
            raise

    return run_and_report


@dataclass(frozen=True, slots=True)
class Meaning:
    """Description of a field.

    Attributes:
        help: what the value is: one sentence.
        kind: "counter", "gauge", "states" (one of ``states``) or "text".
        unit: "s", "bytes", "GiB", "cores", "/s", "0 to 1"; empty: a number of what the name says.
        metric: name of the metric without prefix and suffix; empty: it is no metric, None: the field's name.
        part: value of the label "part", where fields share a metric.
        words: what people read in place of the field's name; empty: the name.
        states: every value that the field can have.
        merge: makes one value of the values of peers with the same name.
        is_event: whether it counts unusual events, which one-line views name once there are any.
        is_fault: whether each event is a fault that the service survived.
    """

    help: str
    kind: str = "gauge"
    unit: str = ""
    metric: str | None = ""
    part: str = ""
    words: str = ""
    states: tuple[str, ...] = ()
    merge: Callable[[Iterable[float]], float] = sum
    is_event: bool = False
    is_fault: bool = False


def counter(
    help: str,
    metric: str | None = None,
    *,
    unit: str = "",
    part: str = "",
    is_routine: bool = False,
    is_fault: bool = False,
) -> Any:
    """Declare a total since the start, which begins at 0. One that is not routine counts unusual events. See
    :class:`Meaning`."""
    meaning = Meaning(help, "counter", unit, metric, part, is_event=not is_routine, is_fault=is_fault)
    return _field(meaning, default=0)


def gauge(
    help: str,
    metric: str | None = "",
    *,
    unit: str = "",
    part: str = "",
    words: str = "",
    merge: Callable[[Iterable[float]], float] = sum,
    **options: Any,
) -> Any:
    """Declare a value that rises and falls; ``options`` are those of ``dataclasses.field``. See :class:`Meaning`."""
    return _field(Meaning(help, "gauge", unit, metric, part, words, merge=merge), **options)


def states(help: str, metric: str, *values: str) -> Any:
    """Declare a field that has one of a few values; the metric has a sample for each of them."""
    return _field(Meaning(help, "states", metric=metric, states=values))


def text(help: str, **options: Any) -> Any:
    """Declare a text, or another value that is no metric; ``options`` are those of ``dataclasses.field``."""
    return _field(Meaning(help, "text"), **options)


@cache
def meanings(kind: Any) -> dict[str, Meaning]:
    """Return the meaning of each status field of a dataclass, by the field's name. Other fields are no status."""
    return {each.name: each.metadata["meaning"] for each in dataclasses.fields(kind) if "meaning" in each.metadata}


def values(item: Any) -> dict[str, Any]:
    """Return the values of an instance's status fields, by name."""
    kind: Any = type(item)
    return {name: getattr(item, name) for name in meanings(kind)}


def short(text: str) -> str:
    """Cut a text, for instance the name of a file, to the length that a status holds of it."""
    return text[:_LONGEST_TEXT]


def _field(meaning: Meaning, **options: Any) -> Any:
    return dataclasses.field(metadata={"meaning": meaning}, **options)
