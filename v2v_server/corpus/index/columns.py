"""The table of videos in memory: one array for each column, not one object for each video.

A million videos as objects take 850 MB and half a minute; as columns a tenth of that.
"""

from __future__ import annotations

import math
import sys
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.index.file import IndexRow
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_SIDE_PX

CHUNK = 4096
"""Rows that are converted at a time."""
_LARGEST_RATE = 1e9
_NUMBER_TYPES = "qqqqiidb"
"""Types of size, mtime, ctime, frames, width, height, rate and interlaced, in the letters of :mod:`array` and NumPy."""
_UNREADABLE = (-1, 0, 0, "", 0, 0, 0, None, "", 0, "the index lost its record; start again to probe it", "", None)
"""The columns after the id where the index has no sound row. No file has a size of -1, so it is probed."""


class StringColumn(Sequence[str]):
    """Strings in one piece of memory.

    Args:
        utf8: their UTF-8 one after the other, which sorts as the strings do; or bytes that are never read as strings.
        lengths: integers [N], the bytes of each.
    """

    def __init__(self, utf8: bytes | bytearray | memoryview, lengths: npt.NDArray[np.integer]) -> None:
        self.utf8 = np.frombuffer(utf8, np.uint8)
        self._ends = np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))

    @property
    def lengths(self) -> npt.NDArray[np.int64]:
        """[N], the bytes of each."""
        return np.diff(self._ends)

    def where(self, mask: npt.NDArray[np.bool_]) -> StringColumn:
        """Return the strings at which the mask is set."""
        if mask.all():
            return self
        return StringColumn(self.utf8[np.repeat(mask, self.lengths)].data, self.lengths[mask])

    def find(self, string: str) -> int | None:
        """Return the position of a string in a sorted column; None if it is missing."""
        position = bisect_left(self, string)
        return position if position < len(self) and self[position] == string else None

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __iter__(self) -> Iterator[str]:
        for start in range(0, len(self), CHUNK):
            yield from self[start : start + CHUNK]

    @overload
    def __getitem__(self, at: int) -> str: ...

    @overload
    def __getitem__(self, at: slice) -> list[str]: ...

    def __getitem__(self, at: int | slice) -> str | list[str]:
        if isinstance(at, slice):
            start, end, step = at.indices(len(self))
            if step != 1:
                return [self[each] for each in range(start, end, step)]
            ends = self._ends[start : max(start, end) + 1].tolist()
            utf8, offset = self.utf8[ends[0] : ends[-1]].tobytes(), ends[0]
            if utf8.isascii():
                text = utf8.decode()
                return [text[low - offset : high - offset] for low, high in pairwise(ends)]
            return [utf8[low - offset : high - offset].decode() for low, high in pairwise(ends)]
        if not 0 <= at < len(self):
            raise IndexError(f"string {at} of {len(self)}")
        return self.utf8[self._ends[at] : self._ends[at + 1]].tobytes().decode()


NO_STRINGS = StringColumn(b"", np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class VideoTable:
    """Rows of an index without frame indices, sorted by id.

    Attributes:
        ids, fingerprints: strings [N].
        frames, width_px, height_px: integers [N].
        frames_per_second: float64 [N], NaN where unknown.
        interlaced: bool [N].
        codec, remark, problem: objects [N], strings; no problem is None.
        summaries: bytes [N], of the figures that were asked for; empty where there are none.
    """

    ids: StringColumn
    fingerprints: StringColumn
    frames: npt.NDArray[np.int64]
    width_px: npt.NDArray[np.int32]
    height_px: npt.NDArray[np.int32]
    frames_per_second: npt.NDArray[np.float64]
    interlaced: npt.NDArray[np.bool_]
    codec: npt.NDArray[np.object_]
    remark: npt.NDArray[np.object_]
    problem: npt.NDArray[np.object_]
    summaries: StringColumn

    @classmethod
    def read(cls, rows: Iterable[tuple[Any, ...]], count: int) -> tuple[VideoTable, npt.NDArray[np.int64]]:
        """Make a table of rows of :meth:`v2v_server.corpus.index.file.Store.rows`.

        A damaged row becomes one that has to be probed, because SQLite accepts any type in any column.

        Args:
            rows: sorted by id.
            count: N, the number of rows.

        Returns:
            the table, and [N, 3] the size in bytes, mtime and ctime in ns of each file when it was probed.
        """
        strings, start, left = (bytearray(), bytearray(), bytearray()), 0, iter(rows)
        # Allocated once: arrays that grow leave holes in the heap, a third of their size.
        columns = [np.empty(count, dtype) for dtype in ("i", "i", "i", *_NUMBER_TYPES, "O", "O", "O")]
        while chunk := list(islice(left, CHUNK)):
            for utf8, *part in _converted(chunk):
                for string, more in zip(strings, utf8, strict=True):
                    string += more
                end = start + len(part[0])
                for column, values in zip(columns, part, strict=True):
                    column[start:end] = values
                start = end
        ids, fingerprints, summaries = map(StringColumn, strings, columns[:3])
        size, mtime, ctime, frames, width, height, rate, interlaced, codec, remark, problem = columns[3:]
        numbers = frames, width, height, rate, interlaced.view(np.bool_)
        return cls(ids, fingerprints, *numbers, codec, remark, problem, summaries), np.stack((size, mtime, ctime), 1)

    def where(self, mask: npt.NDArray[np.bool_]) -> VideoTable:
        """Return the rows at which the mask is set."""
        if mask.all():
            return self
        columns: list[Any] = [getattr(self, name) for name in self.__slots__]
        columns = [column.where(mask) if isinstance(column, StringColumn) else column[mask] for column in columns]
        return VideoTable(*columns)

    def __len__(self) -> int:
        return len(self.frames)

    def row(self, at: int) -> IndexRow:
        """Return one row, without the state of its file and its frame index."""
        rate = float(self.frames_per_second[at])
        return IndexRow(
            id=self.ids[at],
            size_bytes=-1,
            fingerprint=self.fingerprints[at],
            frames=int(self.frames[at]),
            width_px=int(self.width_px[at]),
            height_px=int(self.height_px[at]),
            frames_per_second=None if math.isnan(rate) else rate,
            codec=self.codec[at],
            interlaced=bool(self.interlaced[at]),
            remark=self.remark[at],
            problem=self.problem[at],
        )


def _converted(rows: list[tuple[Any, ...]]) -> Iterator[tuple[Any, ...]]:
    """Yield rows as columns, in as few parts as damage allows."""
    try:
        yield _columns(rows)
    except (TypeError, ValueError, OverflowError):
        if len(rows) == 1:
            yield _columns([(rows[0][0], *_UNREADABLE)])
        else:
            for row in rows:
                yield from _converted([row])


def _columns(rows: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Convert rows to columns: the bytes of ids, fingerprints and summaries, their lengths, numbers, formats, problems.

    Raises:
        TypeError, ValueError, OverflowError: no probe writes such a row.
    """
    columns = tuple(zip(*rows, strict=True))
    ids, sizes, mtimes, ctimes, fingerprints, frames, widths, heights, rates = columns[:9]
    codecs, interlaced, problems, remarks, summaries = columns[9:]
    if None in rates:
        rates = tuple(math.nan if rate is None else rate for rate in rates)
    values = sizes, mtimes, ctimes, frames, widths, heights, rates, interlaced
    numbers = tuple(array(code, column) for code, column in zip(_NUMBER_TYPES, values, strict=True))
    # Only a row with a problem may have no frames.
    least = np.array([problem is None for problem in problems]) if any(problems) else 1
    limits = (least, LARGEST_FRAMES), (least, LARGEST_SIDE_PX), (least, LARGEST_SIDE_PX), (0, _LARGEST_RATE), (0, 1)
    for column, (low, high) in zip(map(np.asarray, numbers[3:]), limits, strict=True):
        if (column < low).any() or (column > high).any():
            raise ValueError
    if not {str, type(None)}.issuperset(map(type, problems)):
        raise TypeError
    blobs = [summary if isinstance(summary, bytes) else b"" for summary in summaries]
    strings = _utf8(ids), _utf8(fingerprints), (b"".join(blobs), array("i", map(len, blobs)))
    utf8, lengths = zip(*strings, strict=True)
    return utf8, *lengths, *numbers, list(map(sys.intern, codecs)), list(map(sys.intern, remarks)), problems


def _utf8(strings: Sequence[str]) -> tuple[bytes, array[int]]:
    """Return strings as UTF-8 in one piece, and the bytes of each."""
    text = "".join(strings)
    if text.isascii():
        return text.encode(), array("i", map(len, strings))
    encoded = [string.encode() for string in strings]
    return b"".join(encoded), array("i", map(len, encoded))


def joined(
    ids: Sequence[str], rows: Iterable[tuple[Any, ...]], unasked: list[str], missing: tuple[Any, ...] = _UNREADABLE
) -> Iterator[tuple[Any, ...]]:
    """Yield the row of each id.

    Args:
        ids: sorted, each once.
        rows: sorted by their first column, the id.
        unasked: receives the ids of all other rows.
        missing: the columns after the id where there is no row.
    """
    left = iter(rows)
    row = next(left, None)
    for id in ids:
        while row is not None and row[0] < id:
            unasked.append(row[0])
            row = next(left, None)
        if row is not None and row[0] == id:
            yield row
            row = next(left, None)
        else:
            yield id, *missing
    if row is not None:
        unasked += [row[0] for row in chain((row,), left)]
