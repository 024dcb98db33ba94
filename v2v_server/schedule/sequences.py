"""List the sequences of videos that a spec may draw samples from.

A sequence is a run of consecutive frames of one video. The sequences of a video start at frame 0, L, 2L ... while
start + frames needed <= frames, at most ``max_sequences_per_video`` of them (L = frames per sequence). With scene
"auto" the same holds for each stretch of the video between shot boundaries in which there is something to see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LARGEST_SCALE, Recipe
from v2v_protocol.refusal import Refusal, RefusalKind
from v2v_protocol.spec import StreamSpec
from v2v_server.catalogue.index.runs import CutVideos
from v2v_server.catalogue.videos import VideoEntry
from v2v_server.catalogue.videos import Videos as CatalogueVideos
from v2v_server.simulation.draw import admits, smallest_scale
from v2v_server.video.rows import Rows

MOST_CLIP_BYTES = 2 << 30
"""Largest size of the decoded frames of one lease, bytes."""


Videos = Sequence[VideoEntry]


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
        size: int32 [N], index into ``first_of_size``.
        first_of_size: for each picture size, the first video that has it.
        cut: the videos whose usable runs are not just the whole video; None if runs are unknown.
    """

    def __init__(self, videos: Videos) -> None:
        if isinstance(videos, CatalogueVideos):
            self.frames, sizes, self.cut = videos.frames, _sizes(videos.height_px, videos.width_px), videos.cut
        else:
            self.frames, sizes, self.cut = _columns(videos)
        _, first, size = np.unique(sizes, return_index=True, return_inverse=True)
        self.size = size.astype(np.int32)
        self.first_of_size = tuple(first.tolist())


def _sizes(height_px: npt.NDArray[np.integer], width_px: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Return a number for each picture size."""
    return height_px.astype(np.int64) << 32 | width_px


def _columns(videos: Videos) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], CutVideos | None]:
    """Return frames, sizes, and the videos with shot boundaries."""
    frames, heights, widths = (
        np.array([getattr(video, name) for video in videos], np.int64) for name in ("frames", "height_px", "width_px")
    )
    sizes = _sizes(heights, widths)
    runs = [(place, video.runs) for place, video in enumerate(videos) if video.runs != ((0, video.frames),)]
    known = [(place, those) for place, those in runs if those is not None]
    return frames, sizes, CutVideos.of(known) if len(known) == len(runs) else None


class SequenceTable:
    """All sequences of a corpus under one spec, in catalogue order, looked up by rank.

    Args:
        videos: the catalogue's entries, in its order.
        rows: the usable rows of each picture.
        spec: determines the frames in a sequence, the size of the crop, and whether shot boundaries count.
        columns: columns of the videos; None computes them.

    Attributes:
        count: N, total number of sequences.
        videos: number of videos that give at least one.
        refusals: the videos that give no sequence; each refusal is built when it is read.
        spoilt: sequences at 0, L, 2L ... that are left out or moved because of what they show.

    Raises:
        UsageError: the spec asks for scenes and the catalogue has no scene statistics.
    """

    def __init__(self, videos: Videos, rows: Rows, spec: StreamSpec, columns: Columns | None = None) -> None:
        columns = columns or Columns(videos)
        recipe = spec.recipe
        self._all, self._recipe, self._stride = videos, recipe, recipe.frames_per_sequence
        self._frames = columns.frames
        self._cut: _CutSequences | None = None
        self.spoilt = 0
        counts = np.clip((columns.frames - recipe.frames_needed) // self._stride + 1, 0, spec.max_sequences_per_video)
        suits = [_unsuited_size(videos[first], rows, spec) is None for first in columns.first_of_size]
        counts *= np.array(suits, bool)[columns.size]
        if spec.scene != "off":
            if columns.cut is None:
                raise UsageError(
                    f'scene = "{spec.scene}" needs statistics of the videos, which this catalogue was opened without: '
                    "start the server with --scene auto"
                )
            self._cut = _CutSequences(columns.cut, counts[columns.cut.numbers], spec)
            self.spoilt = self._cut.spoilt
            counts[columns.cut.numbers] = self._cut.counts
        self._ends = np.cumsum(counts)
        self.count = int(self._ends[-1]) if len(videos) else 0
        self.videos = int(np.count_nonzero(counts))
        self.refusals = Refusals(np.flatnonzero(counts == 0), videos, rows, spec)

    @property
    def longest_clips(self) -> tuple[int, ...]:
        """The ``voxels_per_clip`` that each of the videos that are too short is long enough for."""
        short = self._frames[self._frames < self._recipe.frames_needed]
        runs = [] if self._cut is None else self._cut.too_short.tolist()
        clips = (_longest_clip(frames, self._recipe) for frames in [*short.tolist(), *runs])
        return tuple(voxels for voxels in clips if voxels)

    def __getitem__(self, rank: int) -> VideoSequence:
        """Return the sequence with this rank, 0 .. count-1.

        Raises:
            IndexError: the rank is outside.
        """
        if not 0 <= rank < self.count:
            raise IndexError(f"sequence {rank} of {self.count}")
        video = int(self._ends.searchsorted(rank, side="right"))
        place = rank - (int(self._ends[video - 1]) if video else 0)
        start = None if self._cut is None else self._cut.start(video, place)
        return VideoSequence(self._all[video], place * self._stride if start is None else start)


class _CutSequences:
    """Sequences of the videos with shot boundaries: at 0, L, 2L ... of each run.

    Args:
        cut: these videos.
        whole: int64 [C], number of sequences that each would have without its shot boundaries.
        spec: determines the frames in a sequence, and the largest number for one video.

    Attributes:
        counts: int32 [C], number of sequences of each video.
        spoilt: total number that are not where they would be without shot boundaries.
        too_short: frames of the longest run of each video that has no sequence because of its shot boundaries.
    """

    def __init__(self, cut: CutVideos, whole: npt.NDArray[np.int64], spec: StreamSpec) -> None:
        needed, self._stride = spec.recipe.frames_needed, spec.recipe.frames_per_sequence
        self._cut, owners = cut, cut.owners()
        each = np.clip((cut.end - cut.first - needed) // self._stride + 1, 0, None)
        upto = np.concatenate(([0], np.cumsum(each)))
        # Number of sequences of its video before each run, and number that the run may add.
        self._before = (upto[:-1] - upto[cut.bounds[:-1]][owners]).astype(np.int32)
        most = np.where(whole > 0, spec.max_sequences_per_video, 0)[owners]
        each = np.clip(most - self._before, 0, each)
        self.counts = np.bincount(owners, each, len(whole)).astype(np.int32)
        in_place = np.where(cut.first % self._stride, 0, np.clip(whole[owners] - cut.first // self._stride, 0, each))
        self.spoilt = int(whole.sum() - in_place.sum())
        self.too_short = cut.longest()[(whole > 0) & (self.counts == 0)]

    def start(self, video: int, place: int) -> int | None:
        """Return the first frame of a sequence of a video; None if the video has no shot boundaries."""
        if (at := self._cut.find(video)) is None:
            return None
        low, high = self._cut.bounds[at : at + 2].tolist()
        run = low + int(self._before[low:high].searchsorted(place, side="right")) - 1
        return int(self._cut.first[run]) + self._stride * (place - int(self._before[run]))


class Refusals(Sequence[Refusal]):
    """Reasons why videos give no sequence.

    Args:
        places: positions of these videos in the catalogue.
        videos: all entries of the catalogue.
        rows, spec: rows and spec that the videos do not suit.
    """

    def __init__(self, places: npt.NDArray[np.intp], videos: Videos, rows: Rows, spec: StreamSpec) -> None:
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
        if video.frames < recipe.frames_needed:
            return _too_short(video, recipe)
        return _unsuited_size(video, self._rows, self._spec) or _all_cut(video, _longest_run(video), recipe)


def _longest_run(video: VideoEntry) -> int:
    return max((end - first for first, end in video.runs or ()), default=0)


def _longest_clip(frames: int, recipe: Recipe) -> int:
    """Return the largest ``voxels_per_clip`` that this number of frames is enough for; 0 if it is not enough for
    any.
    """
    return max(0, (frames - 1) // (recipe.steps_per_frame * recipe.frame_stride) - recipe.lead_voxels)


def _unsuited(video: VideoEntry, reason: str, remedy: str) -> Refusal:
    return Refusal(video.id, None, reason, RefusalKind.UNSUITED, remedy=remedy)


def _too_short(video: VideoEntry, recipe: Recipe) -> Refusal:
    most = _longest_clip(video.frames, recipe)
    remedy = f"voxels_per_clip at most {most}" if most else "fewer bins, frames_per_bin or frame_stride, no lead_voxels"
    if video.frames < 2:
        remedy = "none: a voxel grid needs two frames"
    return _unsuited(video, f"{video.frames} frames, the recipe needs {recipe.frames_needed}", remedy)


def _all_cut(video: VideoEntry, longest_run: int, recipe: Recipe) -> Refusal:
    most = _longest_clip(longest_run, recipe)
    reason = (
        f"at most {longest_run} frames without a cut and with something to see, the recipe needs {recipe.frames_needed}"
    )
    return _unsuited(video, reason, f"voxels_per_clip at most {most}, or scene off" if most else "scene off")


def _unsuited_size(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal | None:
    return _too_small(video, rows, spec.recipe) or _too_large(video, rows, spec)


def _too_large(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal | None:
    """Return a refusal if the decoded frames of a lease exceed the limit. They are held whole until they are resized,
    however small the sample is.
    """
    recipe = spec.recipe
    top, bottom = rows.bounds(video.height_px)
    cropped = recipe.resize_scale == (1.0, 1.0)
    frame = recipe.crop_height_px * recipe.crop_width_px if cropped else (bottom - top) * video.width_px
    size = frame * (recipe.steps + 1) * spec.samples_per_decode
    if size <= MOST_CLIP_BYTES:
        return None
    reason = f"one sample takes {size >> 20} MiB of decoded frames, the limit is {MOST_CLIP_BYTES >> 20} MiB"
    return _unsuited(video, reason, "fewer voxels_per_clip or samples_per_decode, or resize_scale 1")


def _too_small(video: VideoEntry, rows: Rows, recipe: Recipe) -> Refusal | None:
    try:
        top, bottom = rows.bounds(video.height_px)
    except UsageError as error:
        return _unsuited(video, str(error), "other rows")
    height, width = bottom - top, video.width_px
    if admits(recipe, height, width):
        return None
    # Round up; otherwise the picture would be a fraction of a pixel too small.
    scale = math.ceil(smallest_scale(recipe, height, width) * 1000) / 1000
    reason = f"picture {width}x{height} after rows {rows}, the crop is {recipe.crop_width_px}x{recipe.crop_height_px}"
    larger = f"resize_scale up to {scale:g}, or a smaller crop" if scale <= LARGEST_SCALE else "a smaller crop"
    return _unsuited(video, reason, larger)
