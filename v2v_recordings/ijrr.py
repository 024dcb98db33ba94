"""Read IJRR (Mueggler et al. 2017) in its text form, in a zip or a folder.

It consists of ``events.txt``, ``images.txt`` (``t path``) and PNGs. A single text file of events is read as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings import archive as archives
from v2v_recordings.archive import Archive
from v2v_recordings.items import ConvertOptions, Item, ReadProgress, to_ns
from v2v_recordings.text_events import read_texts

_EVENTS = "events.txt"
_IMAGES = "images.txt"
TEXT_SUFFIXES = (".txt", ".csv")


def recognises(path: Path) -> bool:
    """Return whether the path is a text file, or an archive with ``events.txt``."""
    is_text = path.is_file() and path.suffix.lower() in TEXT_SUFFIXES
    return is_text or archives.holds(path, lambda archive: archive.named(_EVENTS))


def read(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one recording.

    Raises:
        UsageError: a part is missing or malformed.
    """
    with Archive(path) as archive:
        events = path.name if archive.is_single else archive.find(_EVENTS)
        pictures = _listed_pictures(archive)
        if pictures:
            yield archive.size(pictures[0][1])
        yield from read_texts(archive, [events or _EVENTS], pictures, options.time_unit, progress)


def _listed_pictures(archive: Archive) -> list[tuple[int, str]]:
    """Return time (ns) and member of every line of ``images.txt``; an empty list without that file."""
    listing = archive.find(_IMAGES)
    if listing is None:
        return []
    with archive.open(listing) as stream:
        lines = stream.read().decode("utf-8-sig", "replace").splitlines()
    pictures = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        where = f"{archive.where(listing)}, line {number}"
        seconds, _, name = line.strip().partition(" ")
        try:
            t_ns = int(to_ns(np.array([float(seconds)]), where)[0])
        except ValueError:
            raise UsageError(f"{where}: {line!r} is not `seconds path`") from None
        member = listing[: -len(_IMAGES)] + name.strip().replace("\\", "/")
        if member not in archive.bytes_of:
            raise UsageError(f"{where} names {name.strip()}, which does not exist")
        pictures.append((t_ns, member))
    return pictures
