"""Finding the video files below a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

VIDEO_SUFFIXES = frozenset(
    (
        *(
            ".3gp",
            ".avi",
            ".flv",
            ".h264",
            ".h265",
            ".hevc",
            ".ivf",
            ".m2ts",
            ".m4v",
            ".mjpeg",
            ".mjpg",
            ".mkv",
            ".mov",
        ),
        *(".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".obu", ".ogv", ".ts", ".vob", ".webm", ".wmv", ".y4m"),
    )
)


def video_files(root: Path, refused: dict[str, str]) -> Iterator[str]:
    """Relative POSIX paths of the video files below ``root``, known by their suffixes.

    Links are followed; a link to a folder that it lies in is not. Hidden files and folders (".name") are passed over.

    Args:
        root: the folder.
        refused: receives, by relative path, why a folder or file cannot be taken in.
    """
    yield from _below(root, "", frozenset(), refused)


def _below(folder: Path, prefix: str, above: frozenset[tuple[int, int]], refused: dict[str, str]) -> Iterator[str]:
    try:
        here = folder.stat()
        with os.scandir(folder) as listing:
            entries = sorted(listing, key=lambda entry: entry.name)
    except OSError as error:
        refused[printable(prefix.rstrip("/") or ".")] = f"the folder cannot be read: {error.strerror or error}"
        return
    identity = (here.st_dev, here.st_ino)
    if identity in above:
        return
    for entry in entries:
        if entry.name.startswith("."):
            continue
        relative = prefix + entry.name
        try:
            is_folder, is_file = entry.is_dir(), entry.is_file()
        except OSError as error:  # a link that leads in a circle, or where this user may not look
            refused[printable(relative)] = f"cannot be looked at: {error.strerror or error}"
            continue
        if is_folder:
            yield from _below(folder / entry.name, f"{relative}/", above | {identity}, refused)
        elif os.path.splitext(entry.name)[1].lower() in VIDEO_SUFFIXES:
            if printable(relative) != relative:
                refused[printable(relative)] = "its name is not UTF-8 text or holds control characters; rename it"
            elif not is_file:
                refused[relative] = "is no regular file, or a link that leads nowhere"
            else:
                yield relative


def printable(name: str) -> str:
    """The name with everything escaped that is not UTF-8 text or is a control character."""
    if name.isascii() and name.isprintable():  # as nearly all are, and there may be a million of them
        return name
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    return "".join(c if ord(c) >= 32 else f"\\x{ord(c):02x}" for c in text)
