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
_UNREADABLE = (-1, 0, 0, "", 0, 0, 0, None, "", 0, "the index lost its record; start again to probe it")
"""The columns after the id where the index has no sound row. No file has a size of -1, so it is probed."""


class StringColumn(Sequence[str]):
    """Strings in one piece of memory.

    Args:
        utf8: uint8, their UTF-8 one after the other, which sorts as the strings do.
        ends: int64 [N + 1], 0 and the end of each.
    """

    def __init__(self, utf8: npt.NDArray[np.uint8], ends: npt.NDArray[np.int64]) -> None:
        self._utf8, self._ends = utf8, ends

    def where(self, mask: npt.NDArray[np.bool_]) -> StringColumn:
        """Return the strings at which the mask is set."""
        lengths = np.diff(self._ends)
        return StringColumn(self._utf8[np.repeat(mask, lengths)], _ends(lengths[mask]))

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
            utf8 = self._utf8[ends[0] : ends[-1]].tobytes()
            return [utf8[low - ends[0] : high - ends[0]].decode() for low, high in pairwise(ends)]
        if not 0 <= at < len(self):
            raise IndexError(f"string {at} of {len(self)}")
        return self._utf8[self._ends[at] : self._ends[at + 1]].tobytes().decode()


def _ends(lengths: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


@dataclass(frozen=True, slots=True, eq=False)
class VideoTable:
    """Rows of an index without frame indices, sorted by id.

    Attributes:
        ids, fingerprints: strings [N].
        states: int64 [N, 3], size in bytes, mtime and ctime in ns of each file when it was probed.
        frames, width_px, height_px: integers [N].
        frames_per_second: float64 [N], NaN where unknown.
        codec, problem: objects [N], strings; no problem is None.
        interlaced: bool [N].
    """

    ids: StringColumn
    states: npt.NDArray[np.int64]
    fingerprints: StringColumn
    frames: npt.NDArray[np.int64]
    width_px: npt.NDArray[np.int32]
    height_px: npt.NDArray[np.int32]
    frames_per_second: npt.NDArray[np.float64]
    codec: npt.NDArray[np.object_]
    interlaced: npt.NDArray[np.bool_]
    problem: npt.NDArray[np.object_]

    @classmethod
    def of(cls, rows: Iterable[tuple[Any, ...]]) -> VideoTable:
        """Make a table of rows of :meth:`v2v_server.corpus.index.file.Store.rows`.

        A damaged row becomes one that has to be probed, because SQLite accepts any type in any column.
        """
        ids, id_lengths, fingerprints, lengths = bytearray(), array("q"), bytearray(), array("q")
        states, frames, width, height, rate = array("q"), array("q"), array("i"), array("i"), array("d")
        codec, interlaced, problem = list[str](), array("b"), list[str | None]()
        columns: list[Any] = [
            ids,
            id_lengths,
            states,
            fingerprints,
            lengths,
            frames,
            width,
            height,
            rate,
            codec,
            interlaced,
            problem,
        ]
        left = iter(rows)
        while chunk := list(islice(left, CHUNK)):
            for part in _converted(chunk):
                for column, values in zip(columns, part, strict=True):
                    column.extend(values)
        return cls(
            StringColumn(np.frombuffer(ids, np.uint8), _ends(np.asarray(id_lengths))),
            np.asarray(states).reshape(-1, 3),
            StringColumn(np.frombuffer(fingerprints, np.uint8), _ends(np.asarray(lengths))),
            np.asarray(frames),
            np.asarray(width),
            np.asarray(height),
            np.asarray(rate),
            np.array(codec, object),
            np.frombuffer(interlaced, np.bool_),
            np.array(problem, object),
        )

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
        """Return one row, without its frame index."""
        size, mtime, ctime = self.states[at].tolist()
        rate = float(self.frames_per_second[at])
        return IndexRow(
            id=self.ids[at],
            size_bytes=size,
            mtime_ns=mtime,
            ctime_ns=ctime,
            fingerprint=self.fingerprints[at],
            frames=int(self.frames[at]),
            width_px=int(self.width_px[at]),
            height_px=int(self.height_px[at]),
            frames_per_second=None if math.isnan(rate) else rate,
            codec=self.codec[at],
            interlaced=bool(self.interlaced[at]),
            problem=self.problem[at],
        )


def _converted(rows: list[tuple[Any, ...]]) -> Iterator[tuple[Sequence[Any], ...]]:
    """Yield rows as columns in the order of the fields of :class:`VideoTable`, in as few parts as damage allows."""
    try:
        yield _columns(rows)
    except (TypeError, AttributeError, ValueError, OverflowError):
        if len(rows) == 1:
            yield _columns([(rows[0][0], *_UNREADABLE)])
        else:
            for row in rows:
                yield from _converted([row])


def _columns(rows: list[tuple[Any, ...]]) -> tuple[Sequence[Any], ...]:
    """Convert rows to columns.

    Raises:
        TypeError, AttributeError, ValueError, OverflowError: no probe writes such a row.
    """
    ids, sizes, mtimes, ctimes, fingerprints, frames, widths, heights, rates, codecs, interlaced, problems = zip(
        *rows, strict=True
    )
    usable = np.array([problem is None for problem in problems])
    numbers = array("q", frames), array("i", widths), array("i", heights)
    for column, most in zip(numbers, (LARGEST_FRAMES, LARGEST_SIDE_PX, LARGEST_SIDE_PX), strict=True):
        values = np.asarray(column)
        if (values < usable).any() or (values > most).any():
            raise ValueError
    rate = array("d", [math.nan if rate is None else rate for rate in rates])
    if (np.asarray(rate) < 0).any() or (np.asarray(rate) > _LARGEST_RATE).any():
        raise ValueError
    if not {0, 1}.issuperset(interlaced) or not {str, type(None)}.issuperset(map(type, problems)):
        raise ValueError
    utf8 = [[string.encode() for string in strings] for strings in (ids, fingerprints)]
    return (
        b"".join(utf8[0]),
        array("q", map(len, utf8[0])),
        array("q", chain.from_iterable(zip(sizes, mtimes, ctimes, strict=True))),
        b"".join(utf8[1]),
        array("q", map(len, utf8[1])),
        *numbers,
        rate,
        list(map(sys.intern, codecs)),
        array("b", interlaced),
        list(problems),
    )


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
