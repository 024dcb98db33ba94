"""Read text files of events: one ``t x y p`` per line, p in {0, 1} or {-1, 1}; the first line may be ``width height``.

Spaces, tabs or commas separate values. Lines that begin with ``#`` are comments. A byte order mark is skipped.
"""

from __future__ import annotations

import codecs
import re
import warnings
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import EventChunk, Note, SensorSize, to_ns

BLOCK_BYTES = 1 << 22
COMMENT = re.compile(rb"^[ \t]*#[^\r\n]*", re.MULTILINE)
COMMA = re.compile(rb"(?<=[^\s,])[ \t]*,[ \t]*(?=[^\s,])")
NS_PER_UNIT = {"s": 1e9, "us": 1e3, "ns": 1.0}
TIME_WITH_A_FRACTION = re.compile(rb"^[ \t]*[-+\d]*(\.|[eE]-)", re.MULTILINE)
"""Matches a line whose first number has a decimal point, or a negative exponent without one (1e-06)."""


def read_text_events(
    stream: IO[bytes],
    name: str,
    *,
    time_unit: str | None = None,
    advance: Callable[[int], None] = lambda _bytes: None,
) -> Iterator[SensorSize | EventChunk | Note]:
    """Yield the sensor's size, if the file states it, and chunks of events. A last line that was cut is left out.

    Args:
        stream: the file's bytes; read in blocks of 4 MiB.
        name: name of the file, for messages.
        time_unit: "s", "us" or "ns"; None takes seconds if any time in the first block has a decimal point, else us.
            The first time alone is not enough: ``%g`` writes 0 and 1e-06.
        advance: called with the size of each block in bytes.

    Raises:
        UsageError: a line is not four numbers (the message gives its number and text), or the times have another unit.
    """
    if time_unit is not None and time_unit not in NS_PER_UNIT:
        raise UsageError(f"time unit {time_unit!r}: give one of {', '.join(NS_PER_UNIT)}")
    lines_before, rest, started, is_head = 0, b"", False, True
    while block := stream.read(BLOCK_BYTES):
        advance(len(block))
        if is_head:
            block, is_head = block.removeprefix(codecs.BOM_UTF8), False
        whole, newline, rest = (rest + block).rpartition(b"\n")
        block = _plain(whole + newline)
        if not started and (begun := block.lstrip()):
            first, _, after = begun.partition(b"\n")
            started = True
            if len(first.split()) == 2:
                yield _sensor_size(first, name)
                lines_before += block.count(b"\n") - after.count(b"\n")
                block = after
        if time_unit is None:
            time_unit = _time_unit(block)
        yield from _chunk(block, name, lines_before, time_unit)
        lines_before += block.count(b"\n")
    rest = _plain(rest)
    if lines_before and rest.strip() and _numbers(rest) is None:
        yield Note(f"cut: line {lines_before + 1}, the last, is incomplete ({_shown(rest)}) and left out")
        return
    yield from _chunk(rest, name, lines_before, time_unit or _time_unit(rest) or "us")


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


def _time_unit(block: bytes) -> str | None:
    """Return the time unit of the events in a block, "s" or "us"; None if the block has no events."""
    if not block.strip():
        return None
    return "s" if TIME_WITH_A_FRACTION.search(block) else "us"


def _chunk(block: bytes, name: str, lines_before: int, time_unit: str | None) -> Iterator[EventChunk]:
    if not block.strip():
        return
    values = _numbers(block)
    if values is None:
        raise UsageError(_first_bad_line(block, name, lines_before))
    t, x, y, p = values.T
    yield EventChunk(to_ns(t, name, NS_PER_UNIT[time_unit or "us"]), x.astype(np.int32), y.astype(np.int32), p > 0)


def _numbers(block: bytes) -> npt.NDArray[np.float64] | None:
    """Parse a block to [N, 4]; None unless it is N lines of four finite numbers with integer coordinates."""
    with warnings.catch_warnings():
        # For text that it cannot parse to the end, NumPy warns in some releases and raises in others.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values = np.fromstring(block, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return None
    lines = block.count(b"\n") + (not block.endswith(b"\n"))
    if len(values) != 4 * lines or not np.isfinite(values).all():
        # Blank lines are allowed.
        kept = [line for line in block.splitlines() if line.strip()]
        if len(values) != 4 * len(kept) or not all(len(line.split()) == 4 for line in kept):
            return None
        if not np.isfinite(values).all():
            return None
    table: npt.NDArray[np.float64] = values.reshape(-1, 4)
    coordinates = table[:, 1:3]
    if (coordinates != np.rint(coordinates)).any() or not np.isin(table[:, 3], (-1, 0, 1)).all():
        return None
    return table


def _shown(line: bytes) -> str:
    return repr(line[:60].decode("ascii", "replace"))


def _first_bad_line(block: bytes, name: str, lines_before: int) -> str:
    for number, line in enumerate(block.splitlines(), start=lines_before + 1):
        if line.strip() and (len(line.split()) != 4 or _numbers(line) is None):
            return f"{name}, line {number}: {_shown(line)} is not `t x y p` with whole x and y and p of -1, 0 or 1"
    return f"{name}: the lines after {lines_before} are not `t x y p`"
