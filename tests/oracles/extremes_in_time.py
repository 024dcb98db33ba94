"""Extremes of divided steps: one check for each edge of the general kernel (see ``extremes.py``)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.bounds import most_events
from v2v_protocol.recipe import Recipe
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
    """Return by how much the events of any stretch of a clip differ from its change of log intensity by more than a
    threshold, and the bound of that: (excess, bound, arithmetic).

    Every end of a bin is checked, with every pixel between black and white at every step.
    """
    steps = 12
    frames = np.random.default_rng(2).integers(0, 256, (steps + 1, 4, 5), np.uint8)
    made = simulate(
        frames, threshold_pos=threshold, threshold_neg=threshold * ratio, start_residual=0.0, bins=bins,
        grids_per_frame=grids, dtype="float32",
    )  # fmt: skip
    given, parts = made.given, grids * bins
    table = log_table_float64(2.2, 1e-3)
    ends = table[frames.reshape(steps + 1, -1)]
    times = np.arange(steps + 1.0)
    if levels_per_step:
        step = np.repeat(np.arange(steps), levels_per_step)
        share = np.tile(np.arange(1, levels_per_step + 1) / (levels_per_step + 1), steps)
        between = np.random.default_rng(3).integers(0, 255 * FINE_STEPS + 1, (len(step), 4, 5), np.uint16)
        given = dataclasses.replace(given, levels=Levels(Moments(step, share), between))
        order = np.argsort(np.r_[times, step + share], kind="stable")
        ends = np.concatenate([ends, np.interp(between.reshape(len(step), -1) / FINE_STEPS, np.arange(256), table)])[
            order
        ]
        times = np.r_[times, step + share][order]
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
