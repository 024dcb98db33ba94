"""Read EVAID-R: ``event/*.txt`` (``t x y p``, us), ``gt/*.png``, ``timestamps.txt`` (us), ``shape.txt`` (``W H``)."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator
from pathlib import Path

from v2v_protocol.errors import UsageError
from v2v_recordings import archive as archives
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, Item, ReadProgress, SensorSize
from v2v_recordings.text_events import read_texts

_TIMES = "timestamps.txt"
SHAPE = "shape.txt"
PICTURES = (".png", ".jpg", ".jpeg")


def recognises(path: Path) -> bool:
    """Return whether the path is an archive with ``timestamps.txt`` and a folder ``event``."""
    return archives.holds(path, lambda archive: archive.named(_TIMES) and _members(archive, "event", (".txt",)))


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one recording. The event files are read in the order of their names.

    Raises:
        UsageError: a part is missing or malformed.
    """
    with Archive(path) as archive:
        times_us = archive.integers(archive.find(_TIMES) or _TIMES)
        events, pictures = _members(archive, "event", (".txt",)), _members(archive, "gt", PICTURES)
        if len(times_us) != len(pictures):
            raise UsageError(f"{path}: {len(pictures)} pictures in gt/, but {len(times_us)} times in {_TIMES}")
        if (stated := archive.find(SHAPE)) is not None:
            shape = archive.integers(stated)
            if len(shape) != 2:
                raise UsageError(f"{path}: {SHAPE} holds {shape}, not `width height`")
            yield SensorSize(*shape)
        elif pictures:
            yield archive.size(pictures[0])
        timed = [(1000 * time_us, member) for time_us, member in zip(times_us, pictures, strict=True)]
        yield from read_texts(archive, events, timed, options.time_unit or "us", progress)


def _members(archive: Archive, folder: str, suffixes: tuple[str, ...]) -> list[str]:
    """Return the files in the folder of this name in numeric order: 2.txt before 10.txt."""
    found = [
        member
        for member in archive.bytes_of
        if posixpath.basename(posixpath.dirname(member)).lower() == folder and member.lower().endswith(suffixes)
    ]
    return sorted(found, key=lambda member: (len(member), member))
