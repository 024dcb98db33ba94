"""Draw one virtual camera from a recipe: every draw of a sample is a pure function of (recipe, seed, epoch, index,
video).

Random bits are the raw 64-bit output of Philox4x64-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3",
SC 2011) as numpy implements it: key (seed, a constant), counter (block, purpose, index, epoch). Raw output is a stable
interface of numpy, but its distributions are not. So the mappings to numbers are here, each an IEEE float64 expression
or exact integer arithmetic. Each purpose has its own counter stream, so a draw that is added later, or that takes more
numbers, does not change the others.

    uniform [0, 1)     u = floor(raw / 2**11) * 2**-53
    range [a, b]       min(a + u (b - a), b)
    its logarithm      min(a (b / a)**u, b): the product of a and the roots (b / a)**(2**-k), k = 1 .. 24, where the
                       k-th highest bit of raw is set; each is the correctly rounded square root of the one before
    probability p      u < p
    whole 0 .. n-1     floor(raw * n / 2**64), exact
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import ADDED, Range, Recipe, effect_settings
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.voxel import step_seconds

SAMPLE_KEY = 0x7632762073616D70
_LEAST_CONTRAST = 2.0**-60
"""Replaces a drawn contrast of 0, because 0.0 means "unchanged"; it gives the same flat grey picture."""


class Purpose(IntEnum):
    """The counter stream of each draw. Numbers are never reused; 10 to 15 belong to the first effects."""

    THRESHOLD = 1
    NOISE_SIGMA = 2
    HOT_PIXELS = 3
    PAUSES = 4
    SCALE = 5
    CROP = 6
    FLIP = 7
    CONTRAST = 8
    NOISE_KEY = 9
    LOG_EPS = 16
    VOXEL_SECONDS = 17
    CROP_CHOICE = 18
    WORLD = 19
    WORLD_PATH = 20
    WORLD_KNOTS = 21
    WORLD_POINTS = 22
    EXPOSURE = 23


_LOG_EPS_STEPS = 32
_CROP_PLACES = 8
"""Places of which a crop is chosen."""
_FIRST_EFFECTS = {
    name: number
    for number, name in enumerate(
        ("threshold_mismatch_sigma", "shot_noise_hz", "leak_hz", "refractory_seconds", "photoreceptor_hz",
         "dead_pixel_share"), 10,
    )
}  # fmt: skip
_Stream = Callable[[int, int], list[int]]


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """When the frames of a video are shown that a clip may use.

    Attributes:
        seconds: [n] float64, time stamp of each frame of the clip, the stride applied; NaN where unknown.
        frames_per_second: average rate, divided by the stride; used where two time stamps do not increase.
    """

    seconds: npt.NDArray[np.float64]
    frames_per_second: float


def draw(
    recipe: Recipe,
    *,
    seed: int,
    epoch: int,
    index: int,
    picture_height_px: int,
    picture_width_px: int,
    video_id: str,
    video_thresholds: tuple[float, float] | None = None,
    times: FrameTimes | None = None,
) -> SampleParams:
    """Draw the virtual camera and view of one sample.

    Args:
        recipe: ranges to draw from.
        seed, epoch, index: position of the sample in its stream (limits in ``v2v_protocol.sample``).
        picture_height_px, picture_width_px: size of the usable picture of the video, upright, before any resize.
        video_id: the catalogue id; used with ``threshold_source="video"`` only.
        video_thresholds: (threshold_pos, threshold_neg) that the list file states for the video, or None; used with
            ``threshold_source="video"`` only.
        times: of the frames that the clip may use, at least ``recipe.spans + 1``; used with ``voxel_seconds`` only.

    Returns:
        the draw; its thresholds are float32 values.

    Raises:
        UsageError: the crop does not fit into the picture at the largest allowed scale, or ``times`` are missing.
    """
    if not admits(recipe, picture_height_px, picture_width_px):
        needed = smallest_scale(recipe, picture_height_px, picture_width_px)
        raise UsageError(
            f"crop {recipe.crop_width_px}x{recipe.crop_height_px} does not fit into the picture "
            f"{picture_width_px}x{picture_height_px} of {video_id} at the largest resize_scale "
            f"{recipe.resize_scale[1]}: raise its upper end to {needed:.6g} or more, or make the crop smaller"
        )

    def stream(purpose: int, count: int) -> list[int]:
        return raw_words((seed, SAMPLE_KEY), (0, purpose, index, epoch), count)

    crop = recipe.crop_height_px * recipe.crop_width_px
    threshold_pos, threshold_neg = _thresholds(recipe, stream(Purpose.THRESHOLD, 3), video_id, video_thresholds)
    noise_sigma = in_range(recipe.noise_sigma, stream(Purpose.NOISE_SIGMA, 1)[0])
    share, sigma = stream(Purpose.HOT_PIXELS, 2)
    low, high = recipe.resize_scale
    low = max(low, smallest_scale(recipe, picture_height_px, picture_width_px))
    scale = in_range((low, high), stream(Purpose.SCALE, 1)[0])
    height, width = resized_size(picture_height_px, picture_width_px, scale)
    top, left = stream(Purpose.CROP, 2)
    degraded, contrast = stream(Purpose.CONTRAST, 2)
    first, second = stream(Purpose.NOISE_KEY, 2)
    params = SampleParams(
        threshold_pos=threshold_pos,
        threshold_neg=threshold_neg,
        noise_sigma=noise_sigma * threshold_pos if recipe.noise_scales_with_threshold else noise_sigma,
        hot_pixel_count=_rounded(in_range(recipe.hot_pixel_share, share) * crop),
        hot_pixel_sigma=in_range(recipe.hot_pixel_sigma, sigma),
        pauses=() if recipe.is_timed else _pauses(recipe, stream, recipe.steps),
        scale=scale,
        crop_top_px=below(height - recipe.crop_height_px + 1, top),
        crop_left_px=below(width - recipe.crop_width_px + 1, left),
        flip=unit_of(stream(Purpose.FLIP, 1)[0]) < recipe.flip_probability,
        contrast=(
            max(in_range(recipe.contrast_scale, contrast), _LEAST_CONTRAST)
            if unit_of(degraded) < recipe.contrast_probability
            else 0.0
        ),
        noise_key=(first & 0xFFFFFFFF, first >> 32, second & 0xFFFFFFFF, second >> 32),
        effects={
            name: value
            for name in (effect_settings() if recipe.has_effects else ())
            if (value := _effect(recipe, name, stream(_stream_of(name), 1)[0]))
        },
        log_eps=_log_eps(recipe.log_eps, stream(Purpose.LOG_EPS, 1)[0]),
        exposure_seconds=in_range(recipe.exposure_seconds, stream(Purpose.EXPOSURE, 1)[0]),
        added={
            name: in_range(getattr(recipe, name), stream(_stream_of(name), 1)[0])
            for name in (ADDED if recipe.is_noisy else ())
        },
    )
    return _timed(params, recipe, stream, times) if recipe.is_timed else params


def grid_steps(durations: npt.NDArray[np.float64], seconds: float, grids: int) -> tuple[int, ...]:
    """Return how many steps each of consecutive grids spans: as many as come nearest to a duration, at least one.

    If the steps do not last long enough for all grids, what is left is divided among those that are left.

    Args:
        durations: [n] of the steps, all above 0, n at least ``grids``.
        seconds: wanted duration of a grid.
        grids: number of grids.
    """
    ends = np.concatenate(([0.0], np.cumsum(durations)))
    spans: list[int] = []
    at, last = 0, len(durations)
    for left in range(grids, 0, -1):
        wanted = ends[at] + min(seconds, (ends[last] - ends[at]) / left)
        most = last - left + 1  # a step is left for each later grid
        after = min(int(ends.searchsorted(wanted)), most)
        is_nearer = bool(wanted - ends[after - 1] < ends[after] - wanted)
        spans.append(max(after - is_nearer - at, 1))
        at += spans[-1]
    return tuple(spans)


def _timed(params: SampleParams, recipe: Recipe, stream: _Stream, times: FrameTimes | None) -> SampleParams:
    """Draw the duration of a grid, and fit grids and pauses to the time stamps."""
    if times is None or len(times.seconds) <= recipe.spans:
        count = 0 if times is None else len(times.seconds)
        raise UsageError(
            f"time stamps of {count} frames: {recipe.spans} grids of voxel_seconds need those of {recipe.spans + 1}"
        )
    steps = len(times.seconds) - 1
    params = replace(params, pauses=_pauses(recipe, stream, steps))
    durations, _ = step_seconds(times.seconds, params.source_index(steps), times.frames_per_second)
    seconds = in_range(recipe.voxel_seconds, stream(Purpose.VOXEL_SECONDS, 1)[0])
    spans = grid_steps(durations, seconds, recipe.spans)
    return replace(params, voxel_seconds=seconds, grid_steps=spans, pauses=_until(params.pauses, sum(spans)))


def _until(pauses: Sequence[tuple[int, int]], steps: int) -> tuple[tuple[int, int], ...]:
    """Return the pauses of a clip that ends earlier."""
    return tuple((first, min(length, steps + 1 - first)) for first, length in pauses if first <= steps)


def choose_crop(
    params: SampleParams,
    recipe: Recipe,
    *,
    seed: int,
    epoch: int,
    index: int,
    share: float,
    picture_height_px: int,
    picture_width_px: int,
    weigh: Callable[[int, int], int],
) -> SampleParams:
    """Return a draw whose crop lies, with a probability of ``share``, at one of eight places drawn with weights;
    otherwise ``params`` itself.

    Args:
        params, recipe: the draw and its recipe.
        seed, epoch, index, picture_height_px, picture_width_px: see :func:`draw`.
        weigh: return the weight of a crop from its row and column in the resized picture; all 0: as drawn.
    """
    words = raw_words((seed, SAMPLE_KEY), (0, Purpose.CROP_CHOICE, index, epoch), 2 + 2 * _CROP_PLACES)
    height, width = resized_size(picture_height_px, picture_width_px, params.scale)
    places = [
        (below(height - recipe.crop_height_px + 1, top), below(width - recipe.crop_width_px + 1, left))
        for top, left in zip(words[2::2], words[3::2], strict=True)
    ]
    if unit_of(words[0]) >= share or not (total := sum(weights := [weigh(*place) for place in places])):
        return params
    top, left = places[bisect_right(list(accumulate(weights)), below(total, words[1]))]
    return dataclasses.replace(params, crop_top_px=top, crop_left_px=left)


def smallest_scale(recipe: Recipe, picture_height_px: int, picture_width_px: int) -> float:
    """Return the resize scale at which the crop just fits into the picture."""
    return max(recipe.crop_height_px / picture_height_px, recipe.crop_width_px / picture_width_px)


def admits(recipe: Recipe, picture_height_px: int, picture_width_px: int) -> bool:
    """Return whether some scale of the recipe makes the picture as large as the crop."""
    return (
        min(picture_height_px, picture_width_px) > 0
        and smallest_scale(recipe, picture_height_px, picture_width_px) <= recipe.resize_scale[1]
    )


def resized_size(height_px: int, width_px: int, scale: float) -> tuple[int, int]:
    """Return height and width of the picture after the resize, each rounded half up."""
    return _rounded(height_px * scale), _rounded(width_px * scale)


def noise_key_of_seed(seed: int) -> tuple[int, int, int, int]:
    """Return a noise key for a seed without a stream: that of (seed, epoch 0, index 0)."""
    first, second = raw_words((seed, SAMPLE_KEY), (0, Purpose.NOISE_KEY, 0, 0), 2)
    return first & 0xFFFFFFFF, first >> 32, second & 0xFFFFFFFF, second >> 32


def _thresholds(
    recipe: Recipe, raw: list[int], video_id: str, listed: tuple[float, float] | None
) -> tuple[float, float]:
    if recipe.threshold_source == "video":
        if listed is not None:
            return float(np.float32(listed[0])), float(np.float32(listed[1]))
        digest = hashlib.blake2b(video_id.encode("utf-8", "surrogateescape"), digest_size=16).digest()
        video_key = int.from_bytes(digest[:8], "little"), int.from_bytes(digest[8:], "little")
        raw = raw_words(video_key, (0, Purpose.THRESHOLD, 0, 0), 3)
    one = in_range(recipe.threshold, raw[0])
    other = one * in_range(recipe.threshold_ratio, raw[1])
    first, second = float(np.float32(one)), float(np.float32(other))
    return (first, second) if raw[2] >> 63 else (second, first)


def _log_eps(ends: Range, raw: int) -> float | None:
    """Draw log_eps; None if the range is one value. A range is drawn in even steps: a table of log intensity takes tens
    of milliseconds, and a worker caches the last 64.
    """
    low, high = ends
    return None if low == high else low + below(_LOG_EPS_STEPS + 1, raw) / _LOG_EPS_STEPS * (high - low)


def _stream_of(effect: str) -> int:
    """Return the counter stream of an effect: a digest of its name, far above all other numbers. The first effects have
    fixed numbers.
    """
    digest = hashlib.blake2b(effect.encode(), digest_size=6).digest()
    return _FIRST_EFFECTS.get(effect) or 2**32 + int.from_bytes(digest, "little")


def _pauses(recipe: Recipe, stream: _Stream, steps: int) -> tuple[tuple[int, int], ...]:
    """Draw runs of repeated frames from a Markov chain that starts in the running state; fewer steps give a prefix."""
    if recipe.pause_probability == 0.0:
        return ()
    runs: list[tuple[int, int]] = []
    first = 0  # position of the current run's first repeat; 0 while the camera runs
    for position, raw in enumerate(stream(Purpose.PAUSES, steps), start=1):
        paused = unit_of(raw) < (recipe.pause_stay_probability if first else recipe.pause_probability)
        if paused and not first:
            first = position
        elif first and not paused:
            runs.append((first, position - first))
            first = 0
    if first:
        runs.append((first, steps + 1 - first))
    return tuple(runs)


def raw_words(key: tuple[int, int], counter: tuple[int, int, int, int], count: int) -> list[int]:
    """Return raw output of the generator; the counter of a sample is (block, purpose, index, epoch)."""
    words = np.random.Philox(key=np.array(key, np.uint64), counter=np.array(counter, np.uint64)).random_raw(count)
    return [int(word) for word in words]


def unit_of(raw: int) -> float:
    """Return a uniform number in [0, 1)."""
    return (raw >> 11) * 2.0**-53


def in_range(ends: Range, raw: int) -> float:
    """Return a uniform number of a range."""
    low, high = ends
    return min(low + unit_of(raw) * (high - low), high)


def _effect(recipe: Recipe, name: str, raw: int) -> float:
    ends: Range = getattr(recipe, name)
    return in_log_range(ends, raw) if name in recipe.log_drawn else in_range(ends, raw)


def in_log_range(ends: Range, raw: int) -> float:
    """Return a number of a range, uniform in its logarithm."""
    low, high = ends
    if low == high:
        return low
    value, root = low, high / low
    for bit in range(63, 39, -1):
        root = math.sqrt(root)
        value *= root if raw >> bit & 1 else 1.0
    return min(value, high)


def _rounded(value: float) -> int:
    return math.floor(value + 0.5)


def below(count: int, raw: int) -> int:
    """Return a whole number, 0 .. count - 1."""
    return (raw * count) >> 64
