"""A clock that stands still while its process does."""

from __future__ import annotations

import time

_LONGEST_TURN_SECONDS = 1.0
"""What goes beyond is time in which nobody was listened to."""


class Clock:
    """Seconds, as far as this process was there to listen.

    While it is stopped (in a terminal, by a batch system, with its whole machine) it hears no answer, and those who owe
    one may be stopped as well: a deadline that runs out meanwhile is nobody's fault.
    """

    def __init__(self) -> None:
        self._seen = time.monotonic()
        self._away = 0.0

    def __call__(self) -> float:
        seen, self._seen = self._seen, time.monotonic()
        self._away += max(0.0, self._seen - seen - _LONGEST_TURN_SECONDS)
        return self._seen - self._away
