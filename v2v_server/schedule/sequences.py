"""Which sequences of which videos a spec may draw samples from.

A sequence is a run of consecutive frames of one video. The sequences of a video start at frame 0, L, 2L ... while
start + frames needed <= frames, at most ``max_sequences_per_video`` of them (L = frames per sequence). With
scene "auto" the same holds of each stretch of the video between its cuts and where there is something to see.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate, islice

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LARGEST_SCALE, Recipe
from v2v_protocol.refusal import Refusal, RefusalKind
from v2v_protocol.spec import StreamSpec
from v2v_server.catalogue.catalogue import VideoEntry
from v2v_server.simulation.draw import admits, smallest_scale
from v2v_server.video.rows import Rows

MOST_CLIP_BYTES = 2 << 30
"""What a worker may have to hold of decoded frames for one lease."""


@dataclass(frozen=True, slots=True)
class Sequence:
    """One run of frames: the video and its first frame."""

    video: VideoEntry
    start_frame: int


class SequenceTable:
    """All sequences of a corpus under one spec, in catalogue order, looked up by rank.

    Args:
        videos: the catalogue's entries, in its order.
        rows: the rows of each picture that may be used.
        spec: says how many frames a sequence needs, how large the crop is, and whether cuts count.

    Attributes:
        count: N, sequences in all.
        refusals: the videos that give none.
        longest_clips: of those that are too short, the ``voxels_per_clip`` that each is long enough for.
        spoilt: sequences of the places 0, L, 2L ... that are left out or moved because of what they show.

    Raises:
        UsageError: the spec asks for scenes and the catalogue has none.
    """

    def __init__(self, videos: Iterable[VideoEntry], rows: Rows, spec: StreamSpec) -> None:
        self._stride = spec.recipe.frames_per_sequence
        self._starts: dict[int, tuple[int, ...]] = {}
        self.spoilt = 0
        admitted: list[VideoEntry] = []
        counts: list[int] = []
        refusals: list[Refusal] = []
        longest: list[int] = []
        for video in videos:
            if video.frames < spec.recipe.frames_needed:
                longest.append(_longest_clip(video.frames, spec.recipe))
                refusals.append(_too_short(video, spec.recipe))
                continue
            if (refusal := _too_small(video, rows, spec.recipe) or _too_large(video, rows, spec)) is not None:
                refusals.append(refusal)
                continue
            fit = (video.frames - spec.recipe.frames_needed) // self._stride + 1
            count = min(fit, spec.max_sequences_per_video)
            if spec.scene != "off":
                starts = _starts(video, spec)
                self.spoilt += len({self._stride * place for place in range(count)} - set(starts))
                if not starts:
                    run = max((end - first for first, end in video.runs or ()), default=0)
                    longest.append(_longest_clip(run, spec.recipe))
                    refusals.append(_all_cut(video, run, spec.recipe))
                    continue
                self._starts[len(admitted)] = starts
                count = len(starts)
            admitted.append(video)
            counts.append(count)
        self._videos = tuple(admitted)
        self._ends = tuple(accumulate(counts))
        self.count = self._ends[-1] if self._ends else 0
        self.refusals = tuple(refusals)
        self.longest_clips = tuple(voxels for voxels in longest if voxels)

    @property
    def videos(self) -> int:
        """Videos that give at least one sequence."""
        return len(self._videos)

    def __getitem__(self, rank: int) -> Sequence:
        """The sequence of that rank, 0 .. count-1.

        Raises:
            IndexError: rank is outside.
        """
        if not 0 <= rank < self.count:
            raise IndexError(f"sequence {rank} of {self.count}")
        video = bisect_right(self._ends, rank)
        first = self._ends[video - 1] if video else 0
        place = rank - first
        start = self._starts[video][place] if video in self._starts else place * self._stride
        return Sequence(self._videos[video], start)


def _starts(video: VideoEntry, spec: StreamSpec) -> tuple[int, ...]:
    """First frames of the sequences that lie within one of the video's runs: at 0, L, 2L ... of each."""
    if video.runs is None:
        raise UsageError(
            f'scene = "{spec.scene}" needs statistics of the videos, which this catalogue was opened without: start '
            "the server with --scene auto"
        )
    needed, stride = spec.recipe.frames_needed, spec.recipe.frames_per_sequence
    starts = (start for first, end in video.runs for start in range(first, end - needed + 1, stride))
    return tuple(islice(starts, spec.max_sequences_per_video))


def _longest_clip(frames: int, recipe: Recipe) -> int:
    """The ``voxels_per_clip`` that so many frames are enough for; 0: not even one."""
    return max(0, (frames - 1) // (recipe.bins * recipe.frames_per_bin * recipe.frame_stride) - recipe.lead_voxels)


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


def _too_large(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal | None:
    """The frames of a lease are held whole until they are resized, however small the sample becomes."""
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
    # Rounded up, or the picture would still be a fraction of a pixel too small.
    scale = math.ceil(smallest_scale(recipe, height, width) * 1000) / 1000
    reason = f"picture {width}x{height} after rows {rows}, the crop is {recipe.crop_width_px}x{recipe.crop_height_px}"
    larger = f"resize_scale up to {scale:g}, or a smaller crop" if scale <= LARGEST_SCALE else "a smaller crop"
    return _unsuited(video, reason, larger)
