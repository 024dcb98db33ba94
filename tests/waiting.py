"""Wait for another process: for a condition that it makes true, or for what a function returns there."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from typing import Any

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


def result_in_process(function: Callable[..., Any], *arguments: Any, method: str = "fork") -> Any:
    """Return what a function returns in a new process, which ends without running any exit handler."""
    context: Any = multiprocessing.get_context(method)
    here, there = context.Pipe()
    process = context.Process(target=_send_result, args=(there, function, *arguments))
    process.start()
    there.close()
    with here:
        found = here.recv()
    process.join()
    process.close()
    return found


def _send_result(there: Any, function: Callable[..., Any], *arguments: Any) -> None:
    there.send(function(*arguments))
    os._exit(0)
