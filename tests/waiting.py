"""Wait for another process, in tests that get no notification from it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


def until(condition: Callable[[], object]) -> None:
    """Return as soon as a condition holds; the default of one minute is enough for all tests.

    Raises:
        TimeoutError: the condition does not hold in time.
    """
    deadline = time.monotonic() + 60.0
    pause = threading.Event()
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the condition never came true")
        pause.wait(0.005)
