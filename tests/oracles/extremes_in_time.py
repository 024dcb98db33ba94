"""Extremes of divided steps: one check for each edge of the general kernel (see ``extremes.py``)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe, most_events
from v2v_protocol.spec import MOST_SUBSTEPS
from v2v_server.motion import levels_between
from v2v_server.motion.matching import UNITS_PER_PX
from v2v_server.simulation import simulate
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import FrameTimes, draw
from v2v_server.simulation.intensity import log_table, log_table_float64
from v2v_server.simulation.kernels import KernelInput, fill
from v2v_server.simulation.precision import AUTO, choose, error_bound
from v2v_server.simulation.voxel import FINE_STEPS, Levels, Moments, step_seconds

Doubles = npt.NDArray[np.float64]
HOUR, MICROSECOND = 3600.0, 1e-6


def excess_of_divided_steps(threshold: float, ratio: float, grids: int, bins: int, levels_per_step: int = 0) -> Any:
    """Return the excess of steps in which every pixel jumps between black and white, see :func:`_excess`."""
    steps = 12
    frames = np.random.default_rng(2).integers(0, 256, (steps + 1, 4, 5), np.uint8)
    levels = None
    if levels_per_step:
        step = np.repeat(np.arange(steps), levels_per_step)
        share = np.tile(np.arange(1, levels_per_step + 1) / (levels_per_step + 1), steps)
        between = np.random.default_rng(3).integers(0, 255 * FINE_STEPS + 1, (len(step), 4, 5), np.uint16)
        levels = Levels(Moments(step, share), between)
    return _excess(frames, levels, threshold, ratio, grids, bins)


def excess_along_motion(px: float) -> Any:
    """Return the excess of steps whose levels are made along a motion that the pictures do not have.

    Without motion there are no levels; the excess is infinite if there are, or fewer than sub-steps of a pixel make.
    """
    frames, levels = _along(px)
    expected = 12 * (min(math.ceil(abs(px)), MOST_SUBSTEPS - 1) if px else 0)
    if expected != (0 if levels is None else len(levels.grey)):
        return math.inf, 0.0, ""
    return _excess(frames, levels, 0.2, 1.3, 3, 5)


def _along(px: float) -> tuple[npt.NDArray[np.uint8], Levels | None]:
    pictures = np.random.default_rng(4).integers(0, 256, (13, 24, 28), np.uint8)
    vectors = np.full((13, 2, 2, 3), round(px * UNITS_PER_PX), np.int16)
    vectors[:, 1] = 0
    levels = levels_between(pictures, (8, 8, 8, 12), np.arange(13), 1.0, vectors)
    return np.ascontiguousarray(pictures[:, 8:16, 8:20]), levels


def _excess(
    frames: npt.NDArray[np.uint8], levels: Levels | None, threshold: float, ratio: float, grids: int, bins: int
) -> tuple[float, float, str]:
    """Return by how much the events of any stretch of a clip differ from its change of log intensity by more than a
    threshold, and the bound of that: (excess, bound, arithmetic). Every end of a bin is checked.
    """
    steps = len(frames) - 1
    made = simulate(
        frames, threshold_pos=threshold, threshold_neg=threshold * ratio, start_residual=0.0, bins=bins,
        grids_per_frame=grids, dtype="float32",
    )  # fmt: skip
    given, parts = dataclasses.replace(made.given, levels=levels), grids * bins
    table = log_table_float64(2.2, 1e-3)
    ends = table[frames.reshape(steps + 1, -1)]
    times = np.arange(steps + 1.0)
    if levels is not None:
        between = levels.grey.reshape(len(levels.grey), -1) / FINE_STEPS
        times = np.r_[times, levels.at.step + levels.at.share]
        order = np.argsort(times, kind="stable")
        ends = np.concatenate([ends, np.interp(between, np.arange(256), table)])[order]
        times = times[order]
    low, high = float(ends.min()), float(ends.max())
    events = most_events(given.segments, (low, high), (threshold, threshold * ratio), 0.0)
    real = choose(AUTO, events)
    counts = fill(given, real, {"event_counts": None})[0]["event_counts"].astype(np.float64)
    falling, rising = counts.transpose(1, 0, 2, 3, 4).reshape(2, steps * parts, -1)
    positive, negative = float(real(threshold)), float(real(threshold * ratio))
    fired = np.cumsum(positive * rising - negative * falling, axis=0)
    cuts = np.arange(1, steps * parts + 1) / parts
    lines = np.stack([np.interp(cuts, times, ends[:, p]) - ends[0, p] for p in range(ends.shape[1])], axis=1)
    left = lines - fired
    excess = max(float((left - positive).max()), float((-left - negative).max()), 0.0)
    return excess, error_bound(real, events, min(threshold, threshold * ratio)), real.__name__


def blind_sub_steps() -> int:
    """Count the pixels with more than 1 + T/t events in T, of a refractory time t longer than a step with sub-steps."""
    frames, levels = _along(9.0)
    wrong = 0
    for period in (1.5, 1000.0):
        made = simulate(
            frames, threshold_pos=0.2, bins=12, dtype="float32", frames_per_second=1.0, refractory_seconds=period
        )
        counts = fill(dataclasses.replace(made.given, levels=levels), made.real, {"event_counts": None})[0]
        fired = counts["event_counts"].sum(axis=(0, 1, 2), dtype=np.float64)
        wrong += int((fired > 1 + 12 / period).sum()) + int((fired < 1).sum())
    return wrong


def steps_of_any_duration() -> int:
    """Count violations with steps of a microsecond and of an hour in turns, all effects with units of time at work.

    A refractory period allows 1 + T / t events in T, over any bins; the leak of an hour is that of an hour.
    """
    steps, period, leak = 40, 0.01, 0.5
    seconds = np.where(np.arange(steps) % 2, MICROSECOND, HOUR)
    frames = np.random.default_rng(5).integers(0, 256, (steps + 1, 4, 5), np.uint8)

    def counts(frames: npt.NDArray[np.uint8], seconds: Doubles = seconds, **effects: Any) -> Doubles:
        made = simulate(
            frames, threshold_pos=0.2, bins=2, grids_per_frame=2, dtype="float32", frames_per_second=1.0, **effects
        )
        given: KernelInput = dataclasses.replace(made.given, step_seconds=seconds)
        arrays, _ = fill(given, made.real, {"event_counts": None, "voxels_bilinear": None})
        assert np.isfinite(arrays["voxels_bilinear"]).all()
        return np.asarray(arrays["event_counts"].astype(np.float64).sum(axis=2).reshape(steps, 2, 2, 20).sum(axis=1))

    blind = counts(frames, refractory_seconds=period, photoreceptor_hz=100.0).sum(axis=1)
    wrong = int((blind[seconds == MICROSECOND] > 1).sum())
    wrong += int((blind > 1 + seconds[:, None] / period).sum())
    long = counts(frames, np.full(steps, 1.0), refractory_seconds=1000.0).sum(axis=(0, 1))
    wrong += int((long > 1).sum())
    leaked = counts(np.full_like(frames, 90), leak_hz=leak)
    wrong += int(leaked[:, 0].any()) + int((np.abs(leaked[:, 1].sum(axis=0) - leak * seconds.sum()) > 2).sum())
    return wrong


def any_time_stamps() -> int:
    """Count violations with time stamps that are zero, repeat, fall or are missing, and grids of any duration.

    No duration changes the events of a pixel whose change is counted without noise: only the bin that holds them.
    """
    count, wrong = 41, 0
    frames = np.random.default_rng(6).integers(0, 256, (count, 8, 8), np.uint8)
    even = np.arange(count) / 30
    hostile = {
        "zero": np.zeros(count), "missing": np.full(count, np.nan), "repeated": np.repeat(even, 2)[:count],
        "falling": even[::-1], "mixed": np.where(np.arange(count) % 3, even, np.nan),
        "apart": np.where(np.arange(count) < 20, MICROSECOND, HOUR) * np.arange(count),
    }  # fmt: skip
    plain = Recipe(
        voxels_per_clip=40, bins=1, crop_height_px=8, crop_width_px=8, noise_sigma=(0.0, 0.0),
        hot_pixel_share=(0.0, 0.0), pause_probability=0.0, threshold=(0.1, 0.1), threshold_ratio=(1.0, 1.0),
        flip_probability=0.0,
    )  # fmt: skip
    for stamps in hostile.values():
        for duration in (MICROSECOND, 0.1, 100.0):
            recipe = plain.replace(voxels_per_clip=5, bins=3, voxel_seconds=duration)
            params = draw(
                recipe, seed=0, epoch=0, index=0, picture_height_px=8, picture_width_px=8, video_id="",
                times=FrameTimes(stamps, 30.0),
            )  # fmt: skip
            steps = int(params.ends(recipe)[-1])
            seconds, _ = step_seconds(stamps, np.arange(steps + 1), 30.0)
            voxels = simulate_clip(frames, params, recipe, "float32", seconds).voxels
            by_step = simulate_clip(frames, params, plain.replace(voxels_per_clip=steps), "float32").voxels
            wrong += int(np.count_nonzero(voxels.sum(axis=(0, 1)) != by_step.sum(axis=(0, 1))))
            wrong += int(voxels.shape != (5, 3, 8, 8)) + int(min(params.grid_steps) < 1 or steps >= count)
    return wrong


def large_float16() -> int:
    """Count float16 grids that are not the nearest float16 number, above 2,048 events and above float16's largest."""
    black_white, contrast, wrong = np.array([0, 255], np.uint8)[:, None, None], float(np.ptp(log_table(2.2, 1e-3))), 0
    for events in (2047.0, 2049.0, 65503.0, 65521.0, 1e5):
        # Grey levels: log intensities would take another compiled kernel.
        made = simulate(black_white, threshold_pos=contrast / (events + 0.5), bins=1, start_residual=0.0)
        arrays, clipped = fill(made.given, made.real, {"voxels_bilinear": None})
        wrong += int(arrays["voxels_bilinear"].item() != np.float16(min(events, 65504.0)))
        wrong += int(clipped["voxels_bilinear"] != (events > 65504))
    return wrong
