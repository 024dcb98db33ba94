"""The runs that scene "auto" divides videos into, and the sequences of a run.

A run is what a spec may read in one go: frames of one shot with one set of bars, without the pieces that are skipped.
Repeated frames do not count. Sequences begin at 0, L, 2L ... of each run. Of those that are still for three quarters,
and of the others that are quiet for half, shares are kept: which, depends on a hash of the video's number and the first
frame.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import Flag, Sides, sides_of
from v2v_server.corpus.videos import SplitVideos

_SKIPPED = {
    "fades": Flag.FADE,
    "black": Flag.BLACK,
    "white": Flag.WHITE,
    "combed": Flag.COMBED,
    "cuts": Flag.UNSEEN,  # there are most likely more of them
}
_Int64 = npt.NDArray[np.int64]


class Runs:
    """The pieces of videos that a spec with scene "auto" uses, and the runs that they form.

    Attributes:
        piece_first, piece_run: [U] first frame and run of each usable piece.
        piece_flags: [U], its flags.
        ends: [U], usable frames up to the end of each piece, of all videos together.
        first: [R], the usable frames before each run.
        frames: [R], usable frames of each run.
        owners: [R], place of its video.
        sides: [R, 4], bars.
    """

    def __init__(self, split: SplitVideos, spec: StreamSpec) -> None:
        pieces, kept = split.pieces, spec.kept_defects
        flags, owners, firsts = pieces["flags"], split.owners(), split.firsts()
        sides = sides_of(pieces) if "bars" not in kept else np.zeros((len(pieces), 4), np.uint16)
        skipped = (flags & sum(flag for kind, flag in _SKIPPED.items() if kind not in kept)) != 0
        repeated = (flags & (Flag.REPEAT if "duplicates" not in kept else 0)) != 0
        begins = skipped | (np.diff(owners, prepend=-1) != 0)
        begins[1:] |= skipped[:-1] | (sides[1:] != sides[:-1]).any(axis=1)
        if "cuts" not in kept:
            begins |= (flags & Flag.CUT) != 0
        usable = ~skipped & ~repeated
        runs, self.piece_run = np.unique(np.cumsum(begins)[usable], return_inverse=True)
        lengths = (pieces["end"] - firsts)[usable]
        self.piece_first, self.piece_flags = firsts[usable], flags[usable]
        self.ends: _Int64 = np.cumsum(lengths)
        at = np.searchsorted(self.piece_run, np.arange(len(runs)))  # the first piece of each run
        self.first: _Int64 = (self.ends - lengths)[at]
        self.frames: _Int64 = np.diff(np.concatenate((self.first, self.ends[-1:])))
        self.owners, self.sides = owners[usable][at], sides[usable][at]
        self._piece_begin = self.ends - lengths

    def frame(self, place: _Int64) -> _Int64:
        """Return which frames of their videos usable frames are, [n], by their places among all, [n]."""
        piece = self.ends.searchsorted(place, side="right")
        frames: _Int64 = self.piece_first[piece] + place - self._piece_begin[piece]
        return frames

    def flagged(self, flag: int, first: _Int64, count: _Int64) -> _Int64:
        """Return how many of ``count`` usable frames from each place ``first`` on have a flag, [n] all three."""
        has = (self.piece_flags & flag) != 0
        lengths = np.where(has, self.ends - self._piece_begin, 0)
        before = np.cumsum(lengths) - lengths

        def upto(place: _Int64) -> _Int64:
            piece = np.minimum(self.ends.searchsorted(place, side="right"), len(self.ends) - 1)
            found: _Int64 = before[piece] + np.where(has[piece], place + 1 - self._piece_begin[piece], 0)
            return found

        return upto(first + count - 1) - upto(first - 1)


class SplitSequences:
    """Sequences of divided videos.

    Args:
        split: these videos.
        whole: [C], how many sequences each would have if all its frames were one run.
        strides: [C], frames from the first of a sequence to the first of the next.
        spec: determines the frames of a sequence and what is done about defects.
        sizes: [C], a number of each video's picture size.
        suits: return whether a picture of the size of that number, less these bars, is large enough.

    Attributes:
        counts: [C], sequences of each video.
    """

    def __init__(
        self,
        split: SplitVideos,
        whole: _Int64,
        strides: _Int64,
        spec: StreamSpec,
        sizes: npt.NDArray[np.integer],
        suits: Callable[[int, Sides], bool],
    ) -> None:
        self._split, self._whole = split, whole
        self._strides = strides
        self._runs = runs = Runs(split, spec)
        each = np.maximum((runs.frames - 1) // strides[runs.owners], 0)
        each[whole[runs.owners] == 0] = 0
        barred = np.flatnonzero(runs.sides.any(axis=1))
        pictures = np.column_stack((sizes[runs.owners[barred]], runs.sides[barred]))
        kinds, kind = np.unique(pictures, axis=0, return_inverse=True)
        fits = np.array([suits(size, Sides(*sides)) for size, *sides in kinds.tolist()], bool)
        each[barred] *= fits[kind.ravel()]
        number = np.repeat(np.arange(len(each)), each)
        within = np.arange(len(number)) - np.repeat(np.cumsum(each) - each, each)
        owners = runs.owners[number]
        places = runs.first[number] + strides[owners] * within
        starts = runs.frame(places) if len(places) else places
        if min(spec.still_share, spec.quiet_share) < 1 and len(places):
            needed = strides[owners] + 1
            shares = np.where(2 * runs.flagged(Flag.QUIET, places, needed) >= needed, spec.quiet_share, 1.0)
            shares[4 * runs.flagged(Flag.STILL, places, needed) >= 3 * needed] = spec.still_share
            kept = (shares >= 1) | (_hash(split.numbers[owners], starts) < shares)
            owners, starts = owners[kept], starts[kept]
        found = np.bincount(owners, minlength=len(split)) if len(owners) else np.zeros(len(split), np.int64)
        self._begin = np.cumsum(found) - found
        self._starts = starts
        self.counts: _Int64 = np.minimum(found, spec.max_sequences_per_video)

    def start(self, video: int, place: int) -> int | None:
        """Return the first frame of a sequence of a video; None if the video is not divided."""
        at = self._split.find(video)
        return None if at is None else int(self._starts[self._begin[at] + place])

    def spoilt(self) -> int:
        """Return the number of sequences that are not where they would be if all frames were one run."""
        owners = np.repeat(np.arange(len(self.counts)), self.counts)
        within = np.arange(len(owners)) - np.repeat(np.cumsum(self.counts) - self.counts, self.counts)
        starts = self._starts[self._begin[owners] + within] if len(owners) else within
        strides = self._strides[owners]
        in_place = (starts % strides == 0) & (starts // strides < self._whole[owners])
        return int(self._whole.sum() - in_place.sum())

    def too_short(self) -> tuple[npt.NDArray[np.integer], _Int64]:
        """Return the videos without a sequence because they are divided, [n], and the frames of their longest runs."""
        longest = np.zeros(len(self._split), np.int64)
        np.maximum.at(longest, self._runs.owners, self._runs.frames)
        short = (self._whole > 0) & (self.counts == 0)
        return self._split.numbers[short], longest[short]


def _hash(numbers: npt.NDArray[np.integer], starts: _Int64) -> npt.NDArray[np.float64]:
    """Return a number from 0 up to 1 for each pair: the mixing function of SplitMix64 (Steele et al. 2014)."""
    mixed = numbers.astype(np.uint64) << np.uint64(32) ^ starts.astype(np.uint64)
    mixed += np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return (mixed ^ (mixed >> np.uint64(31))) * 2.0**-64
