"""Open files that only this user can read or write, because read access is enough to hold a lock."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def open_private(path: Path, flags: int) -> int:
    """Open a regular file of ours with mode 0600, and return its descriptor. Never blocks.

    Args:
        path: the file. Other users lose access to an existing file, unless it lies behind a symbolic link.
        flags: of ``os.open``; with ``O_CREAT`` a missing file is made.

    Raises:
        OSError: the file cannot be opened, or is not a regular one.
    """
    descriptor = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK, 0o600)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        is_open = stat.S_IMODE(status.st_mode) & 0o077
        if status.st_uid == os.geteuid() and is_open and not path.is_symlink():
            os.fchmod(descriptor, 0o600)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def make_private(path: Path) -> None:
    """Make an empty file with mode 0600; an existing file keeps its content.

    Raises:
        OSError: the file cannot be made, or is not a regular one.
    """
    os.close(open_private(path, os.O_RDWR | os.O_CREAT))
