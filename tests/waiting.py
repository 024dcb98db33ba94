"""Waiting for what another process does, in tests that cannot be told of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


def until(condition: Callable[[], object]) -> None:
    """Returns as soon as a condition holds; a minute is long enough for anything here.

    Raises:
        TimeoutError: it does not.
    """
    deadline = time.monotonic() + 60.0
    pause = threading.Event()
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the condition never came true")
        pause.wait(0.005)
