"""Read what containers state and PyAV does not report: their size, tracks that begin late, and the form of the picture.

Sources: ISO/IEC 14496-12, 4.2 (boxes) and 12.1.4 (clean aperture); Dolby Vision Streams within the ISO Base Media File
Format, 3.2; RFC 8794, 4 (EBML); RFC 9559, 5 (Matroska); ISO/IEC 13818-1, 2.4.3 (transport stream).
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import BinaryIO

_WAY = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_STSD_HEAD_BYTES = 8
_ENTRY_HEAD_BYTES = 78
"""Of a visual sample entry, in front of its boxes; width and height lie at 24."""
_CLAP_BYTES = 32
_MOST_BOXES = 10_000
_ANY_END = 1 << 62
_ISO_KINDS = frozenset({b"ftyp", b"styp", b"moov", b"mdat", b"moof", b"free", b"skip", b"wide"})
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
TRANSPORT_BYTES = {188: 0, 192: 4, 204: 0}
"""Bytes of a packet of a transport stream, and those in front of its sync byte."""
_SYNC = 0x47
_TRANSPORT_PACKET = re.compile(rb"\x47([\x40-\x5f].)(?:[\x10-\x1f]|[\x30-\x3f](.))", re.DOTALL)
"""The beginning of a packet in which a packet of a track begins, behind an adaptation field of this length."""
_START_CODE, _VIDEO = b"\0\0\1", bytes(range(0xE0, 0xF0))
_PART_BYTES = 188 * 192 * 51 * 8
"""Whole packets of each size."""
_HEAD_BYTES = 1 << 20
_MATROSKA_DOLBY = re.compile(rb"dv[cv]C.{0,16}?\x41\xed[\x81-\xfe](.{5})", re.DOTALL)
"""The beginning of the configuration, as a mapping of block additions holds it."""
_DOLBY_KINDS = b"dvcC", b"dvvC", b"dvwC"
_NOT_LUMA_PROFILES = frozenset({5, 10, 20})
"""Profiles of Dolby Vision whose pictures are of IPT-PQ where no base layer is compatible with anything else."""


def clean_aperture(path: Path) -> tuple[Fraction, Fraction] | None:
    """Return width and height in pixels of the clean aperture of an MP4 or QuickTime file, the part that its ``clap``
    box asks to show, if it is smaller than the picture.

    Returns:
        None if it is the whole picture, or if the file has another format or is damaged.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        for head, kind, at in _boxes_of_entries(file):
            picture = Fraction(int.from_bytes(head[24:26], "big")), Fraction(int.from_bytes(head[26:28], "big"))
            file.seek(at)
            values = [int.from_bytes(file.read(4), "big") for _ in range(_CLAP_BYTES // 4)]
            if kind == b"clap" and values[1] and values[3]:
                width, height = Fraction(values[0], values[1]), Fraction(values[2], values[3])
                if 0 < width <= picture[0] and 0 < height <= picture[1] and (width, height) != picture:
                    return width, height
    return None


def dolby_vision_profile(path: str) -> int | None:
    """Return the profile of Dolby Vision that an MP4, QuickTime or Matroska file states, if its luma is not luma.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        records = [found[1] for found in _MATROSKA_DOLBY.finditer(file.read(_HEAD_BYTES))]
        for _, kind, at in _boxes_of_entries(file):
            if kind in _DOLBY_KINDS:
                file.seek(at)
                records.append(file.read(5))
    profiles = [record[2] >> 1 for record in records if len(record) == 5 and not record[4] >> 4]
    return next((profile for profile in profiles if profile in _NOT_LUMA_PROFILES), None)


def describe_cut(path: str) -> str:
    """Say that a file is shorter than it states itself; "" if it is whole, or states no size.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        size, head = os.fstat(file.fileno()).st_size, file.read(_HEAD_BYTES)
        stated = 0
        if head[:4] == b"RIFF" and head[4:8] != b"\xff\xff\xff\xff":
            stated = 8 + int.from_bytes(head[4:8], "little")
        elif head[:4] == _EBML and 0 < (at := head.find(_SEGMENT)) < len(head) - 12:
            length = 9 - head[at + 4].bit_length()  # the first bit that is set tells the bytes of the number
            digits = int.from_bytes(head[at + 4 : at + 4 + length], "big") & ((1 << 7 * length) - 1)
            if digits != (1 << 7 * length) - 1:  # all ones: unknown
                stated = at + 4 + length + digits
        elif head[4:8] in _ISO_KINDS:
            ends = (until for _, _, until in _boxes(file, 0, _ANY_END, _ISO_KINDS))
            stated = next((until for until in ends if size < until < _ANY_END), 0)
        elif (length := _transport_bytes(head)) and size % length:
            stated = size // length * length + length
    # A last byte of padding may be missing.
    return f"is truncated: {size:,} of at least {stated:,} bytes are there" if stated > size + 1 else ""


def count_transport_pictures(path: str) -> Counter[int]:
    """Count the packets of video that begin in a transport stream, by the number of their track (PID).

    A track that begins later than a demuxer looks is not listed when the file is opened.

    Raises:
        OSError: the file cannot be read.
    """
    found = Counter[int]()
    with open(path, "rb") as file:
        while data := file.read(_PART_BYTES):
            for packet in _TRANSPORT_PACKET.finditer(data):
                at = packet.end() + (packet[2][0] if packet[2] else 0)
                if data[at : at + 3] == _START_CODE and data[at + 3 : at + 4] in _VIDEO:
                    found[int.from_bytes(packet[1], "big") & 0x1FFF] += 1
    return found


def _transport_bytes(head: bytes) -> int:
    """Return the bytes of a packet of a transport stream; 0 of other files."""
    for length, before in TRANSPORT_BYTES.items():
        if head[before::length][:8] == bytes([_SYNC]) * 8:
            return length
    return 0


def _boxes_of_entries(file: BinaryIO) -> Iterator[tuple[bytes, bytes, int]]:
    """Yield (head of the sample entry, type, first byte of the content) of each box in a visual sample entry."""
    end = os.fstat(file.fileno()).st_size
    spans = [(0, end)]
    for kind in _WAY:
        skipped = _STSD_HEAD_BYTES * (kind == b"stsd")
        boxes = chain.from_iterable(list(_boxes(file, *span)) for span in spans)
        spans = [(at + skipped, until) for found, at, until in boxes if found == kind]
    for _, begin, until in [box for span in spans for box in _boxes(file, *span)]:
        file.seek(begin)
        head = file.read(_ENTRY_HEAD_BYTES)
        for kind, at, _ in list(_boxes(file, begin + _ENTRY_HEAD_BYTES, until)):
            yield head, kind, at


def _boxes(
    file: BinaryIO, begin: int, end: int, kinds: frozenset[bytes] | None = None
) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, first byte of the content, byte behind it) of each box, up to one of other ``kinds``."""
    for _ in range(_MOST_BOXES):
        file.seek(begin)
        head = file.read(16)
        size, at = int.from_bytes(head[:4], "big"), begin + 8
        if size == 1:
            size, at = int.from_bytes(head[8:16], "big"), begin + 16
        until = end if size == 0 else begin + size
        if len(head) < 8 or not at <= until <= end or (kinds is not None and head[4:8] not in kinds):
            return
        yield head[4:8], at, until
        if (begin := until) >= end:
            return
