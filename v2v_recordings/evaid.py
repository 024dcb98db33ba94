"""Read EVAID-R: ``event/*.txt`` (``t x y p``, us), ``gt/*.png``, ``timestamps.txt`` (us), ``shape.txt`` (``W H``)."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator
from pathlib import Path

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, Item, Picture, Progress, SensorSize
from v2v_recordings.text_events import NS_PER_UNIT, read_text_events

TIMES = "timestamps.txt"
SHAPE = "shape.txt"
PICTURES = (".png", ".jpg", ".jpeg")


def recognises(path: Path) -> bool:
    """Return whether the path is an archive with ``timestamps.txt`` and a folder ``event``."""
    if not (path.is_dir() or path.suffix.lower() == ".zip"):
        return False
    with Archive(path) as archive:
        return bool(_members(archive, "event", (".txt",))) and archive.find(TIMES) is not None


def read(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield the items of one recording. The event files are read in the order of their names.

    Raises:
        UsageError: a part is missing or malformed.
    """
    with Archive(path) as archive:
        events, pictures = _members(archive, "event", (".txt",)), _members(archive, "gt", PICTURES)
        times_us = archive.integers(archive.find(TIMES) or TIMES)
        if len(times_us) != len(pictures):
            raise UsageError(f"{path}: {len(pictures)} pictures in gt/, but {len(times_us)} times in {TIMES}")
        if (stated := archive.find(SHAPE)) is not None:
            shape = archive.integers(stated)
            if len(shape) != 2:
                raise UsageError(f"{path}: {SHAPE} holds {shape}, not `width height`")
            yield SensorSize(*shape)
        elif pictures:
            yield archive.size(pictures[0])
        total = sum(archive.bytes_of[member] for member in events + pictures)
        done = 0

        def advance(count: int) -> None:
            nonlocal done
            done += count
            progress(done, total)

        for member in events:
            with archive.open(member) as stream:
                yield from read_text_events(
                    stream, f"{path}: {member}", time_unit=options.time_unit or "us", advance=advance
                )
        for time_us, member in zip(times_us, pictures, strict=True):
            yield Picture(round(time_us * NS_PER_UNIT["us"]), archive.picture(member))
            advance(archive.bytes_of[member])


def _members(archive: Archive, folder: str, suffixes: tuple[str, ...]) -> list[str]:
    """Return the files in the folder of this name in numeric order: 2.txt before 10.txt."""
    found = [
        member
        for member in archive.bytes_of
        if posixpath.basename(posixpath.dirname(member)).lower() == folder and member.lower().endswith(suffixes)
    ]
    return sorted(found, key=lambda member: (len(member), member))
