"""Read text files of events: one ``t x y p`` per line; the first line may be ``width height``.

Polarities are 0 and 1, false and true, or as :data:`~v2v_recordings.event_columns.POLARITY_CODES`. Spaces, tabs or
commas separate values. Lines that begin with ``#`` are comments. A byte order mark is skipped.

IJRR (Mueggler et al. 2017) has such a text, ``events.txt``, in a zip or folder with ``images.txt`` (``t path``) and
PNGs. A single text file of events is read as well. EVAID-R has ``event/*.txt`` (us), ``gt/*.png``, ``timestamps.txt``
(us) and ``shape.txt`` (``W H``).
"""

from __future__ import annotations

import codecs
import io
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.archive import Archive, holds
from v2v_recordings.event_columns import EventColumns, TimeUnit, to_ns
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, ReadProgress, SensorSize

BLOCK_BYTES = 1 << 22
COMMENT = re.compile(rb"^[ \t]*#[^\r\n]*", re.MULTILINE)
COMMA = re.compile(rb"(?<=[^\s,])[ \t]*,[ \t]*(?=[^\s,])")
TRUE_OR_FALSE = re.compile(rb"\b(false|true)\b", re.IGNORECASE)
TIME_WITH_A_FRACTION = re.compile(rb"^[ \t]*[-+\d]*(\.|[eE]-)", re.MULTILINE)
"""Matches a line whose first number has a decimal point, or a negative exponent without one (1e-06)."""


def read_texts(
    archive: Archive, events: list[str], pictures: list[tuple[int, str]], unit: TimeUnit | None, progress: ReadProgress
) -> Iterator[Item]:
    """Yield the events of an archive's texts, one text after the other, then its pictures.

    Args:
        pictures: times, ns, and members.
        unit: see :func:`read_text_events`.

    Raises:
        UsageError: a member is missing or malformed; or see :class:`EventColumns`.
    """
    read = EventColumns("", unit)
    done, total = 0, sum(archive.bytes_of.get(member, 0) for member in (*events, *(name for _, name in pictures)))
    for member in events:
        with archive.open(member) as stream:
            for item in read_text_events(stream, archive.where(member), read):
                progress(done + stream.tell(), total)
                yield item
        done += archive.bytes_of[member]
    yield from read.end()
    for t_ns, member in pictures:
        yield Picture(t_ns, archive.picture(member))
        done += archive.bytes_of[member]
        progress(done, total)


def read_text_events(
    stream: IO[bytes], name: str, columns: EventColumns | None = None
) -> Iterator[SensorSize | EventChunk | Note]:
    """Yield the sensor's size, if the file states it, and chunks of events. A last line that is truncated is left out.

    Args:
        stream: the file's bytes; read in blocks of 4 MiB.
        name: name of the file, for messages.
        columns: what earlier texts told. Without a unit it gets seconds if any time in the first block has a decimal
            point, else us. The first time alone is not enough: ``%g`` writes 0 and 1e-06.

    Raises:
        UsageError: a line is not four numbers (the message gives its number and text); or see :class:`EventColumns`.
    """
    columns = columns or EventColumns(name)
    columns.where = name
    lines_before, rest, has_begun = 0, stream.read(len(codecs.BOM_UTF8)).removeprefix(codecs.BOM_UTF8), False
    while True:
        read = stream.read(BLOCK_BYTES)
        # All whole lines; the last one may have no end.
        whole, newline, rest = (rest + read).rpartition(b"\n") if read else (rest, b"", b"")
        block = _plain(whole + newline)
        lines = block.count(b"\n")
        if not has_begun and (begun := block.lstrip()):
            has_begun = True
            first, _, after = begun.partition(b"\n")
            if len(first.split()) == 2:
                yield _sensor_size(first, name)
                lines_before += lines - after.count(b"\n")
                block, lines = after, after.count(b"\n")
        if block.strip():
            columns.unit = columns.unit or TimeUnit("s" if TIME_WITH_A_FRACTION.search(block) else "us")
            values = _numbers(block)
            if values is None and lines_before and not read:
                yield Note(f"cut: line {lines_before + 1}, the last, is incomplete ({_shown(block)}) and left out")
                return
            if values is None:
                raise UsageError(_first_bad_line(block, name, lines_before))
            yield columns.part(*values.T)
        if not read:
            return
        lines_before += lines


def _plain(block: bytes) -> bytes:
    """Blank comments, and replace single commas between values by spaces. The number of lines stays the same.

    A comma next to an empty field stays, so that its line is refused.
    """
    if b"#" in block:
        block = COMMENT.sub(b"", block)
    return COMMA.sub(b" ", block) if b"," in block else block


def _sensor_size(line: bytes, name: str) -> SensorSize:
    try:
        width, height = map(int, line.split())
    except ValueError:
        raise UsageError(f"{name}: the first line is {line!r}, neither `t x y p` nor `width height`") from None
    return SensorSize(width, height)


def _numbers(block: bytes) -> npt.NDArray[np.float64] | None:
    """Parse a block to [N, 4]; None unless its lines are four finite numbers with integer coordinates, or blank."""
    try:
        table = np.loadtxt(io.StringIO(block.decode("latin-1")), ndmin=2)
    except ValueError:
        numbers = TRUE_OR_FALSE.sub(lambda word: b"01"[len(word[0]) == 4 :][:1], block)
        return None if numbers == block else _numbers(numbers)
    if table.shape[1] != 4 or not np.isfinite(table).all():
        return None
    return table if (table[:, 1:3] == np.rint(table[:, 1:3])).all() else None


def _shown(line: bytes) -> str:
    return repr(line[:60].decode("ascii", "replace"))


def _first_bad_line(block: bytes, name: str, lines_before: int) -> str:
    for number, line in enumerate(block.splitlines(), start=lines_before + 1):
        if line.strip() and _numbers(line) is None:
            return f"{name}, line {number}: {_shown(line)} is not `t x y p` with whole x and y"
    return f"{name}: the lines after {lines_before} are not `t x y p`"


_EVENTS = "events.txt"
_IMAGES = "images.txt"
TEXT_SUFFIXES = (".txt", ".csv")


def recognises_ijrr(path: Path) -> bool:
    """Return whether the path is a text file, or an archive with ``events.txt``."""
    is_text = path.is_file() and path.suffix.lower() in TEXT_SUFFIXES
    return is_text or holds(path, lambda archive: archive.named(_EVENTS))


def read_ijrr(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one recording.

    Raises:
        UsageError: a part is missing or malformed.
    """
    with Archive(path) as archive:
        events = path.name if archive.is_single else archive.find(_EVENTS)
        pictures = _listed_pictures(archive)
        if pictures:
            yield archive.size(pictures[0][1])
        unit = None if options.time_unit is None else TimeUnit.of(options, "s")
        yield from read_texts(archive, [events or _EVENTS], pictures, unit, progress)


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


_EVAID_TIMES = "timestamps.txt"
SHAPE = "shape.txt"
PICTURES = (".png", ".jpg", ".jpeg")


def recognises_evaid(path: Path) -> bool:
    """Return whether the path is an archive with ``timestamps.txt`` and a folder ``event``."""
    return holds(path, lambda archive: archive.named(_EVAID_TIMES) and _evaid_members(archive, "event", (".txt",)))


def read_evaid(path: Path, options: ConvertOptions, progress: ReadProgress) -> Iterator[Item]:
    """Yield the items of one recording. The event files are read in the order of their names.

    Raises:
        UsageError: a part is missing or malformed.
    """
    with Archive(path) as archive:
        times_us = archive.integers(archive.find(_EVAID_TIMES) or _EVAID_TIMES)
        events, pictures = _evaid_members(archive, "event", (".txt",)), _evaid_members(archive, "gt", PICTURES)
        if len(times_us) != len(pictures):
            raise UsageError(f"{path}: {len(pictures)} pictures in gt/, but {len(times_us)} times in {_EVAID_TIMES}")
        if (stated := archive.find(SHAPE)) is not None:
            shape = archive.integers(stated)
            if len(shape) != 2:
                raise UsageError(f"{path}: {SHAPE} holds {shape}, not `width height`")
            yield SensorSize(*shape)
        elif pictures:
            yield archive.size(pictures[0])
        timed = [(1000 * time_us, member) for time_us, member in zip(times_us, pictures, strict=True)]
        yield from read_texts(archive, events, timed, TimeUnit.of(options, "us"), progress)


def _evaid_members(archive: Archive, folder: str, suffixes: tuple[str, ...]) -> list[str]:
    """Return the files in the folder of this name in numeric order: 2.txt before 10.txt."""
    found = [
        member
        for member in archive.bytes_of
        if posixpath.basename(posixpath.dirname(member)).lower() == folder and member.lower().endswith(suffixes)
    ]
    return sorted(found, key=lambda member: (len(member), member))
