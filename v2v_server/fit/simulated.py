"""Simulate the frames of a recording with the product's own kernel: the same pixels, frames and times."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from v2v_protocol.recipe import Recipe, effect_settings
from v2v_protocol.sample import SampleParams
from v2v_server.fit.recording import Recorded
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.kernels import list_events


def simulate_recording(recording: Recorded, camera: Mapping[str, float], seed: int = 0) -> Recorded:
    """Simulate a recording that has frames.

    Args:
        camera: parameters by the recipe's names, and ``threshold_pos`` and ``threshold_neg``; noise is per second.

    Returns:
        the events between the first and the last frame; ``counts`` stay those of the recording.
    """
    pixels, steps = len(recording.pixels), len(recording.frames) - 1
    effects = {name: camera[name] for name in effect_settings() if camera.get(name, 0.0) > 0.0}
    ranges = {name: (value, value) for name, value in effects.items()}
    log_eps = camera.get("log_eps", 1e-3)
    recipe = Recipe(
        voxels_per_clip=steps, bins=1, noise_unit="second", log_eps=(log_eps, log_eps), pause_probability=0.0
    ).replace(**ranges)
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
    return Recorded(
        recording.height_px, recording.width_px, recording.pixels, first, events.t[order] + recording.frame_us[0],
        events.p[order], recording.frames, recording.frame_us, recording.counts,
        float(recording.frame_us[-1] - recording.frame_us[0]) * 1e-6,
    )  # fmt: skip
