"""Write files so that their name holds either the old content or the complete new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def write_aside_and_rename(path: Path, *, partial: Path | None = None, durable: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces ``path`` at the end of the block.

    After an error, in the block or here, ``path`` is unchanged and the temporary file is removed.

    Args:
        path: the final name.
        partial: the temporary name, in the same folder; None uses a hidden name with this process's id.
        durable: whether to wait until the content and the name are on disk.

    Raises:
        OSError: the file cannot be flushed or renamed.
    """
    partial = partial or path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            _flush(partial)
        partial.replace(path)
    finally:
        with contextlib.suppress(OSError):  # as the error that is under way says more
            partial.unlink()
    if durable:
        # The name is an entry of the folder: without this it can be lost although the content is not.
        with contextlib.suppress(PermissionError):  # a folder without the right to list it
            _flush(path.parent)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
