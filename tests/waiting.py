"""Wait for another process, in tests that get no notification from it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import psutil


def until(condition: Callable[[], object]) -> None:
    """Return as soon as a condition holds. Five minutes let a busy host start a server.

    Raises:
        TimeoutError: the condition does not hold in time.
    """
    deadline = time.monotonic() + 300.0
    pause = threading.Event()
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the condition never came true")
        pause.wait(0.005)


def has_ended(process: psutil.Process) -> bool:
    """Return whether the process is gone or a zombie that its parent has not reaped."""
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
