"""A clock that stands still while its process is stopped."""

from __future__ import annotations

import time

_LONGEST_TURN_SECONDS = 1.0
"""A longer step than this counts as time in which the process was stopped."""


class Clock:
    """Seconds during which this process was running.

    A stopped process (in a terminal, by a batch system, with its whole machine) receives no answers, and its peers may
    be stopped as well. So a deadline that expires meanwhile does not count.
    """

    def __init__(self) -> None:
        self._seen = time.monotonic()
        self._away = 0.0

    def __call__(self) -> float:
        seen, self._seen = self._seen, time.monotonic()
        self._away += max(0.0, self._seen - seen - _LONGEST_TURN_SECONDS)
        return self._seen - self._away
