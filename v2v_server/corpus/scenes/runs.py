"""The usable runs of videos in columns: as tuples those of a million videos take 200 MB."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np
import numpy.typing as npt

Runs = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch of a video without a shot boundary and with something to see."""
_Int32 = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class SplitVideos:
    """The videos whose usable frames are not one run of all their frames.

    Attributes:
        numbers: int32 [C], which videos, rising.
        bounds: int32 [C + 1]; the runs of the i-th video are those at bounds[i] .. bounds[i + 1] - 1.
        first, end: int32 [R], first frame of each run, and the frame after its last.
    """

    numbers: _Int32
    bounds: _Int32
    first: _Int32
    end: _Int32

    @classmethod
    def of(cls, frames: Iterable[int], runs: Iterable[Runs]) -> SplitVideos:
        """Make it from the frames and the runs of every video."""
        each = list(runs)
        flat = np.array(list(chain.from_iterable(each)), np.int32).reshape(-1, 2)
        return cls.select(np.fromiter(frames, np.int64), flat, np.fromiter(map(len, each), np.int64))

    @classmethod
    def select(cls, frames: npt.NDArray[np.int64], runs: _Int32, counts: npt.NDArray[np.integer]) -> SplitVideos:
        """Make it from the runs of every video in columns.

        Args:
            frames: [N] of each video.
            runs: [R, 2] (first frame, frame after the last) of the runs of all videos.
            counts: [N] number of each video's runs.
        """
        is_whole = counts == 1
        ends = np.cumsum(counts)
        last = ends[is_whole] - 1
        is_whole[is_whole] = (runs[last, 0] == 0) & (runs[last, 1] == frames[is_whole])
        numbers = np.flatnonzero(~is_whole)
        bounds = np.concatenate(([0], np.cumsum(counts[numbers])))
        first, end = runs[np.repeat(~is_whole, counts)].T.copy()
        return cls(numbers.astype(np.int32), bounds.astype(np.int32), first, end)

    def __len__(self) -> int:
        return len(self.numbers)

    def find(self, number: int) -> int | None:
        """Return the place among these of the video with a number; None if it is not one of them."""
        place = int(self.numbers.searchsorted(number))
        return place if place < len(self) and self.numbers[place] == number else None

    def runs(self, number: int) -> Runs | None:
        """Return the runs of the video with a number; None if it is not one of these."""
        if (place := self.find(number)) is None:
            return None
        those = slice(self.bounds[place], self.bounds[place + 1])
        return tuple(zip(self.first[those].tolist(), self.end[those].tolist(), strict=True))

    def longest(self) -> _Int32:
        """Return [C], frames of each video's longest run; 0 without any."""
        most = np.zeros(len(self), np.int32)
        np.maximum.at(most, self.owners(), self.end - self.first)
        return most

    def owners(self) -> _Int32:
        """Return [R], the place among these of the video of each run."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.bounds))
