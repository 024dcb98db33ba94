"""Which file a video is: what names its bytes, and a part of that name which can be checked without reading them all.

    <size in bytes>-<hash of head and tail>-<hash of every packet>

A folder of pictures has the size of its files, a hash of their names and sizes, and a hash of what they hold.

The whole name is known once the file has been probed, which reads it from end to end anyhow. What is opened later is
compared by the first two parts, and read whole only if its size or times changed (:mod:`v2v_server.store.verified`): a
worker that read everything would read a film for each two seconds of it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping

from v2v_protocol.errors import VideoChanged, VideoDenied, VideoGone, VideoUnreadable
from v2v_server.video.file_range import open_bytes

TIMES_ABOVE = ("../timestamps.txt", "../images.txt")
TIMES = ("timestamps.txt", "images.txt", *TIMES_ABOVE)
"""Files with the times of the pictures of a folder, by their places from there; the first that is found counts."""
CHANGED = "changed since it was catalogued"
"""The beginning of the reason of a video that is another one by now, wherever that was found."""
_BLOCK_BYTES = 64 * 1024


def fingerprint(path: str | os.PathLike[str]) -> str:
    """Size in bytes and a hash of the first and last 64 KiB: ``"<size>-<32 hexadecimal digits>"``; of a folder, see
    above.

    Raises:
        VideoUnreadable: the file cannot be read, or is not a regular file.
    """
    try:
        if os.path.isdir(path):
            return fingerprint_of({name: status.st_size for name, status in files_in(path)})
        with open_bytes(path) as file:
            digest = hashlib.sha256(b"v2v fingerprint 1\n" + file.read(_BLOCK_BYTES))
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _BLOCK_BYTES))
            digest.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise unreadable(os.fspath(path), error) from error
    return f"{size}-{digest.hexdigest()[:32]}"


def fingerprint_of(sizes: Mapping[str, int]) -> str:
    """Return the fingerprint of a folder of pictures from the sizes of its files, sorted by name."""
    digest = hashlib.sha256(f"{list(sizes.items())}".encode()).hexdigest()
    return f"{sum(sizes.values())}-{digest[:32]}"


def files_in(folder: str | os.PathLike[str]) -> list[tuple[str, os.stat_result]]:
    """Return the regular files of a folder of pictures, by name, and their status: those in it that are not hidden, and
    its :data:`TIMES`.

    Raises:
        OSError: it cannot be read.
    """
    with os.scandir(folder) as listing:
        found = [(entry.name, entry.stat()) for entry in listing if entry.name[0] != "." and entry.is_file()]
    return sorted(found + times_above(folder))


def times_above(folder: str | os.PathLike[str]) -> list[tuple[str, os.stat_result]]:
    """Return the :data:`TIMES_ABOVE` that there are, by name, and their status."""
    above = [(name, os.path.join(folder, name)) for name in TIMES_ABOVE]
    return [(name, os.stat(path)) for name, path in above if os.path.isfile(path)]


def file_state(status: os.stat_result) -> tuple[int, int, int, int]:
    """Return what changes when a file does: its size, the times of its last changes, and which file it is."""
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def unreadable(video: str, error: OSError) -> VideoUnreadable:
    """Return the error of a video whose file the system does not open."""
    kind = VideoUnreadable
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        kind = VideoGone
    elif isinstance(error, PermissionError):
        kind = VideoDenied
    return kind(video, None, f"cannot be read: {error.strerror or error}")


def is_same_file(one: str, other: str) -> bool:
    """Return whether two fingerprints can be of one file; a part that one of them lacks is not compared."""
    parts = list(zip(one.split("-"), other.split("-"), strict=False))
    return len(parts) > 1 and all(a == b for a, b in parts)


def check_content(path: str | os.PathLike[str], content: str, expected: str) -> None:
    """Compare the hash of all that a video stores with that of a fingerprint, if it has one.

    Raises:
        VideoChanged: it is another one.
    """
    # Bits and a rate that the user states follow.
    stated = (*expected.split("-", 2), "", "")[2].partition("@")[0].partition("~")[0]
    if stated not in ("", content):
        why = f"{CHANGED}: what it stores has the hash {content} instead of {stated}"
        raise VideoChanged(os.fspath(path), None, why)


def check_fingerprint(path: str | os.PathLike[str], expected: str, found: str = "") -> None:
    """Make sure that the file is the one that was catalogued, as far as its size, head and tail tell.

    Args:
        path: of the file.
        expected: its fingerprint in the catalogue.
        found: its fingerprint now; "" reads it.

    Raises:
        VideoChanged: it is another one now.
        VideoUnreadable: it cannot be read, or is not a regular file.
    """
    found = found or fingerprint(path)
    if not is_same_file(found, expected):
        raise VideoChanged(os.fspath(path), None, f"{CHANGED}: {found} instead of {expected}")
