"""The runs of videos that have cuts or empty parts, in columns: as tuples those of a million videos take 200 MB."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Runs = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch of a video without a cut and with something to see."""
_Int32 = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class CutVideos:
    """The videos whose one run is not the whole of them.

    Attributes:
        numbers: int32 [C], which videos, rising.
        bounds: int32 [C + 1]; the runs of the i-th are those at bounds[i] .. bounds[i + 1] - 1.
        first, end: int32 [R], first frame of each run, and the frame after its last.
    """

    numbers: _Int32
    bounds: _Int32
    first: _Int32
    end: _Int32

    @classmethod
    def of(cls, videos: Iterable[tuple[int, Runs]]) -> CutVideos:
        """From the number and the runs of each, by rising number."""
        numbers, bounds, first, end = array("i"), array("i", [0]), array("i"), array("i")
        for number, runs in videos:
            numbers.append(number)
            first.extend(start for start, _ in runs)
            end.extend(stop for _, stop in runs)
            bounds.append(len(first))
        return cls(*(np.array(column, np.int32) for column in (numbers, bounds, first, end)))

    @classmethod
    def unpacked(cls, packed: Mapping[str, bytes]) -> CutVideos:
        """Back from :meth:`packed`."""
        return cls(**{name: np.frombuffer(column, np.int32) for name, column in packed.items()})

    def packed(self) -> dict[str, bytes]:
        """The columns as plain bytes."""
        return {name: getattr(self, name).tobytes() for name in self.__slots__}

    def __len__(self) -> int:
        return len(self.numbers)

    def find(self, number: int) -> int | None:
        """The place among these of the video of that number; None if it is none of them."""
        place = int(self.numbers.searchsorted(number))
        return place if place < len(self) and self.numbers[place] == number else None

    def runs(self, number: int) -> Runs | None:
        """Of the video of that number; None if it is none of these."""
        if (place := self.find(number)) is None:
            return None
        those = slice(self.bounds[place], self.bounds[place + 1])
        return tuple(zip(self.first[those].tolist(), self.end[those].tolist(), strict=True))

    def longest(self) -> _Int32:
        """[C], frames of each one's longest run; 0 without any."""
        most = np.zeros(len(self), np.int32)
        np.maximum.at(most, self.owners(), self.end - self.first)
        return most

    def owners(self) -> _Int32:
        """[R], the place among these of the video that each run is of."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.bounds))
