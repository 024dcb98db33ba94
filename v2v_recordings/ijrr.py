"""Read IJRR (Mueggler et al. 2017) in its text form, in a zip or a folder.

It consists of ``events.txt``, ``images.txt`` (``t path``) and PNGs. A single text file of events is read as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, Item, Picture, Progress, to_ns
from v2v_recordings.text_events import read_text_events

EVENTS = "events.txt"
IMAGES = "images.txt"
TEXT_SUFFIXES = (".txt", ".csv")


def recognises(path: Path) -> bool:
    """Return whether the path is a text file, or an archive with ``events.txt``."""
    if path.is_file() and path.suffix.lower() in TEXT_SUFFIXES:
        return True
    if not (path.is_dir() or path.suffix.lower() == ".zip"):
        return False
    with Archive(path) as archive:
        return archive.find(EVENTS) is not None


def read(path: Path, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    """Yield the items of one recording.

    Raises:
        UsageError: a part is missing or malformed.
    """
    if path.is_file() and path.suffix.lower() in TEXT_SUFFIXES:
        total, done = path.stat().st_size, 0

        def advance(count: int) -> None:
            nonlocal done
            done += count
            progress(done, total)

        try:
            with path.open("rb") as stream:
                yield from read_text_events(stream, str(path), time_unit=options.time_unit, advance=advance)
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror or error}") from error
        return
    with Archive(path) as archive:
        yield from _read_archive(archive, options, progress)


def _read_archive(archive: Archive, options: ConvertOptions, progress: Progress) -> Iterator[Item]:
    events = archive.find(EVENTS)
    if events is None:
        raise UsageError(f"{archive.path} has no {EVENTS}")
    pictures = _listed_pictures(archive)
    total = archive.bytes_of[events] + sum(archive.bytes_of[member] for _, member in pictures)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total)

    if pictures:
        yield archive.size(pictures[0][1])
    with archive.open(events) as stream:
        yield from read_text_events(stream, f"{archive.path}: {events}", time_unit=options.time_unit, advance=advance)
    for t_ns, member in pictures:
        yield Picture(t_ns, archive.picture(member))
        advance(archive.bytes_of[member])


def _listed_pictures(archive: Archive) -> list[tuple[int, str]]:
    """Return time (ns) and member of every line of ``images.txt``; an empty list without that file."""
    listing = archive.find(IMAGES)
    if listing is None:
        return []
    with archive.open(listing) as stream:
        lines = stream.read().decode("utf-8", "replace").splitlines()
    folder = listing[: -len(IMAGES)]
    pictures = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        parts = line.split(maxsplit=1)
        try:
            seconds = float(parts[0])
        except ValueError:
            seconds = np.nan
        if len(parts) != 2 or not np.isfinite(seconds):
            raise UsageError(f"{archive.path}: {listing}, line {number}: {line!r} is not `seconds path`")
        member = folder + parts[1].strip()
        if member not in archive.bytes_of:
            raise UsageError(f"{archive.path}: {listing}, line {number} names {parts[1].strip()}, which does not exist")
        pictures.append((int(to_ns(np.array([seconds]), f"{archive.path}: {listing}, line {number}")[0]), member))
    return pictures
