"""Choose what a sample uses of its video: its frames, its part of the picture, and how much flow. Pure.

The frames and the part are those that scene "auto" does not leave out. Each voxel's flow is made by the cheapest
method within the tolerance. The choice considers the tiles of the picture that the crop touches, and the segments
between the voxel's two frames:

    still     no block changes its mean by more than 1.5 grey levels (0.25 in a dark scene, where the
              gradations are finer): zero, without reading a pixel
    slow      nothing moves half a pixel from one end of the voxel to the other: dis-ultrafast
    mixed     half of the tiles and segments are slow, or the voxel reaches beyond the analysed frames: "auto"
              examines the pair itself
    moving    otherwise: dis-fast-lean

The limits are those by which "auto" judges each pair of pictures (:mod:`v2v_server.flow`), without its cost.
Where "auto" would use dis-fast, dis-fast-lean refines three times instead of five, within the tolerance
(docs/scene.md).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import (
    CHANGE,
    CLIPPED,
    DARK,
    FLICKER,
    LAG_FRAMES,
    MOTION,
    NO_BARS,
    NOISE,
    SEGMENT_FRAMES,
    TILES,
    UNKNOWN,
    Scene,
    Sides,
    frames_before,
)
from v2v_server.flow import AUTO, SLOW_METHOD, SLOW_PX, STILL_GREY_LEVELS, STILL_METHOD
from v2v_server.simulation.draw import FrameTimes, resized_size
from v2v_server.simulation.view import Window
from v2v_server.video.decode import DecodedClip
from v2v_server.worker.job import ClipJob

_LONGEST = np.iinfo(np.int16).max
LEAN_METHOD = "dis-fast-lean"
TOLERANCE_PX = 0.05
"""Largest addition of the choice to the median endpoint error of "auto", over a corpus (docs/scene.md)."""
DARK_SHARE = 0.9
"""A scene is dark if this share of it lies below grey level 16."""
DARK_STILL_GREY_LEVELS = 0.25


@dataclass(frozen=True, slots=True)
class CleanFrames:
    """The frames of a sequence, without those that scene "auto" leaves out.

    Attributes:
        numbers: int64 [n], their ordinals in the video; more than a sample of ``voxel_seconds`` may use.
        stride: distance of these frames, if it is the same for all; 0 where repeated frames are left out.
        sides: bars outside of the usable picture.
        before: int64 [n], those before them that the pixels start from; empty if there are too few in the shot.
    """

    numbers: npt.NDArray[np.int64]
    stride: int
    sides: Sides
    before: npt.NDArray[np.int64]

    @classmethod
    def of(cls, scene: Scene | None, start_frame: int, spec: StreamSpec, count: int, run_in: int = 0) -> CleanFrames:
        """Return the frames of the sequence that begins at ``start_frame``.

        Args:
            scene: statistics of what the sequence shows; None with scene "off".
            count: frames of the sequence, those that the stride leaves out included.
            run_in: frames before it that are wanted, those included too.
        """
        stride, kept = spec.recipe.frame_stride, spec.kept_defects
        numbers = start_frame + np.arange(count, dtype=np.int64)
        if scene is not None and "duplicates" not in kept:
            numbers = scene.frames_from(start_frame, count)
        before = frames_before(scene, start_frame, run_in, has_repeats="duplicates" in kept)
        is_even = int(numbers[-1]) - min((start_frame, *before[:1].tolist())) < count + len(before)
        sides = NO_BARS if scene is None or "bars" in kept else scene.sides(start_frame, int(numbers[-1]) + 1)
        return cls(numbers[::stride], stride if is_even else 0, sides, before[::stride])

    @property
    def first(self) -> int:
        """Return the first frame of all that are decoded."""
        return int((self.before if len(self.before) else self.numbers)[0])

    @property
    def span(self) -> int:
        """Return the number of the video's frames from the first to the last of the sequence."""
        return int(self.numbers[-1] - self.numbers[0]) + 1

    @property
    def reason(self) -> str:
        """What was left out, for the provenance; empty if nothing was."""
        dropped = self.span - len(self.numbers) if not self.stride else 0
        bars = ", ".join(f"{name} {depth}" for name, depth in zip(Sides._fields, self.sides, strict=True) if depth)
        parts = (
            f"{dropped} of {self.span} frames dropped" if dropped else "",
            f"bars left out: {bars} px" if bars else "",
        )
        return "; ".join(filter(None, parts))

    def count(self, frames: int) -> int:
        """Return how many frames are to be decoded for the first of these, ``frames`` in number, and those before."""
        return int(self.places(np.array([frames - 1]))[0]) + 1

    def places(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return which decoded frame each of some frames of the sequence is, [n] both."""
        return numbers + len(self.before) if self.stride else self.numbers[numbers] - self.first

    def pick(self, clip: DecodedClip, frames: int) -> DecodedClip:
        """Return those before and the first of these, ``frames`` in number, from a clip of :meth:`count` frames."""
        if self.stride:
            return clip
        at = np.concatenate((self.before, self.numbers[:frames])) - self.first
        motion = None if clip.motion is None else _motion_between(clip.motion, at)
        return replace(clip, frames=clip.frames[at], seconds=clip.seconds[at], motion=motion)


def _motion_between(motion: npt.NDArray[np.int16], frames: npt.NDArray[np.int64]) -> npt.NDArray[np.int16]:
    """Return the motion to each of some frames from the one before it among them: the sum on the way."""
    way = np.cumsum(motion, axis=0, dtype=np.int32)[frames]
    return np.clip(np.diff(way, axis=0, prepend=way[:1]), -_LONGEST, _LONGEST).astype(np.int16)


def usable_window(clip: ClipJob, sides: Sides) -> Window:
    """Return the part of a clip's upright picture that may be used: its rows without these bars."""
    top, bottom = clip.rows.bounds(clip.height_px)
    height, width = bottom - top - sides.top - sides.bottom, clip.width_px - sides.left - sides.right
    return Window(top + sides.top, sides.left, height, width)


def within_rows(clip: ClipJob, sides: Sides) -> Window:
    """Return the window of :func:`usable_window`, counted from the first usable row."""
    return usable_window(clip, sides)._replace(top_px=sides.top)


def most_frames(clip: ClipJob) -> int:
    """Return how many frames a sample may use, those in between included: the same for every server, whose index of a
    clip may hold more.

    Raises:
        VideoError: the recipe needs a frame rate, and the video's is unknown.
    """
    recipe, rate = clip.spec.recipe, clip.frames_per_second
    if not recipe.is_timed:
        return recipe.frames_needed
    if not rate:
        raise VideoError(clip.video, None, "its frame rate is unknown, and voxel_seconds needs it")
    needed = int(recipe.sequence_at(rate)) + 1
    if clip.spec.scene != "off":
        return needed
    return min(int(recipe.reach_at(rate)) + 1, clip.frame_index(needed).end - clip.start_frame)


def frame_times(clip: ClipJob, frames: CleanFrames) -> FrameTimes:
    """Return the time stamps of the frames that a sample may use."""
    seconds = clip.frame_index(frames.span).seconds(clip.start_frame, frames.span)
    rate = clip.frames_per_second / clip.spec.recipe.frame_stride
    return FrameTimes(seconds[frames.numbers - frames.numbers[0]], rate)


@dataclass(frozen=True, slots=True)
class FlowPlan:
    """Flow methods of one sample.

    Attributes:
        methods: of each voxel of the target sequence; "auto" where the statistics do not decide. Empty if the spec
            names a method, which is then used.
        reason: the decision and the figures behind it, for the provenance.
    """

    methods: tuple[str, ...]
    reason: str

    @property
    def still(self) -> bool:
        """Return whether no flow has to be estimated."""
        return bool(self.methods) and all(name == STILL_METHOD for name in self.methods)


def plan_flow(
    scene: Scene, frames: CleanFrames, params: SampleParams, spec: StreamSpec, picture: Window, place: str = ""
) -> FlowPlan:
    """Choose the flow method of each voxel of one drawn sample.

    Args:
        scene: statistics of the usable rows; they cover at least what the sample shows, as far as analysed.
        frames: the frames of the sequence.
        params, spec: the draw, and the spec that it was drawn for.
        picture: the usable part of the upright picture before the resize.
        place: how the crop was drawn, for the reason.
    """
    recipe = spec.recipe
    tiles = _tiles(params, recipe, picture, frames.sides)
    positions = params.ends(recipe)
    source = frames.numbers[params.source_index(int(positions[-1]))]
    ends = source[positions[recipe.lead_voxels :]].tolist()
    methods = tuple(_method(scene, earlier, later, tiles, params.scale) for earlier, later in pairwise(ends))
    values = scene.values(int(source[0]), int(source[-1]))
    kind, figures = _kind(methods), "; ".join(filter(None, (_figures(values, tiles), frames.reason, place)))
    if spec.flow_method != AUTO:
        return FlowPlan((), f"{kind}; flow {spec.flow_method} as asked; {figures}")
    return FlowPlan(methods, f"{kind}; flow {_counted(methods)}; {figures}")


def crop_weight(
    scene: Scene, frames: CleanFrames, scale: float, recipe: Recipe, picture: Window
) -> Callable[[int, int], int]:
    """Return a function of a crop's row and column: the change of the tiles that it shows, by their area in it.

    Args:
        scene, frames, recipe, picture: see :func:`plan_flow`.
        scale: of the picture before the crop.
    """
    first, end = (int(frames.numbers[place]) - scene.first for place in (0, -1))
    changes = scene.segments[max(0, first // SEGMENT_FRAMES) : max(0, end // SEGMENT_FRAMES + 1), CHANGE]
    tiles = np.where(changes == UNKNOWN, 0, changes).sum(axis=0, dtype=np.int64).reshape(TILES, TILES).tolist()
    sides = frames.sides
    height, width = resized_size(
        picture.height_px + sides.top + sides.bottom, picture.width_px + sides.left + sides.right, scale
    )
    above, before = resized_size(sides.top, sides.left, scale)

    def weigh(top: int, left: int) -> int:
        rows = _overlaps(top + above, recipe.crop_height_px, height)
        columns = _overlaps(left + before, recipe.crop_width_px, width)
        return sum(row * column * tiles[y][x] for y, row in enumerate(rows) for x, column in enumerate(columns))

    return weigh


def _overlaps(start_px: int, extent_px: int, side_px: int) -> list[int]:
    """Return how much of each of the four parts of a side an extent covers, 1/4 px."""
    end = TILES * (start_px + extent_px)
    return [max(0, min(end, (part + 1) * side_px) - max(TILES * start_px, part * side_px)) for part in range(TILES)]


def _method(scene: Scene, earlier: int, later: int, tiles: npt.NDArray[np.bool_], scale: float) -> str:
    if earlier == later:
        return STILL_METHOD
    if later >= scene.end:
        return AUTO
    values = scene.values(earlier, later)
    dark = bool((values[:, DARK] >= DARK_SHARE).any())
    change = values[:, CHANGE][:, tiles].max() * max(1.0, (later - earlier) / LAG_FRAMES)
    if change <= (DARK_STILL_GREY_LEVELS if dark else STILL_GREY_LEVELS):
        return STILL_METHOD
    # NaN means unknown motion; every comparison with it is False.
    pace = values[:, MOTION][:, tiles] * scale * (later - earlier)
    if pace.max() < SLOW_PX:
        return SLOW_METHOD
    return AUTO if np.median(pace) < SLOW_PX else LEAN_METHOD


def _tiles(params: SampleParams, recipe: Recipe, picture: Window, sides: Sides) -> npt.NDArray[np.bool_]:
    """Return [16] bool, which tiles of the analysed picture, bars and all, the crop touches."""
    height = picture.height_px + sides.top + sides.bottom
    width = picture.width_px + sides.left + sides.right
    top, left = (
        start + before * params.scale
        for start, before in ((params.crop_top_px, sides.top), (params.crop_left_px, sides.left))
    )
    rows = _touched(top, recipe.crop_height_px, height * params.scale)
    columns = _touched(left, recipe.crop_width_px, width * params.scale)
    return (rows[:, None] & columns).ravel()


def _touched(start_px: float, extent_px: int, side_px: float) -> npt.NDArray[np.bool_]:
    first = min(TILES - 1, math.floor(start_px * TILES / side_px))
    end = max(first + 1, math.ceil((start_px + extent_px) * TILES / side_px))
    numbers = np.arange(TILES)
    return (numbers >= first) & (numbers < end)


def _kind(methods: tuple[str, ...]) -> str:
    """Name a clip after its most demanding voxel's method."""
    kinds = {LEAN_METHOD: "moving", AUTO: "mixed", SLOW_METHOD: "slow", STILL_METHOD: "still"}
    return next(kind for name, kind in kinds.items() if name in methods)


def _counted(methods: tuple[str, ...]) -> str:
    counts = Counter(methods)
    return ", ".join(
        f"{'none' if name == STILL_METHOD else name} {counts[name]}"
        for name in (STILL_METHOD, SLOW_METHOD, LEAN_METHOD, AUTO)
        if counts[name]
    )


def _figures(values: npt.NDArray[np.float64], tiles: npt.NDArray[np.bool_]) -> str:
    """Format the statistics of a clip: motion and change of its tiles, the rest of the whole picture."""
    if not len(values):
        return "not looked at"
    motion, noise = values[:, MOTION][:, tiles], values[:, NOISE]
    known, heard = motion[~np.isnan(motion)], noise[~np.isnan(noise)]
    pace = f"{np.median(known):.2f} px a frame, at most {known.max():.2f}" if known.size else "unknown"
    dark = float(values[:, DARK].mean())
    return (
        f"motion {pace}; change {values[:, CHANGE][:, tiles].max():.2f}, flicker {values[:, FLICKER].mean():.2f}, "
        f"noise {heard.mean() if heard.size else 0.0:.2f} grey levels; dark {dark:.1%}"
        f"{' (a dark scene)' if dark >= DARK_SHARE else ''}, clipped {values[:, CLIPPED].mean():.1%}"
    )
