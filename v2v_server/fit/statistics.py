"""Simulate the frames of a recording, and compare both by statistics."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe, effect_settings
from v2v_protocol.sample import SampleParams
from v2v_server.fit.increments import intervals_us, still_time
from v2v_server.fit.interval import DRAWS, LEVEL, Doubles
from v2v_server.fit.recording import Recorded
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.kernels import list_events

BRIGHTNESS_EDGES = np.array([0, 24, 48, 80, 112, 144, 176, 208, 256])
COUNT_EDGES = np.array([0, 1, 2, 4, 8, 16, 32, 128, 512, 1 << 40])
INTERVAL_EDGES_US = np.concatenate([[0.0], np.geomspace(50, 5e6, 21), [np.inf]])
_BLOCK_SIDE = 8
_EXPOSURES = {"rates": "exposure", "still": "still_exposure"}


Panels = Mapping[str, Doubles]
"""Statistics by block of the sensor, [blocks, k] sums each.

rates: events by brightness, darker then brighter: k = 16; ``exposure``, pixel-seconds of each brightness: 8.
still: the same of pixels that see no change; ``still_exposure``.
pixels, still_pixels: pixels by their number of events, in all time and while they see no change: 9.
intervals: between events of a pixel, of one polarity, then of opposite ones: 44.
"""


def simulate_recording(recording: Recorded, camera: Mapping[str, float], seed: int = 0) -> Recorded:
    """Simulate the frames of a recording with the product's own kernel: the same pixels, frames and times.

    Args:
        camera: parameters by the recipe's names, and ``threshold_pos`` and ``threshold_neg``; noise is per second.

    Returns:
        the events between the first and the last frame; ``counts`` stay those of the recording.
    """
    pixels, steps = len(recording.pixels), len(recording.frames) - 1
    effects = {name: camera[name] for name in effect_settings() if camera.get(name, 0.0) > 0.0}
    ranges = {name: (value, value) for name, value in effects.items()}
    ranges["log_eps"] = (camera.get("log_eps", 1e-3),) * 2
    recipe = Recipe(voxels_per_clip=steps, bins=1, noise_unit="second", pause_probability=0.0).replace(**ranges)
    params = SampleParams(
        camera["threshold_pos"], camera["threshold_neg"], camera.get("noise_sigma", 0.0),
        round(camera.get("hot_pixel_share", 0.0) * pixels), camera.get("hot_pixel_sigma", 0.0), (), 1.0, 0, 0, False,
        0.0, noise_key_of_seed(seed), effects,
    )  # fmt: skip
    step_us = np.diff(recording.frame_us).astype(np.float64)
    frames = np.ascontiguousarray(recording.frames[:, None, :])
    voxels = simulate_clip(frames, params, recipe, "int8", step_us * 1e-6, out={})
    events = list_events(voxels.given, voxels.real, step_us)
    order = np.argsort(events.x, kind="stable") if pixels <= 1 << 16 else np.lexsort((events.t, events.x))
    first = np.searchsorted(events.x[order], np.arange(pixels + 1))
    return dataclasses.replace(
        recording, first=first, t_us=events.t[order] + recording.frame_us[0], p=events.p[order],
        seconds=float(recording.frame_us[-1] - recording.frame_us[0]) * 1e-6,
    )  # fmt: skip


def panels_of(recording: Recorded, light: Doubles, begin_us: int, end_us: int) -> Panels:
    """Measure the events between two times."""
    count, blocks = len(recording.pixels), recording.blocks(_BLOCK_SIDE)
    owner = np.repeat(np.arange(count), np.diff(recording.first))
    inside = (recording.t_us >= begin_us) & (recording.t_us < end_us)
    mean_grey = recording.frames.mean(axis=0) if len(recording.frames) else np.full(count, 128.0)
    bright = np.searchsorted(BRIGHTNESS_EDGES, mean_grey, side="right") - 1
    seconds = np.full(count, (end_us - begin_us) * 1e-6)
    sign = recording.p.astype(np.int64)
    events = owner[inside]
    still = still_time(recording, light)
    gaps = np.empty((2, 0)) if len(events) < 2 else intervals_us(recording)
    after = np.flatnonzero(np.diff(owner) == 0) if len(owner) else np.empty(0, np.int64)
    number = np.searchsorted(INTERVAL_EDGES_US, gaps[0], side="right") - 1
    totals, quiet_seconds = np.bincount(events, minlength=count), still.seconds.sum(axis=1)
    noise = np.stack([still.off.sum(axis=1), still.on.sum(axis=1)])
    quiet = np.flatnonzero(quiet_seconds > 0.5 * quiet_seconds.max(initial=0.0))
    return {
        "rates": _table(blocks[events], sign[inside] * 8 + bright[events], None, 16),
        "exposure": _table(blocks, bright, seconds, 8),
        "still": _table(np.tile(blocks, 2), np.concatenate([bright, 8 + bright]), noise.ravel(), 16),
        "still_exposure": _table(blocks, bright, still.seconds.sum(1), 8),
        "pixels": _table(blocks, _class_of(totals), None, 9),
        "still_pixels": _table(blocks[quiet], _class_of((still.on + still.off).sum(axis=1)[quiet]), None, 9),
        "intervals": _table(blocks[owner[after]], number + 22 * (gaps[1] < 0.5), None, 44),
    }


def distance(measured: Panels, simulated: Panels, weights: Doubles, names: tuple[str, ...]) -> float:
    """Return the squared distance of the square roots of statistics, each normalised to a sum of 1, summed.

    Args:
        weights: [blocks] number of times that each block counts.
        names: the statistics to compare.
    """
    total = 0.0
    for name in names:
        mine, other = (weights @ panels[name] for panels in (measured, simulated))
        if name in _EXPOSURES:
            exposures = (weights @ panels[_EXPOSURES[name]] for panels in (measured, simulated))
            mine, other = map(per_second, (mine, other), exposures)
        scale = max((mine.sum() + other.sum()) / 2, 1e-12)
        total += float(((np.sqrt(mine / scale) - np.sqrt(other / scale)) ** 2).sum())
    return total


def gain(
    measured: Panels, simulated: Panels, without: Panels, held_out: npt.NDArray[np.bool_], names: tuple[str, ...]
) -> tuple[float, float]:
    """Return how much closer a simulation is than the one without an effect, and the lower end of its interval.

    Args:
        held_out: [blocks] mask of the blocks that the fit has not seen.
        names: see :func:`distance`.
    """
    rng, chosen = np.random.default_rng(0), np.flatnonzero(held_out)
    values = []
    for draw in range(DRAWS + 1):
        drawn = chosen if draw == 0 else rng.choice(chosen, len(chosen))
        weights = np.bincount(drawn, minlength=len(held_out)).astype(np.float64)
        values.append(distance(measured, without, weights, names) - distance(measured, simulated, weights, names))
    return values[0], float(np.quantile(values[1:], (1 - LEVEL) / 2))


def per_second(events: Doubles, exposure: Doubles) -> Doubles:
    """Return [2 k] rates of events, darker then brighter, from [k] pixel-seconds; 0 where there is no time."""
    time = np.tile(exposure, 2)
    return np.divide(events, time, out=np.zeros_like(events), where=time > 0)


def _class_of(counts: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    return np.searchsorted(COUNT_EDGES, counts, side="right") - 1


def _table(block: npt.NDArray[Any], column: npt.NDArray[Any], weight: Doubles | None, columns: int) -> Doubles:
    blocks = _BLOCK_SIDE**2
    sums = np.bincount(block * columns + column, weight, blocks * columns)
    return sums.astype(np.float64).reshape(blocks, columns)
