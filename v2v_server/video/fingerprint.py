"""Telling whether a file is still the one that was catalogued, without reading all of it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from v2v_protocol.errors import VideoChanged, VideoUnreadable

_BLOCK_BYTES = 64 * 1024


def fingerprint(path: str | os.PathLike[str]) -> str:
    """Size in bytes and a hash of the first and last 64 KiB: ``"<size>-<32 hexadecimal digits>"``.

    Raises:
        VideoUnreadable: the file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(b"v2v fingerprint 1\n" + file.read(_BLOCK_BYTES))
            file.seek(max(0, size - _BLOCK_BYTES))
            digest.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise VideoUnreadable(os.fspath(path), None, f"cannot be read: {error.strerror or error}") from error
    return f"{size}-{digest.hexdigest()[:32]}"


def check_fingerprint(path: str | os.PathLike[str], expected: str) -> None:
    """Make sure that the file is the one that was catalogued.

    Raises:
        VideoChanged: it is another one now.
        VideoUnreadable: it cannot be read.
    """
    found = fingerprint(path)
    if found != expected:
        raise VideoChanged(os.fspath(path), None, f"changed since it was catalogued: {found} instead of {expected}")
