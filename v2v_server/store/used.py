"""How many bytes a folder holds that many processes fill: a number in a file behind a lock.

Files lie one folder deep (``ab/ab12...``); what is being written lies in ``partial`` and does not count.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_USED, PARTIAL = "used", "partial"


@dataclass(slots=True)
class Used:
    """The number, for whoever has the lock."""

    bytes: int

    def add(self, more: int) -> None:
        """Counts so many more."""
        self.bytes = max(0, self.bytes + more)


def used_bytes(folder: Path) -> int:
    """How much lies there; 0 where that cannot be told."""
    try:
        text = (folder / _USED).read_bytes()
    except OSError:
        return 0
    return int(text) if text.isdigit() else 0


@contextlib.contextmanager
def locked_use(folder: Path) -> Iterator[Used]:
    """The number of bytes that are there, for one process at a time."""
    with open(os.open(folder / _USED, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        text = file.read(64)
        used = Used(int(text) if text.isdigit() else counted(folder))
        yield used
        file.seek(0)
        file.write(b"%020d" % used.bytes)
        file.truncate()


def counted(folder: Path) -> int:
    """The bytes of all files, counted anew."""
    sizes = 0
    for below in folder.iterdir():
        if below.is_dir() and below.name != PARTIAL:
            sizes += sum(path.stat().st_size for path in below.iterdir())
    return sizes
