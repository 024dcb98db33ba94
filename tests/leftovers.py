"""Shared memory that outlives the processes that made it."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def shared_memory() -> set[str]:
    """Return the names of this host's shared memory: files only, since a folder there may hold temporary files."""
    folder = Path("/dev/shm")
    return {item.name for item in os.scandir(folder) if item.is_file()} if folder.is_dir() else set()


def abandoned_memory(before: set[str]) -> list[str]:
    """Return the names of this user's shared memory created since ``before`` that no living process maps."""
    found: dict[str, str] = {}
    for name in shared_memory() - before:
        with suppress(FileNotFoundError):  # removed meanwhile
            status = os.stat(f"/dev/shm/{name}")
            if status.st_uid == os.geteuid():  # who maps another user's is not told
                found[str(status.st_ino)] = name
    for maps in Path("/proc").glob("[0-9]*/maps") if found else ():
        try:
            text = maps.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue  # another user's process, or one that has ended
        for line in text.splitlines():
            if "/dev/shm/" in line:  # by inode: the maker of a semaphore maps it under an earlier name
                found.pop(line.split()[4], None)
    return sorted(found.values())
