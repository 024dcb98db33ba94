"""The pieces of videos in columns: as tuples those of a million videos take 200 MB."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.scenes.scene import PIECE, Pieces, clip_pieces, firsts_of, sides_of

_Int32 = npt.NDArray[np.int32]


def encoded_pieces(pieces: Pieces, frames: int) -> bytes:
    """Return the pieces of a video of ``frames`` frames, encoded; empty if all of them are one without flags and bars.

    Args:
        pieces: from frame 0 on.
    """
    part = clip_pieces(pieces, 0, 0, frames)
    is_whole = len(part) == 1 and not part["flags"][0] and not sides_of(part).any()
    return b"" if is_whole else part.tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class SplitVideos:
    """The videos whose frames are not one piece without flags and bars.

    Attributes:
        numbers: int32 [C], which videos, rising.
        bounds: int32 [C + 1]; the pieces of the i-th video are those at bounds[i] .. bounds[i + 1] - 1.
        pieces: [P] of :data:`v2v_server.corpus.scenes.scene.PIECE`.
    """

    numbers: _Int32
    bounds: _Int32
    pieces: Pieces

    @classmethod
    def of(cls, encoded: Iterable[bytes]) -> SplitVideos:
        """Make it from what :func:`encoded_pieces` returns for every video."""
        each = list(encoded)
        return cls.select(np.frombuffer(b"".join(each), PIECE), np.array([len(one) for one in each]) // PIECE.itemsize)

    @classmethod
    def select(cls, pieces: Pieces, counts: npt.NDArray[np.integer]) -> SplitVideos:
        """Make it from the pieces of every video in columns.

        Args:
            pieces: [P] of all videos.
            counts: [N] number of each video's pieces; 0 for one piece without flags and bars.
        """
        numbers = np.flatnonzero(counts)
        bounds = np.concatenate(([0], np.cumsum(counts[numbers])))
        return cls(numbers.astype(np.int32), bounds.astype(np.int32), pieces)

    def __len__(self) -> int:
        return len(self.numbers)

    def find(self, number: int) -> int | None:
        """Return the place among these of the video with a number; None if it is not one of them."""
        place = int(self.numbers.searchsorted(number))
        return place if place < len(self) and self.numbers[place] == number else None

    def encoded(self, number: int) -> bytes:
        """Return the encoded pieces of the video with a number; empty if it is not one of these."""
        if (place := self.find(number)) is None:
            return b""
        return self.pieces[self.bounds[place] : self.bounds[place + 1]].tobytes()

    def between(self, first: int, end: int) -> SplitVideos:
        """Return those of the videos ``first`` .. ``end`` - 1."""
        low, high = self.numbers.searchsorted(np.array((first, end), np.int32)).tolist()  # int64 would convert them all
        bounds = self.bounds[low : high + 1]
        return SplitVideos(self.numbers[low:high], bounds - bounds[0], self.pieces[bounds[0] : bounds[-1]])

    def owners(self) -> npt.NDArray[np.int64]:
        """Return [P], the place among these of the video of each piece."""
        return np.repeat(np.arange(len(self)), np.diff(self.bounds))

    def firsts(self) -> npt.NDArray[np.int64]:
        """Return [P], the first frame of each piece."""
        firsts = firsts_of(self.pieces, 0)
        firsts[self.bounds[:-1]] = 0
        return firsts
