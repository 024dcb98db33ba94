"""Map each index of an epoch to a sequence of a video. Pure; nothing is stored per index.

A sequence is a run of consecutive frames of one video. The sequences of a video start at frame 0, L, 2L ... while
start + frames needed <= frames, at most ``max_sequences_per_video`` of them (L = frames per sequence). With
``voxel_seconds``, L is the frames of the longest duration that the recipe can draw, at the video's average rate.

With scene "auto", videos are divided into runs, which have sequences of their own
(:mod:`v2v_server.corpus.scenes.runs`).

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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from typing import overload

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import MOST_STEPS_PER_GRID
from v2v_protocol.sample import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.runs import SplitSequences
from v2v_server.corpus.scenes.scene import Sides
from v2v_server.corpus.videos import SplitVideos, VideoEntry
from v2v_server.corpus.videos import Videos as CatalogueVideos
from v2v_server.corpus_words import longest_clip, too_small, why_unsuited
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, kind_of
from v2v_server.lease_memory import most_steps
from v2v_server.video.rows import Rows

_BLOCK = 256
"""Videos whose sequences are counted again for a look-up. Larger blocks take more time, smaller ones more memory."""
_Videos = Sequence[VideoEntry]
_ROUNDS = 8
_LEAST_HALF_BITS = 4
_MASK64 = (1 << 64) - 1
_MOST_ATTEMPTS = 16
MOST_CANDIDATES = 8
"""Candidates of one place. If this many random videos in a row are broken, a person must repair the corpus."""


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


def suitable_kind(videos: _Videos, spec: StreamSpec) -> VideosKind:
    """Return the kind of these videos.

    Raises:
        UsageError: no sample of the spec can be made of it.
    """
    kind = kind_of(videos[0].id) if len(videos) else VIDEOS
    if why := kind.refuses(spec):
        raise UsageError(why)
    return kind


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
        self._kind = suitable_kind(videos, spec)
        if spec.scene != "off" and self._columns.split is None:
            raise UsageError(
                f'scene = "{spec.scene}" needs statistics of the videos, which this catalogue was opened without: '
                "start the server with --scene auto"
            )
        shown = [videos[first] for first in self._columns.first_of_size]
        self._suits = np.array([too_small(video, rows, spec.recipe) is None for video in shown], bool)
        self._most_steps = np.array(
            [most_steps(video, rows, spec) if suits else 0 for video, suits in zip(shown, self._suits, strict=True)],
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
        clips = map(longest_clip, frames.tolist(), np.broadcast_to(steps, short.shape)[videos].tolist(), repeat(recipe))
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
        counts *= self._suits[size] & (recipe.held_at(rates) <= self._most_steps[size] * recipe.frame_stride)
        if least_hz := self._kind.least_hz(spec):
            counts *= rates >= least_hz * (1.0 - 1e-6)
        if recipe.is_timed:
            steps = recipe.steps_at(rates)
            counts *= (steps > 0) & (steps <= MOST_STEPS_PER_GRID)
        if spec.scene == "off" or columns.split is None:
            return counts, None
        split = columns.split.between(first, end)

        def suits(size: int, sides: Sides) -> bool:
            return too_small(self._all[columns.first_of_size[size]], self._rows, recipe, sides) is None

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
        return why_unsuited(self._videos[place], self._rows, self._spec)


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
