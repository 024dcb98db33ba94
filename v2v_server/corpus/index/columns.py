"""Very many records side by side: one object for each column, not one for each video.

A million videos as objects take 850 MB and half a minute; as columns a tenth of that. An object of one is made when
somebody asks for it.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, chain, islice, pairwise
from operator import itemgetter
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.index.file import IndexRow

CHUNK = 4096
"""Records that are worked on at a time."""
_NUMBERS = ("states", "_frames", "_width", "_height", "_rate", "_codec", "_interlaced")
"""Columns that are arrays."""


class Texts(Sequence[str]):
    """Texts in one piece of memory, as UTF-8, which sorts as the texts do."""

    def __init__(self) -> None:
        self._utf8 = bytearray()
        self._ends = array("q", [0])
        self._changed: dict[int, str] = {}

    def extend(self, texts: Sequence[str]) -> None:
        """Adds texts at the end."""
        joined = "".join(texts)
        utf8 = joined.encode()
        lengths = map(len, texts) if len(utf8) == len(joined) else (len(text.encode()) for text in texts)
        self._ends.extend(islice(accumulate(lengths, initial=self._ends[-1]), 1, None))
        self._utf8 += utf8

    def packed(self) -> list[bytes]:
        """All of them as plain bytes, for :meth:`take_in`; equal for equal texts."""
        self.settle()
        return [bytes(self._utf8), self._ends.tobytes()]

    def take_in(self, utf8: bytes, ends: bytes) -> None:
        """Adds those of another's :meth:`packed` at the end."""
        self._ends.frombytes((np.frombuffer(ends, np.int64)[1:] + self._ends[-1]).tobytes())
        self._utf8 += utf8

    def change(self, place: int, text: str) -> None:
        """Puts another text there; :meth:`settle` makes it as small as the others."""
        self._changed[place] = text

    def settle(self) -> None:
        """Packs what was changed."""
        if self._changed:
            before = iter(self.part(0, len(self)))
            self._utf8, self._ends, self._changed = bytearray(), array("q", [0]), {}
            while chunk := list(islice(before, CHUNK)):
                self.extend(chunk)

    def part(self, start: int, end: int) -> list[str]:
        """Those at start .. end - 1."""
        first, last = self._ends[start], self._ends[end]
        utf8 = self._utf8[first:last]
        text, ends = utf8.decode(), self._ends[start : end + 1]
        if len(text) == len(utf8):
            found = [text[left - first : right - first] for left, right in pairwise(ends)]
        else:
            found = [utf8[left - first : right - first].decode() for left, right in pairwise(ends)]
        for place, changed in self._changed.items():
            if start <= place < end:
                found[place - start] = changed
        return found

    def find(self, text: str) -> int | None:
        """Where it is; None if it is not. They must be sorted."""
        place = bisect_left(self, text)
        return place if place < len(self) and self[place] == text else None

    def __len__(self) -> int:
        return len(self._ends) - 1

    @overload
    def __getitem__(self, at: int) -> str: ...

    @overload
    def __getitem__(self, at: slice) -> list[str]: ...

    def __getitem__(self, at: int | slice) -> str | list[str]:
        if isinstance(at, slice):
            start, end, step = at.indices(len(self))
            return self.part(start, max(start, end)) if step == 1 else [self[each] for each in range(start, end, step)]
        if not 0 <= at < len(self):
            raise IndexError(f"text {at} of {len(self)}")
        if at in self._changed:
            return self._changed[at]
        return self._utf8[self._ends[at] : self._ends[at + 1]].decode()


class Records(Sequence[IndexRow]):
    """Records of an index without frame indices, sorted by id.

    Attributes:
        ids, fingerprints: of each.
        states: size, mtime and ctime of each, one after the other; empty once nobody needs them any more.
        codecs: the names that occur; ``codec`` has the number of each record's.
        problems: why a record cannot be used, by place.
    """

    def __init__(self) -> None:
        self.ids, self.fingerprints = Texts(), Texts()
        self.codecs: dict[str, int] = {}
        self.problems: dict[int, str] = {}
        self.states = array("q")
        self._frames, self._width, self._height = array("q"), array("i"), array("i")
        self._rate, self._codec, self._interlaced = array("d"), array("i"), array("b")

    def extend(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Adds rows as the index has them: the attributes of :class:`IndexRow`, but for the last one."""
        place = len(self)
        ids, _, _, _, fingerprints, frames, widths, heights, rates, codecs, interlaced, problems = zip(
            *rows, strict=True
        )
        self.states.extend(chain.from_iterable(map(itemgetter(1, 2, 3), rows)))
        self.ids.extend(ids)
        self.fingerprints.extend(fingerprints)
        self._frames.extend(frames)
        self._width.extend(widths)
        self._height.extend(heights)
        self._rate.extend(rates if None not in rates else (math.nan if rate is None else rate for rate in rates))
        numbers = {codec: self._number(codec) for codec in sorted(set(codecs))}
        self._codec.extend(map(numbers.__getitem__, codecs))
        self._interlaced.extend(interlaced)
        if any(problems):
            self.problems.update((at, problem) for at, problem in enumerate(problems, place) if problem is not None)

    def packed(self) -> dict[str, Any]:
        """All of them as plain bytes, texts and numbers, for :meth:`take_in`."""
        return {
            "ids": self.ids.packed(),
            "fingerprints": self.fingerprints.packed(),
            "codecs": list(self.codecs),
            "problems": list(self.problems.items()),
            **{name: getattr(self, name).tobytes() for name in _NUMBERS},
        }

    def take_in(self, packed: Mapping[str, Any]) -> None:
        """Adds those of another's :meth:`packed` at the end."""
        place = len(self)
        self.ids.take_in(*packed["ids"])
        self.fingerprints.take_in(*packed["fingerprints"])
        for name in _NUMBERS:
            getattr(self, name).frombytes(packed[name])
        self.problems.update((place + at, problem) for at, problem in packed["problems"])
        numbers = [self._number(codec) for codec in packed["codecs"]]
        if numbers != list(range(len(numbers))):
            codec = np.frombuffer(self._codec, np.int32)[place:]
            codec[:] = np.array(numbers, np.int32)[codec]

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """What :meth:`extend` was given."""
        names, count = list(self.codecs), len(self)
        return zip(
            self.ids.part(0, count),
            self.states[::3],
            self.states[1::3],
            self.states[2::3],
            self.fingerprints.part(0, count),
            self._frames,
            self._width,
            self._height,
            (None if math.isnan(rate) else rate for rate in self._rate),
            map(names.__getitem__, self._codec),
            self._interlaced,
            map(self.problems.get, range(count)),
            strict=True,
        )

    def append(self, row: IndexRow) -> None:
        """Adds one."""
        self.extend([tuple(getattr(row, name) for name in IndexRow.__slots__[:-1])])

    def _number(self, codec: str) -> int:
        return self.codecs.setdefault(codec, len(self.codecs))

    def change(self, place: int, row: IndexRow) -> None:
        """Puts another record of the same id there; :meth:`Texts.settle` is due afterwards."""
        self.fingerprints.change(place, row.fingerprint)
        self._frames[place], self._width[place], self._height[place] = row.frames, row.width_px, row.height_px
        self._rate[place] = math.nan if row.frames_per_second is None else row.frames_per_second
        self._codec[place], self._interlaced[place] = self._number(row.codec), row.interlaced
        self.problems.pop(place, None)
        if row.problem is not None:
            self.problems[place] = row.problem

    @property
    def frames(self) -> npt.NDArray[np.int64]:
        """[N] of each."""
        return np.frombuffer(self._frames, np.int64)

    @property
    def width_px(self) -> npt.NDArray[np.int32]:
        """[N] of each."""
        return np.frombuffer(self._width, np.int32)

    @property
    def height_px(self) -> npt.NDArray[np.int32]:
        """[N] of each."""
        return np.frombuffer(self._height, np.int32)

    @property
    def frames_per_second(self) -> npt.NDArray[np.float64]:
        """[N] of each, NaN where unknown."""
        return np.frombuffer(self._rate, np.float64)

    @property
    def codec(self) -> npt.NDArray[np.int32]:
        """[N], number of each one's name."""
        return np.frombuffer(self._codec, np.int32)

    @property
    def interlaced(self) -> npt.NDArray[np.int8]:
        """[N], 1 where it is."""
        return np.frombuffer(self._interlaced, np.int8)

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, at: int) -> IndexRow: ...

    @overload
    def __getitem__(self, at: slice) -> list[IndexRow]: ...

    def __getitem__(self, at: int | slice) -> IndexRow | list[IndexRow]:
        if isinstance(at, slice):
            return [self[place] for place in range(*at.indices(len(self)))]
        rate = self._rate[at]
        return IndexRow(
            self.ids[at],
            0,
            fingerprint=self.fingerprints[at],
            frames=self._frames[at],
            width_px=self._width[at],
            height_px=self._height[at],
            frames_per_second=None if math.isnan(rate) else rate,
            codec=self.codec_name(at),
            interlaced=bool(self._interlaced[at]),
            problem=self.problems.get(at),
        )

    def codec_name(self, at: int) -> str:
        """FFmpeg's name of its format."""
        return next(islice(self.codecs, self._codec[at], None))


def merged(ids: Sequence[str], parts: Iterable[Mapping[str, Any]], unasked: list[str]) -> Records:
    """The record of each id; with a size of -1, which no file has, where there is none.

    Args:
        ids: sorted, each once.
        parts: of the index, :meth:`Records.packed`, sorted.
        unasked: receives the ids of all other records.
    """
    records, at = Records(), 0
    for packed in parts:
        part = Records()
        part.take_in(packed)
        asked = ids[at : (end := bisect_right(ids, part.ids[len(part) - 1], at))]
        at = end
        names = Texts()
        names.extend(asked)
        if names.packed() == packed["ids"]:
            records.take_in(packed)
        elif rows := list(joined(asked, part.rows(), unasked)):
            records.extend(rows)
    for start in range(at, len(ids), CHUNK):
        records.extend(list(joined(ids[start : start + CHUNK], iter(()), unasked)))
    return records


def joined(ids: Sequence[str], rows: Iterator[tuple[Any, ...]], unasked: list[str]) -> Iterator[tuple[Any, ...]]:
    """The row of each id, both sorted; with a size of -1, which no file has, where there is none.

    Args:
        unasked: receives the ids of all other rows.
    """
    nothing = (-1, 0, 0, "", 0, 0, 0, None, "", 0, None)
    row = next(rows, None)
    for id in ids:
        while row is not None and row[0] < id:
            unasked.append(row[0])
            row = next(rows, None)
        if row is not None and row[0] == id:
            yield row
            row = next(rows, None)
        else:
            yield id, *nothing
    while row is not None:
        unasked.append(row[0])
        row = next(rows, None)
