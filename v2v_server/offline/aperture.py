"""Read the clean aperture of MP4 and QuickTime files: the part of the picture that their ``clap`` box asks to show.

ISO/IEC 14496-12, 4.2 (boxes) and 12.1.4 (clean aperture).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

_WAY = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_STSD_HEAD_BYTES = 8
_ENTRY_HEAD_BYTES = 78
"""Of a visual sample entry, in front of its boxes; width and height lie at 24."""
_CLAP_BYTES = 32
_MOST_BOXES = 10_000


def clean_aperture(path: Path) -> tuple[Fraction, Fraction] | None:
    """Return width and height in pixels of a file's clean aperture, if it is smaller than the picture.

    Returns:
        None if it is the whole picture, or if the file has another format or is damaged.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        end = os.fstat(file.fileno()).st_size
        return next(_apertures(file, 0, end, _WAY), None)


def _apertures(file: BinaryIO, begin: int, end: int, way: tuple[bytes, ...]) -> Iterator[tuple[Fraction, Fraction]]:
    for kind, at, until in _boxes(file, begin, end):
        if way and kind == way[0]:
            yield from _apertures(file, at + _STSD_HEAD_BYTES * (kind == b"stsd"), until, way[1:])
        elif not way:
            yield from _of_entry(file, at, until)


def _of_entry(file: BinaryIO, begin: int, end: int) -> Iterator[tuple[Fraction, Fraction]]:
    file.seek(begin)
    head = file.read(_ENTRY_HEAD_BYTES)
    picture = Fraction(int.from_bytes(head[24:26], "big")), Fraction(int.from_bytes(head[26:28], "big"))
    for kind, at, _ in _boxes(file, begin + _ENTRY_HEAD_BYTES, end):
        if kind != b"clap":
            continue
        file.seek(at)
        values = [int.from_bytes(file.read(4), "big") for _ in range(_CLAP_BYTES // 4)]
        if values[1] and values[3]:
            width, height = Fraction(values[0], values[1]), Fraction(values[2], values[3])
            if 0 < width <= picture[0] and 0 < height <= picture[1] and (width, height) != picture:
                yield width, height


def _boxes(file: BinaryIO, begin: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, first byte of the content, byte behind it) of each box."""
    for _ in range(_MOST_BOXES):
        file.seek(begin)
        head = file.read(16)
        size, at = int.from_bytes(head[:4], "big"), begin + 8
        if size == 1:
            size, at = int.from_bytes(head[8:16], "big"), begin + 16
        until = end if size == 0 else begin + size
        if len(head) < 8 or not at <= until <= end:
            return
        yield head[4:8], at, until
        begin = until
