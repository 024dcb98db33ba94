"""Simulate the frames of a recording, and measure statistics of both."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from v2v_protocol.recipe import Recipe, effect_settings
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.kernels import list_events
from v2v_server.video.picture import SDR, Signal
from v2v_tools.fit.increments import intervals_us, is_still, still_time
from v2v_tools.fit.interval import Doubles
from v2v_tools.fit.recording import Recorded

BRIGHTNESS_EDGES = np.array([0, 24, 48, 80, 112, 144, 176, 208, 256])
COUNT_EDGES = np.array([0, 1, 2, 4, 8, 16, 32, 128, 512, 1 << 40])
INTERVAL_EDGES_US = np.concatenate([[0.0], np.geomspace(50, 5e6, 21), [np.inf]])


Panels = Mapping[str, Doubles]
"""Statistics, [k] sums each.

rates: events by brightness, darker then brighter: k = 16; ``exposure``, pixel-seconds of each brightness: 8.
still: the same of pixels that see no change; ``still_exposure``.
pixels: pixels by their number of events: 9.
intervals: between events of a pixel, of one polarity, then of opposite ones: 44.
"""


def simulate_recording(
    recording: Recorded, camera: Mapping[str, float], seed: int = 0, start: str = "uniform"
) -> Recorded:
    """Simulate the frames of a recording with the product's own kernel: the same pixels, frames and times.

    Args:
        camera: parameters by the recipe's names, and ``threshold_pos`` and ``threshold_neg``; noise is per second.
        start: how residuals start (field of the recipe).

    Returns:
        the events between the first and the last frame; ``counts`` stay those of the recording.
    """
    pixels, steps = len(recording.pixels), len(recording.frames) - 1
    effects = {name: camera[name] for name in effect_settings() if camera.get(name)}
    ranges = {name: (value, value) for name, value in effects.items()}
    ranges["log_eps"] = (camera.get("log_eps", 1e-3),) * 2
    frames, light, signal = recording.frames[:, None, :], recording.known_light, SDR
    given: dict[str, Any] = {"gamma": light.gamma, "start": start}
    if not light.gamma:  # the kernel has no curve of sRGB
        signal, given = Signal(12, "linear"), {"light": "declared", "start": start}
        frames = np.rint(signal.white * light.of(np.arange(256.0))).astype(signal.dtype)[frames]
    recipe = Recipe(voxels_per_clip=steps, bins=1, noise_unit="second", pause_probability=0.0).replace(
        **ranges, **given
    )
    params = SampleParams(
        camera["threshold_pos"], camera["threshold_neg"], camera.get("noise_sigma", 0.0),
        round(camera.get("hot_pixel_share", 0.0) * pixels), camera.get("hot_pixel_sigma", 0.0), (), 1.0, 0, 0, False,
        0.0, noise_key_of_seed(seed), effects,
    )  # fmt: skip
    step_us = np.diff(recording.frame_us).astype(np.float64)
    frames = np.ascontiguousarray(frames)
    voxels = simulate_clip(frames, params, recipe, "int8", step_us * 1e-6, out={}, signal=signal)
    events = list_events(voxels.given, voxels.real, step_us)
    order = np.argsort(events.x, kind="stable") if pixels <= 1 << 16 else np.lexsort((events.t, events.x))
    first = np.searchsorted(events.x[order], np.arange(pixels + 1))
    return dataclasses.replace(
        recording, first=first, t_us=events.t[order] + recording.frame_us[0], p=events.p[order],
        seconds=float(recording.frame_us[-1] - recording.frame_us[0]) * 1e-6,
    )  # fmt: skip


def panels_of(recording: Recorded) -> Panels:
    """Measure the events between the first and the last frame."""
    begin_us, end_us = int(recording.frame_us[0]), int(recording.frame_us[-1])
    count = len(recording.pixels)
    owner = np.repeat(np.arange(count), np.diff(recording.first))
    inside = (recording.t_us >= begin_us) & (recording.t_us < end_us)
    mean_grey = recording.frames.mean(axis=0)
    bright = np.searchsorted(BRIGHTNESS_EDGES, mean_grey, side="right") - 1
    events, gaps = owner[inside], intervals_us(recording)
    seconds, _, on, off = still_time(recording, is_still(recording)).sum(axis=2)
    number = np.searchsorted(INTERVAL_EDGES_US, gaps[0], side="right") - 1
    totals = np.searchsorted(COUNT_EDGES, np.bincount(events, minlength=count), side="right") - 1
    sums = {
        "rates": np.bincount(8 * recording.p[inside] + bright[events], minlength=16),
        "exposure": np.bincount(bright, minlength=8) * (end_us - begin_us) * 1e-6,
        "still": np.bincount(np.concatenate([bright, 8 + bright]), np.concatenate([off, on]), 16),
        "still_exposure": np.bincount(bright, seconds, 8),
        "pixels": np.bincount(totals, minlength=9),
        "intervals": np.bincount(number + 22 * (gaps[1] < 0.5), minlength=44),
    }
    return {name: column.astype(np.float64) for name, column in sums.items()}


def per_second(events: Doubles, exposure: Doubles) -> Doubles:
    """Return [2 k] rates of events, darker then brighter, from [k] pixel-seconds; 0 where there is no time."""
    time = np.tile(exposure, 2)
    return np.divide(events, time, out=np.zeros_like(events), where=time > 0)
