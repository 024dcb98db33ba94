"""Map each index of an epoch to a sequence of a video. Pure; nothing is stored per index.

A sequence is a run of consecutive frames of one video. The sequences of a video start at frame 0, L, 2L ... while
start + frames needed <= frames, at most ``max_sequences_per_video`` of them (L = frames per sequence). With
``voxel_seconds``, L is the frames of the longest duration that the recipe can draw, at the video's average rate.

With scene "auto", repeats, shots, fades and stretches with nothing to see divide a video into runs. A run is what a
spec may read in one go: frames of one shot with one set of bars, without the pieces that are skipped. Repeated frames
do not count. Sequences begin at 0, L, 2L ... of each run. Of those that are still for three quarters, and of the others
that are quiet for half, shares are kept: which, depends on a hash of the video's number and the first frame.

    candidate 0 of (seed, epoch, place)     the sequence that the epoch's permutation puts at ``place``
    candidate k                             a hash of (seed, epoch, place, k), from a video that no earlier candidate
                                            uses (if a few attempts find one)

If the video of a candidate fails, the next candidate is tried. That changes only this place: catalogue, permutation and
every other place stay the same, and the sample's provenance lists the refusals.

Places and indices are the same if each decoded clip gives one sample. With K samples of a clip, S apart, an epoch
consists of blocks of S places and S K indices:

    index      block S K + view S + offset          view 0 .. K-1, offset 0 .. S-1
    place      block S + offset

so the K samples of a place, its siblings, are S, 2 S ... (K-1) S apart. S is the number of samples from one batch of a
consumer to its next. So no batch holds two siblings, all siblings go to the same consumer, and they come within K
batches. Places that do not fill a block at the end of the epoch are dropped; they differ in each epoch.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from typing import overload

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.programs import counted
from v2v_protocol.recipe import LARGEST_SCALE, MOST_STEPS_PER_GRID, Recipe
from v2v_protocol.sample import Refusal, RefusalKind
from v2v_protocol.spec import MOST_SUBSTEPS, StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.scene import MOST_ANALYSED_FRAMES, NO_BARS, Flag, Pieces, Sides, sides_of
from v2v_server.corpus.videos import SplitVideos, VideoEntry
from v2v_server.corpus.videos import Videos as CatalogueVideos
from v2v_server.kinds.registry import VIDEOS, kind_of
from v2v_server.simulation.draw import admits, smallest_scale
from v2v_server.video.rows import Rows

_SKIPPED = {
    "fades": Flag.FADE,
    "black": Flag.BLACK,
    "white": Flag.WHITE,
    "combed": Flag.COMBED,
    "cuts": Flag.UNSEEN,  # there are most likely more of them
}
_Int64 = npt.NDArray[np.int64]
MOST_CLIP_BYTES = 2 << 30
"""Largest size of the decoded frames of one lease without margins, in 8 bits."""
MOST_LEASE_BYTES = 7 << 30
"""Largest memory that one lease may take, with all that its spec may ask for; a worker has a GiB more."""
LARGEST_MEMORY_BYTES = MOST_LEASE_BYTES + (1 << 30)
"""A worker that needs more ends. After three such ends its sample is refused for its spec."""
WORKER_BYTES = 2 << 30
"""Memory that the files in ``deploy`` and the Ray engine give a worker: enough for the 201 frames of the paper, resized
from 3840 x 2160 (:func:`lease_bytes`).
"""
_IDLE_BYTES = 256 << 20
"""A worker without a lease has 182 MiB; the rest is for what grows with neither frames nor pictures."""
_DECODER_BYTES = 24
"""For each pixel of a picture. H.264 of 3840 x 2160 took 13 with 8 bits and 29 with 10."""
_BLOCK = 256
"""Videos whose sequences are counted again for a look-up. Larger blocks take more time, smaller ones more memory."""
_Videos = Sequence[VideoEntry]
_SHOWN = 5
_ROUNDS = 8
_LEAST_HALF_BITS = 4
_MASK64 = (1 << 64) - 1
_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one place. If this many random videos in a row are broken, a person must repair the corpus."""


@dataclass(frozen=True, slots=True)
class Cleaning:
    """What a spec does about the defects of videos.

    Attributes:
        skipped: bits of :class:`Flag`: no sequence has such a frame.
        cuts, duplicates, bars: whether sequences end at cuts, leave repeats out, and do without bars.
    """

    skipped: int
    cuts: bool
    duplicates: bool
    bars: bool

    @classmethod
    def of(cls, spec: StreamSpec) -> Cleaning:
        """Return that of a spec with scene "auto"."""
        kept = spec.kept_defects
        skipped = sum(flag for kind, flag in _SKIPPED.items() if kind not in kept)
        return cls(skipped, "cuts" not in kept, "duplicates" not in kept, "bars" not in kept)


class Runs:
    """The usable pieces of videos, and the runs that they form.

    Attributes:
        piece_first, piece_run: [U] first frame and run of each usable piece.
        piece_flags: [U], its flags.
        ends: [U], usable frames up to the end of each piece, of all videos together.
        first: [R], the usable frames before each run.
        frames: [R], usable frames of each run.
        owners: [R], place of its video.
        sides: [R, 4], bars.
    """

    def __init__(self, split: SplitVideos, cleaning: Cleaning) -> None:
        pieces: Pieces = split.pieces
        flags, owners, firsts = pieces["flags"], split.owners(), split.firsts()
        sides = sides_of(pieces) if cleaning.bars else np.zeros((len(pieces), 4), np.uint16)
        skipped = (flags & cleaning.skipped) != 0
        repeated = (flags & (Flag.REPEAT if cleaning.duplicates else 0)) != 0
        begins = skipped | (np.diff(owners, prepend=-1) != 0)
        begins[1:] |= skipped[:-1] | (sides[1:] != sides[:-1]).any(axis=1)
        if cleaning.cuts:
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
        self._runs = runs = Runs(split, Cleaning.of(spec))
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


@dataclass(frozen=True, slots=True)
class VideoSequence:
    """One run of frames: the video and its first frame."""

    video: VideoEntry
    start_frame: int


class Columns:
    """Columns of the catalogue that determine how many sequences each video gives. A table for another spec then reads
    no entry.

    Args:
        videos: the catalogue's entries, in its order.

    Attributes:
        frames: int64 [N], frames of each video.
        rates: float64 [N], average frames per second; NaN where unknown.
        size: int32 [N], index into ``first_of_size``.
        first_of_size: for each picture size, the first video that has it.
        split: the videos that are divided into pieces; None if pieces are unknown.
    """

    def __init__(self, videos: _Videos) -> None:
        if isinstance(videos, CatalogueVideos):
            self.frames, sizes, self.split = videos.frames, _sizes(videos.height_px, videos.width_px), videos.split
            self.rates = videos.frames_per_second
        else:
            self.frames, sizes, self.split = _columns(videos)
            self.rates = np.array([video.frames_per_second for video in videos], np.float64)
        _, first, size = np.unique(sizes, return_index=True, return_inverse=True)
        self.size = size.astype(np.int32)
        self.first_of_size = tuple(first.tolist())


def _sizes(height_px: npt.NDArray[np.integer], width_px: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Return height and width packed into one integer per video, so that equal sizes are equal integers."""
    return height_px.astype(np.int64) << 32 | width_px


def _columns(videos: _Videos) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], SplitVideos | None]:
    """Return frames, sizes, and the videos that are divided into pieces."""
    frames, heights, widths = (
        np.array([getattr(video, name) for video in videos], np.int64) for name in ("frames", "height_px", "width_px")
    )
    sizes = _sizes(heights, widths)
    pieces = [video.pieces for video in videos if video.pieces is not None]
    return frames, sizes, SplitVideos.of(pieces) if len(pieces) == len(videos) else None


class SequenceTable:
    """All sequences of a corpus under one spec, in catalogue order, looked up by rank.

    It keeps only the number of sequences before each block of videos, 32 bytes for a thousand videos, so that every
    consumer may have a spec of its own. A look-up counts the sequences of one block.

    Args:
        videos: the catalogue's entries, in its order.
        rows: the usable rows of each picture.
        spec: determines the frames in a sequence, the size of the crop, and what is done about defects.
        columns: columns of the videos; None computes them.

    Attributes:
        count: N, total number of sequences.
        videos: number of videos that give at least one.

    Raises:
        UsageError: the spec asks for scenes and the catalogue has no scene statistics, or it is for another kind of
            videos.
    """

    def __init__(self, videos: _Videos, rows: Rows, spec: StreamSpec, columns: Columns | None = None) -> None:
        self._all, self._rows, self._spec, self._columns = videos, rows, spec, columns or Columns(videos)
        if why := (kind_of(videos[0].id) if len(videos) else VIDEOS).refuses(spec):
            raise UsageError(why)
        if spec.scene != "off" and self._columns.split is None:
            raise UsageError(
                f'scene = "{spec.scene}" needs statistics of the videos, which this catalogue was opened without: '
                "start the server with --scene auto"
            )
        shown = [videos[first] for first in self._columns.first_of_size]
        self._suits = np.array([_too_small(video, rows, spec.recipe) is None for video in shown], bool)
        self._most_steps = np.array(
            [_most_steps(video, rows, spec) if suits else 0 for video, suits in zip(shown, self._suits, strict=True)],
            np.int64,
        )
        counts, _ = self._count(0, len(videos))
        self.videos = int(np.count_nonzero(counts))
        ends = np.cumsum(counts)
        self.count = int(ends[-1]) if len(videos) else 0
        self._before = np.concatenate(([0], ends[_BLOCK - 1 :: _BLOCK]))  # sequences before each block
        self._last: tuple[int, VideoSequence] | None = None

    @property
    def refusals(self) -> Refusals:
        """Return the videos that give no sequence; each refusal is built when it is read."""
        counts, _ = self._count(0, len(self._all))
        return Refusals(np.flatnonzero(counts == 0), self._all, self._rows, self._spec)

    @property
    def spoilt(self) -> int:
        """Return the number of sequences at 0, L, 2L ... that are left out or moved because of what they show."""
        _, cut = self._count(0, len(self._all))
        return 0 if cut is None else cut.spoilt()

    @property
    def longest_clips(self) -> tuple[int, ...]:
        """Return the ``voxels_per_clip`` that each of the videos that are too short is long enough for."""
        columns, recipe = self._columns, self._spec.recipe
        _, cut = self._count(0, len(self._all))
        steps = recipe.steps_at(columns.rates)
        short = columns.frames <= recipe.sequence_at(columns.rates)
        if recipe.is_timed:
            short &= steps <= MOST_STEPS_PER_GRID
        videos, frames = np.flatnonzero(short), columns.frames[short]
        if cut is not None:
            videos, frames = (np.concatenate(both) for both in zip((videos, frames), cut.too_short(), strict=True))
        clips = map(
            _longest_clip, frames.tolist(), np.broadcast_to(steps, short.shape)[videos].tolist(), repeat(recipe)
        )
        return tuple(voxels for voxels in clips if voxels)

    def __getitem__(self, rank: int) -> VideoSequence:
        """Return the sequence with this rank, 0 .. count-1.

        Raises:
            IndexError: the rank is outside.
        """
        if not 0 <= rank < self.count:
            raise IndexError(f"sequence {rank} of {self.count}")
        if self._last is None or self._last[0] != rank:  # a grant and its siblings ask for the same one
            self._last = rank, self._find(rank)
        return self._last[1]

    def _find(self, rank: int) -> VideoSequence:
        block = int(self._before.searchsorted(rank, side="right")) - 1
        first, within = block * _BLOCK, rank - int(self._before[block])
        counts, cut = self._count(first, first + _BLOCK)
        ends = np.cumsum(counts)
        at = int(ends.searchsorted(within, side="right"))
        place = within - (int(ends[at - 1]) if at else 0)
        start = None if cut is None else cut.start(first + at, place)
        video = self._all[first + at]
        stride = int(self._spec.recipe.sequence_at(video.frames_per_second))
        return VideoSequence(video, place * stride if start is None else start)

    def _count(self, first: int, end: int) -> tuple[npt.NDArray[np.int64], SplitSequences | None]:
        """Count the sequences of each of the videos ``first`` .. ``end`` - 1."""
        columns, spec, recipe = self._columns, self._spec, self._spec.recipe
        rates, size = columns.rates[first:end], columns.size[first:end]
        strides = np.maximum(recipe.sequence_at(rates), 1)
        counts = np.clip((columns.frames[first:end] - 1) // strides, 0, spec.max_sequences_per_video)
        counts *= self._suits[size] & (recipe.reach_at(rates) <= self._most_steps[size] * recipe.frame_stride)
        if recipe.is_timed:
            steps = recipe.steps_at(rates)
            counts *= (steps > 0) & (steps <= MOST_STEPS_PER_GRID)
        if spec.scene == "off" or columns.split is None:
            return counts, None
        split = columns.split.between(first, end)

        def suits(size: int, sides: Sides) -> bool:
            return _too_small(self._all[columns.first_of_size[size]], self._rows, recipe, sides) is None

        at = split.numbers - first
        of_split = np.broadcast_to(strides, counts.shape)[at]
        sequences = SplitSequences(split, counts[at], of_split, spec, columns.size[split.numbers], suits)
        counts[at] = sequences.counts
        return counts, sequences


class Refusals(Sequence[Refusal]):
    """Reasons why videos give no sequence.

    Args:
        places: [n] positions of these videos in the catalogue.
        videos: all entries of the catalogue.
        rows, spec: rows and spec that the videos do not suit.
    """

    def __init__(self, places: npt.NDArray[np.intp], videos: _Videos, rows: Rows, spec: StreamSpec) -> None:
        self._places, self._videos, self._rows, self._spec = places, videos, rows, spec

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, at: int) -> Refusal: ...

    @overload
    def __getitem__(self, at: slice) -> tuple[Refusal, ...]: ...

    def __getitem__(self, at: int | slice) -> Refusal | tuple[Refusal, ...]:
        if isinstance(at, slice):
            return tuple(self._why(place) for place in self._places[at].tolist())
        return self._why(int(self._places[at]))

    def _why(self, place: int) -> Refusal:
        video, recipe = self._videos[place], self._spec.recipe
        if recipe.is_timed and (refusal := _unsuited_rate(video, recipe)) is not None:
            return refusal
        if video.frames <= recipe.sequence_at(video.frames_per_second):
            return _too_short(video, recipe)
        unsuited_size = _too_small(video, self._rows, recipe) or _too_large(video, self._rows, self._spec)
        return unsuited_size or _all_cut(video, self._rows, self._spec)


def _longest_clip(frames: int, steps: int, recipe: Recipe) -> int:
    """Return the largest ``voxels_per_clip`` that this number of frames is enough for; 0 if it is not enough for
    any.

    Args:
        steps: from one delivered frame to the next.
    """
    return max(0, (frames - 1) // (steps * recipe.frame_stride) - recipe.lead_voxels)


def _unsuited(video: VideoEntry, reason: str, remedy: str) -> Refusal:
    return Refusal(video.id, None, reason, RefusalKind.UNSUITED, remedy=remedy)


def _too_short(video: VideoEntry, recipe: Recipe) -> Refusal:
    most = _longest_clip(video.frames, int(recipe.steps_at(video.frames_per_second)), recipe)
    shorter = "shorter voxel_seconds" if recipe.is_timed else "fewer bins, frames_per_bin"
    remedy = _shorter(most) if most else f"{shorter} or frame_stride, no lead_voxels"
    if video.frames < 2:
        remedy = "none: a voxel grid needs two frames"
    return _unsuited(video, f"{video.frames} frames, {_needs(video, recipe)}", remedy)


def _shorter(most: int) -> str:
    return f"voxels_per_clip at most {most} (--set voxels_per_clip={most})"


def _needs(video: VideoEntry, recipe: Recipe) -> str:
    needed = f"the recipe needs {recipe.sequence_at(video.frames_per_second) + 1}"
    return f"{needed} at {video.frames_per_second:g} frames/s" if recipe.is_timed else needed


def _unsuited_rate(video: VideoEntry, recipe: Recipe) -> Refusal | None:
    """Return a refusal if the number of steps in a grid of ``voxel_seconds`` is unknown or too large."""
    steps = int(recipe.steps_at(video.frames_per_second))
    if not steps:
        return _unsuited(video, "its frame rate is unknown, and voxel_seconds needs it", "voxel_seconds 0")
    if steps <= MOST_STEPS_PER_GRID:
        return None
    reason = (
        f"a voxel grid of {recipe.voxel_seconds[1]:g} s spans {steps} steps at {video.frames_per_second:g} frames/s"
    )
    return _unsuited(video, f"{reason}, the limit is {MOST_STEPS_PER_GRID}", "shorter voxel_seconds, or frame_stride")


def _all_cut(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal:
    recipe, runs = spec.recipe, Runs(SplitVideos.of([video.pieces or b""]), Cleaning.of(spec))
    longest, needed = max(runs.frames.tolist(), default=0), int(recipe.sequence_at(video.frames_per_second)) + 1
    if longest < needed:
        most = _longest_clip(longest, int(recipe.steps_at(video.frames_per_second)), recipe)
        reason = f"at most {longest} frames in a row without a defect, {_needs(video, recipe)}"
        return _unsuited(video, reason, f"{_shorter(most)}, or scene off" if most else "scene off")
    for sides in runs.sides[runs.frames >= needed].tolist():
        if (refusal := _too_small(video, rows, recipe, Sides(*sides))) is not None:
            return refusal
    return _unsuited(video, "all its sequences are still or quiet", "still_share 1 and quiet_share 1")


def _frame_bytes(video: VideoEntry, rows: Rows, spec: StreamSpec) -> tuple[int, int]:
    """Return the bytes that each frame of a lease adds: to the decoded frames of all its samples, without margins and
    in 8 bits; and at most to its worker's memory. Requested arrays do not count: they never change which videos are
    shown.

    Frames are held whole until they are resized, however small the sample is. With scene "auto" those of all samples
    are held twice while repeated ones are left out. One sample at a time then has its view and a copy of it, voxels,
    and the levels between its frames.
    """
    recipe, samples = spec.recipe, spec.samples_per_decode
    window, crop, depth = _sizes_of(video, rows, spec)
    read = window if recipe.resize_scale != (1.0, 1.0) else crop
    held = samples + (1 if spec.scene == "off" else samples)
    seen = 2 * depth + np.dtype(spec.voxel_dtype).itemsize + _level_bytes(spec)
    return read * samples, depth * window * held + seen * crop


def _level_bytes(spec: StreamSpec) -> int:
    return 2 * (MOST_SUBSTEPS - 1) if spec.substep_px else 0


def _sizes_of(video: VideoEntry, rows: Rows, spec: StreamSpec) -> tuple[int, int, int]:
    """Return the pixels of each frame that are decoded for a sample, those of its crop, and the bytes of a level."""
    top, bottom = rows.bounds(video.height_px)
    window, depth = kind_of(video.id).reads(spec, bottom - top, video.width_px)
    return window, spec.recipe.crop_height_px * spec.recipe.crop_width_px, depth


def lease_bytes(video: VideoEntry, rows: Rows, spec: StreamSpec, array_bytes: int) -> int:
    """Return the memory that a worker needs for one lease, its own included, bytes: an upper bound, by measurements.

    Unlike the limit on sequences, it may change from release to release: it decides which worker makes a sample, and
    never what is in it.

    Args:
        video, rows, spec: what the lease is for.
        array_bytes: size of the arrays of one sample. Those of the sample before may still be on their way.
    """
    recipe = spec.recipe
    window, crop, depth = _sizes_of(video, rows, spec)
    frames = int(recipe.reach_at(video.frames_per_second)) // recipe.frame_stride + 1
    # Repeated frames are left out of a copy, and a picture is turned upright in one: phones film upright pictures so.
    is_copied = (spec.scene != "off" and "duplicates" not in spec.kept_defects) or video.height_px > video.width_px
    views = (recipe.resize_scale != (1.0, 1.0)) + (2 if recipe.contrast_probability else 1)
    clips = frames * depth * window * spec.samples_per_decode * (1 + is_copied)
    decoder = _DECODER_BYTES * video.width_px * video.height_px
    simulation = frames * crop * (depth * views + _level_bytes(spec)) + array_bytes
    return _IDLE_BYTES + clips + max(decoder, simulation) + array_bytes


def _most_steps(video: VideoEntry, rows: Rows, spec: StreamSpec) -> int:
    """Return the largest number of steps whose frames a lease may hold."""
    read, taken = _frame_bytes(video, rows, spec)
    return min(MOST_CLIP_BYTES // read, MOST_LEASE_BYTES // taken) - 1


def _too_large(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal | None:
    steps = int(spec.recipe.reach_at(video.frames_per_second)) // spec.recipe.frame_stride
    if steps <= _most_steps(video, rows, spec):
        return None
    read, taken = (size * (steps + 1) for size in _frame_bytes(video, rows, spec))
    reason = f"one sample takes up to {taken >> 20} MiB of memory, the limit is {MOST_LEASE_BYTES >> 20} MiB"
    if read > MOST_CLIP_BYTES:
        reason = f"one sample takes {read >> 20} MiB of decoded frames, the limit is {MOST_CLIP_BYTES >> 20} MiB"
    remedy = "fewer voxels_per_clip or samples_per_decode, a smaller flow_margin_px, substep_px 0, or resize_scale 1"
    return _unsuited(video, reason, remedy)


def _too_small(video: VideoEntry, rows: Rows, recipe: Recipe, sides: Sides = NO_BARS) -> Refusal | None:
    try:
        top, bottom = rows.bounds(video.height_px)
    except UsageError as error:
        return _unsuited(video, str(error), "other rows")
    height, width = bottom - top - sides.top - sides.bottom, video.width_px - sides.left - sides.right
    if admits(recipe, height, width):
        return None
    bars = " and without its bars" if any(sides) else ""
    if min(height, width) <= 0:
        return _unsuited(video, f"nothing is left of the picture after rows {rows}{bars}", "other rows")
    # Round up; otherwise the picture would be a fraction of a pixel too small.
    scale = math.ceil(smallest_scale(recipe, height, width) * 1000) / 1000
    reason = (
        f"picture {width}x{height} after rows {rows}{bars}, the crop is {recipe.crop_width_px}x{recipe.crop_height_px}"
    )
    larger = f"resize_scale up to {scale:g}, or a smaller crop" if scale <= LARGEST_SCALE else "a smaller crop"
    return _unsuited(video, reason, larger)


def corpus_summary(
    catalogue: Catalogue, spec: StreamSpec, table: SequenceTable, *, list_refused: bool = False
) -> list[str]:
    """Return lines that say how many sequences there are, which videos give none, and which setting would admit them.

    Args:
        catalogue, spec, table: of the server.
        list_refused: whether to name all of those videos, not only the first few.
    """
    span, lines = sequence_span(catalogue, spec.recipe)
    lines = [
        f"{counted(len(catalogue.videos), 'video')} in {catalogue.source}, {table.videos} of use: "
        f"{counted(table.count, 'sequence')} of {span} (at most {spec.max_sequences_per_video} a video), "
        f"rows {catalogue.rows}",
        *lines,
    ]
    if spec.scene != "off":
        split = 0 if catalogue.videos.split is None else len(catalogue.videos.split)
        lines.append(
            f"scene {spec.scene}: {counted(split, 'video has', 'videos have')} shot boundaries or empty parts; "
            f"{counted(table.spoilt, 'sequence is', 'sequences are')} left out or moved"
        )
        if long := int(np.count_nonzero(catalogue.videos.frames > MOST_ANALYSED_FRAMES)):
            lines.append(
                f"{counted(long, 'video is', 'videos are')} longer than the {MOST_ANALYSED_FRAMES} frames that are "
                "analysed: later frames are served only of videos without defects; split long videos to use all of them"
            )
    if refusals := table.refusals:
        lines.append(f"{counted(len(refusals), 'video gives', 'videos give')} none under the server's own recipe:")
        lines += _listed(refusals, list_refused)
        lines += _shorter_clips(table)
    if catalogue.refusals:
        lines.append(f"{counted(len(catalogue.refusals), 'file')} cannot be used at all:")
        lines += _listed(catalogue.refusals, list_refused)
    return lines


def sequence_span(catalogue: Catalogue, recipe: Recipe) -> tuple[str, list[str]]:
    """Return what a sequence consists of, and a warning if frames are too far apart for the recipe's grids."""
    if not recipe.is_timed:
        return f"{recipe.frames_needed} frames", []
    rates = catalogue.videos.frames_per_second
    steps = recipe.frame_stride / rates[rates > 0.0]  # of videos without a rate there are no sequences
    if not len(steps):
        return f"{recipe.spans} grids", []
    # A grid has the number of steps that comes nearest to its duration, and at least one.
    made = [np.maximum(np.rint(wanted / steps), 1.0) * steps for wanted in recipe.voxel_seconds]
    shortest, longest = f"{made[0].min():.3g}", f"{made[1].max():.3g}"
    span = f"{recipe.spans} grids of {shortest if shortest == longest else f'{shortest} to {longest}'} s"
    coarse = np.count_nonzero(steps > recipe.voxel_seconds[1])
    warning = (
        f"warning: voxel_seconds = {recipe.voxel_seconds[1]:g} is shorter than the time between frames of {coarse} "
        f"videos (at most {steps.max():.3g} s), so each of their grids lasts from frame to frame: raise voxel_seconds, "
        "or serve videos with more frames a second"
    )
    return span, [warning] if coarse else []


def _listed(refused: Sequence[Refusal], all_of_them: bool) -> list[str]:
    shown = refused if all_of_them else refused[:_SHOWN]
    rest = len(refused) - len(shown)
    return [f"  {line}" for line in shown] + ([f"  ... and {rest} more: --list-refused names all"] if rest else [])


def _shorter_clips(table: SequenceTable) -> list[str]:
    """Say how many of the videos that are too short a shorter clip would admit: half of them, and all."""
    longest = sorted(table.longest_clips, reverse=True)
    if not longest:
        return []
    choices = dict.fromkeys((longest[(len(longest) - 1) // 2], longest[-1]))
    each = (f"--set voxels_per_clip={n} admits {sum(voxels >= n for voxels in longest)} of them" for n in choices)
    return [f"  The longest clip that fits has {longest[0]} voxel grids. Shorter clips: {', '.join(each)}"]


class Permutation:
    """The permutation of 0 .. n-1 keyed by (seed, epoch), computed without storing it.

    A balanced Feistel network permutes the smallest suitable power of four that is at least n. An output outside
    0 .. n-1 is permuted again until it falls inside (cycle walking: Black and Rogaway, "Ciphers with arbitrary finite
    domains", CT-RSA 2002). Looking up an index takes constant expected time and memory. So starting an epoch over ten
    million sequences, or resuming in the middle of it, costs no more than one over ten.

    Args:
        n: size of the domain, at least 1.
        seed: 0 .. 2**64 - 1.
        epoch: 0 .. 2**32 - 1.

    Raises:
        ValueError: ``n`` is below 1.
    """

    def __init__(self, n: int, seed: int, epoch: int) -> None:
        if n < 1:
            raise ValueError(f"a permutation of {n} elements")
        self.n = n
        # Spare bits keep small domains well mixed: 2-bit halves reach too few permutations.
        self._half_bits = max(_LEAST_HALF_BITS, ((n - 1).bit_length() + 1) // 2)
        self._half_mask = (1 << self._half_bits) - 1
        key = hashlib.blake2b(b"v2v permutation 1" + seed.to_bytes(8, "little") + epoch.to_bytes(8, "little")).digest()
        self._round_keys = tuple(int.from_bytes(key[8 * i : 8 * i + 8], "little") for i in range(_ROUNDS))

    def __call__(self, index: int) -> int:
        """Return the image of ``index`` under the permutation.

        Raises:
            IndexError: index is outside 0 .. n-1.
        """
        if not 0 <= index < self.n:
            raise IndexError(f"index {index} of an epoch of {self.n} sequences")
        value = self._feistel(index)
        while value >= self.n:
            value = self._feistel(value)
        return value

    def _feistel(self, value: int) -> int:
        left, right = value >> self._half_bits, value & self._half_mask
        for key in self._round_keys:
            left, right = right, left ^ (_mix64(right ^ key) & self._half_mask)
        return left << self._half_bits | right


def _mix64(x: int) -> int:
    """Apply the finaliser of splitmix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
    2014).
    """
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & _MASK64
    x = (x ^ x >> 27) * 0x94D049BB133111EB & _MASK64
    return x ^ x >> 31


def hashed_below(n: int, *words: int) -> int:
    """Return a number in 0 .. n-1 that is a pure hash of the words (each 0 .. 2**64 - 1). Its bias is at most n /
    2**64.
    """
    data = b"".join(word.to_bytes(8, "little") for word in words)
    return int.from_bytes(hashlib.blake2b(b"v2v candidate 1" + data, digest_size=8).digest(), "little") % n


class Schedule:
    """Order of the sequences of one corpus under one spec.

    Args:
        table: the sequences; must not be empty.
        spec: says whether they are shuffled, K (``samples_per_decode``) and S (``sibling_spacing``).

    Attributes:
        table: the sequences.

    Raises:
        UsageError: K > 1 and S = 0.
    """

    def __init__(self, table: SequenceTable, spec: StreamSpec) -> None:
        if spec.samples_per_decode > 1 and not spec.sibling_spacing:
            raise UsageError(
                f"samples_per_decode = {spec.samples_per_decode} and sibling_spacing = 0: set sibling_spacing to the "
                "number of samples from one batch to the next (batch size x ranks x loader workers)"
            )
        self.table = table
        self._shuffle = spec.shuffle
        self._views = spec.samples_per_decode
        self._spacing = spec.sibling_spacing if self._views > 1 else 1

    @property
    def count(self) -> int:
        """Return the number of indices of an epoch."""
        return self.table.count // self._spacing * self._spacing * self._views

    def place(self, index: int) -> int:
        """Return the place of an index; siblings have the same place.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        if not 0 <= index < self.count:
            raise IndexError(f"index {index} of an epoch of {self.count} samples")
        block, within = divmod(index, self._spacing * self._views)
        return block * self._spacing + within % self._spacing

    def candidate(self, seed: int, epoch: int, index: int, candidate: int) -> VideoSequence:
        """Return the sequence of candidate number ``candidate`` (0 .. MOST_CANDIDATES - 1) of an index.

        Raises:
            IndexError: index is outside 0 .. count-1.
        """
        place = self.place(index)
        first = self.table[_permuted(self.table.count, seed, epoch, place) if self._shuffle else place]
        tried = [first]
        for number in range(1, candidate + 1):
            tried.append(self._substitute(seed, epoch, place, number, {sequence.video.id for sequence in tried}))
        return tried[candidate]

    def _substitute(self, seed: int, epoch: int, place: int, candidate: int, refused: set[str]) -> VideoSequence:
        for attempt in range(_MOST_ATTEMPTS):
            sequence = self.table[hashed_below(self.table.count, seed, epoch, place, candidate, attempt)]
            if sequence.video.id not in refused:
                break
        return sequence


@lru_cache(maxsize=1024)  # a lease asks twice, and so do its siblings
def _permuted(count: int, seed: int, epoch: int, place: int) -> int:
    return _permutation(count, seed, epoch)(place)


@lru_cache(maxsize=64)
def _permutation(count: int, seed: int, epoch: int) -> Permutation:
    return Permutation(count, seed, epoch)
