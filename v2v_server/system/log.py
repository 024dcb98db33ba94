"""Lines for whoever runs a service: plain text for people, or one JSON object a line for what collects logs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

LOG_FORMATS = ("text", "json")
Level = Literal["info", "warning", "error"]


def write(stream: TextIO, text: str) -> None:
    """Say something to whoever looks on. That the log's disk is full, or its terminal gone, must not end a service;
    and there is nowhere left to say so."""
    with suppress(OSError):
        stream.write(text)
        stream.flush()


class Log:
    """Writes to standard error.

    Args:
        is_json: one JSON object a line, with ``time`` (ISO 8601, UTC), ``level``, ``text``, and what else is known of
            what the line is about.
        wall_clock: gives the time.
    """

    def __init__(self, *, is_json: bool = False, wall_clock: Callable[[], str] | None = None) -> None:
        self.is_json = is_json
        self._wall_clock = wall_clock or _utc_now

    def say(self, text: str, level: Level = "info", **about: Any) -> None:
        """One line.

        Args:
            text: for people.
            level: how much it matters.
            about: plain values for programs; left out of plain text, which says the same in words.
        """
        if self.is_json:
            text = json.dumps({"time": self._wall_clock(), "level": level, "text": text, **about}, default=str)
        write(sys.stderr, text + "\n")


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
