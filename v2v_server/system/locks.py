"""Lock files that processes share. A lock ends with the process that holds it."""

from __future__ import annotations

import errno
import fcntl
import os
import time

_LONGEST_PAUSE_SECONDS = 0.05


def lock(descriptor: int, wait_seconds: float, file: str | os.PathLike[str]) -> None:
    """Lock an open file until it is closed.

    Args:
        descriptor: of the file.
        wait_seconds: longest wait for another process; 0 tries once.
        file: its name, for the error.

    Raises:
        BlockingIOError: another process keeps it locked.
    """
    pause, end = 0.001, time.monotonic() + wait_seconds
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                raise BlockingIOError(errno.EAGAIN, "another process keeps it locked; end that process", file) from None
        time.sleep(pause)
        pause = min(2 * pause, _LONGEST_PAUSE_SECONDS)
