"""Record how long each step of a program's start takes, for ``--debug``."""

from __future__ import annotations

import time

import psutil


class StartTimes:
    """The steps of a start, from the creation of the process on.

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
