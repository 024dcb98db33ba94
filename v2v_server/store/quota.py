"""Fill a folder up to a limit, from many processes.

The number of bytes lies in the file ``used``, behind a lock (``used.lock``). Files lie one folder deep
(``ab/ab12...``). A file is written in ``partial``, which does not count, and renamed once it is complete and fits the
limit. Disk space is kept free for others.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from v2v_server.system.log import GIB, counter, gauge, text
from v2v_server.system.process import locked, open_private

LEAST_FREE_BYTES = GIB
"""Always keep this much disk space free."""
_USED, PARTIAL = "used", "partial"
_KEPT_SHARE = 0.9
"""Share of the limit that is used after an eviction. Evicting lists every file, so it frees space for several."""


@dataclass(frozen=True, slots=True)
class CachePart:
    """The cache of decoded clips."""

    folder: str = text("Folder of the cache on this host; empty if only workers of other hosts have one.")
    held_gib: float | None = gauge("Size of the cache.", "bytes", unit="GiB")
    most_gib: float | None = gauge("Size limit of the cache.", "limit_bytes", unit="GiB")
    hits: int = counter("Clips read from the cache.", is_routine=True)
    misses: int = counter("Clips that were not in the cache.", is_routine=True)
    trouble: str = text("Why a cache stores nothing more, as last reported; empty if it does.", default="")


MOST_GIB = 1e6
"""Largest limit of a folder that a flag may give."""


class QuotaFolder:
    """A folder with a limit.

    Args:
        folder: the folder. Only :meth:`make` creates it, so that an unmounted disk does not fill the disk below.
        most_bytes: its limit, bytes.
        wait_seconds: longest wait for the lock; other processes hold it for less than a millisecond, or while they
            evict files.
        least_free_bytes: disk space to keep free, bytes.
    """

    def __init__(
        self, folder: Path, most_bytes: int, wait_seconds: float, least_free_bytes: int = LEAST_FREE_BYTES
    ) -> None:
        self.folder, self.most_bytes, self.least_free_bytes = folder, most_bytes, least_free_bytes
        self._wait_seconds, self._bytes = wait_seconds, 0  # counted by the holder of the lock

    def make(self) -> None:
        """Create the folder if it is missing, and recount its bytes: a killed process may have counted a file that it
        did not store.

        Raises:
            OSError: the folder cannot be created, read or written.
        """
        (self.folder / PARTIAL).mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(BlockingIOError), self.locked():
            self._bytes = count_bytes(self.folder)

    @property
    def used_bytes(self) -> int:
        """Return the number of bytes in the folder; 0 if it is unknown."""
        return used_bytes(self.folder)

    @property
    def free_bytes(self) -> int:
        """Free space of the disk, bytes.

        Raises:
            OSError: the folder is gone.
        """
        return shutil.disk_usage(self.folder).free

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the byte count, and write it back at the end.

        Raises:
            BlockingIOError: another process keeps the lock for longer than an update takes. Callers continue without
                it.
            OSError: the file cannot be opened or written.
        """
        path = self.folder / _USED
        with (
            locked(path.with_suffix(".lock"), self._wait_seconds),
            open(open_private(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW), "r+b") as file,
        ):
            text = file.read(64)
            self._bytes = int(text) if text.isdigit() else count_bytes(self.folder)
            yield
            file.seek(0)
            file.write(b"%020d" % max(0, self._bytes))
            file.truncate()

    def add(self, partial: Path, path: Path, *, evicts: bool = False) -> bool:
        """Give a complete file its name; return False if it does not fit the limit.

        Args:
            partial: the file, on the same disk.
            path: its name in the folder.
            evicts: whether other files go if space runs out: those without a reader (a reader holds a shared lock),
                least recently read first (by their modification time).

        Raises:
            OSError: it cannot be renamed; BlockingIOError: see :meth:`locked`.
        """
        size = partial.stat().st_size
        with self.locked():
            if evicts and (self._bytes + size > self.most_bytes or self.free_bytes < self.least_free_bytes):
                self._evict(size)
            if self._bytes + size > self.most_bytes:
                return False
            path.parent.mkdir(exist_ok=True)
            # Count before renaming: a process killed in between has counted too much, not too little.
            self._bytes += size - (path.stat().st_size if path.exists() else 0)
            partial.replace(path)
        return True

    def remove(self, path: Path) -> None:
        """Remove a file unless it has a reader.

        Raises:
            OSError: see :meth:`locked`.
        """
        with self.locked():
            self._bytes -= delete_unless_read(path)

    def _evict(self, size: int) -> None:
        enough = max(0, int(self.most_bytes * _KEPT_SHARE) - size)
        for _, oldest in sorted((entry.stat().st_mtime_ns, entry.path) for entry in _files(self.folder)):
            if self._bytes <= enough and self.free_bytes >= self.least_free_bytes:
                return
            self._bytes -= delete_unless_read(Path(oldest))


def used_bytes(folder: Path) -> int:
    """Return the number of bytes in a folder; 0 if it is unknown."""
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


def count_bytes(folder: Path) -> int:
    """Count the bytes of all files in a folder."""
    return sum(entry.stat().st_size for entry in _files(folder))


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    for below in folder.iterdir():
        if below.is_dir() and below.name != PARTIAL:
            with os.scandir(below) as entries:
                yield from entries


def delete_unless_read(path: Path) -> int:
    """Delete a file, and return the bytes that this freed; 0 if it has a reader."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        size = os.fstat(file.fileno()).st_size
        path.unlink()
        return size
    return 0
