"""Track the size of a folder that many processes fill: a number in a file behind a lock.

Files lie one folder deep (``ab/ab12...``). Temporary files in ``partial`` do not count.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from v2v_server.system.private import open_private
from v2v_server.system.status_fields import GIB, counter, gauge, text

_USED, PARTIAL = "used", "partial"
_WAIT_SECONDS = 0.06
"""Default wait for the lock; other workers hold it for less than a millisecond."""


@dataclass(frozen=True, slots=True)
class CachePart:
    """The cache of decoded clips."""

    folder: str = text("Folder of the cache on this host; empty if only workers of other hosts have one.")
    held_gib: float | None = gauge("Size of the cache.", "bytes", unit="GiB")
    most_gib: float | None = gauge("Size limit of the cache.", "limit_bytes", unit="GiB")
    hits: int = counter("Clips read from the cache.", is_routine=True)
    misses: int = counter("Clips that were not in the cache.", is_routine=True)
    trouble: str = text("Why a cache stores nothing more, as last reported; empty if it does.", default="")


@dataclass(slots=True)
class Used:
    """The number of bytes, for the holder of the lock."""

    bytes: int

    def add(self, more: int) -> None:
        """Add to the number of bytes."""
        self.bytes = max(0, self.bytes + more)


def used_bytes(folder: Path) -> int:
    """Return the number of bytes in the folder; 0 if it is unknown."""
    try:
        with open(open_private(folder / _USED, os.O_RDONLY | os.O_NOFOLLOW), "rb") as file:
            text = file.read(64)
    except OSError:
        return 0
    return int(text) if text.isdigit() else 0


def cache_part(folder: str, most_gib: float, hits: int, misses: int, trouble: str) -> CachePart | None:
    """Return the status of the cache; None if there is none.

    Args:
        folder: its folder on this host; empty: only other hosts can have one.
        most_gib: its size limit.
        hits, misses, trouble: as workers of all hosts report.
    """
    if not folder:
        return CachePart("", None, None, hits, misses, trouble) if hits + misses else None
    return CachePart(folder, used_bytes(Path(folder)) / GIB, most_gib, hits, misses, trouble)


@contextlib.contextmanager
def locked_use(folder: Path, wait_seconds: float = _WAIT_SECONDS) -> Iterator[Used]:
    """Lock the number of bytes for one process at a time.

    Args:
        folder: the folder that many processes fill.
        wait_seconds: longest wait for the lock.

    Raises:
        BlockingIOError: another process keeps the lock for longer than an update takes. Callers continue without it.
        OSError: the file cannot be opened or written.
    """
    with open(open_private(folder / _USED, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW), "r+b") as file:
        _lock(file.fileno(), wait_seconds)
        text = file.read(64)
        used = Used(int(text) if text.isdigit() else count_bytes(folder))
        yield used
        file.seek(0)
        file.write(b"%020d" % used.bytes)
        file.truncate()


def _lock(descriptor: int, wait_seconds: float) -> None:
    pause, end = 0.001, time.monotonic() + wait_seconds
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                raise BlockingIOError(
                    errno.EAGAIN, "another process keeps its `used` file locked; end that process"
                ) from None
        time.sleep(pause)
        pause = min(2 * pause, 0.1)


def count_bytes(folder: Path) -> int:
    """Count the bytes of all files in the folder."""
    sizes = 0
    for below in folder.iterdir():
        if below.is_dir() and below.name != PARTIAL:
            sizes += sum(path.stat().st_size for path in below.iterdir())
    return sizes
