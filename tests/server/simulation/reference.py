"""The kernel's float32 definition in numpy, whole pictures at a time: what the kernel must equal bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from tests.oracles.noise import standard_normals, start_uniforms
from v2v_server.simulation import noise
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.voxel import LARGEST_COUNT, rounding_tolerance


def simulate(
    level: npt.NDArray[Any],
    key: noise.NoiseKey,
    *,
    threshold_pos: float,
    threshold_neg: float,
    noise_scale: npt.NDArray[Any] | None,
    hot_count: int,
    hot_sigma: float,
    hot_scale: npt.NDArray[Any],
    frames_per_bin: int,
    dtype: str,
    residual: npt.NDArray[Any] | None = None,
) -> tuple[npt.NDArray[Any], int]:
    """Voxels [steps / frames_per_bin, pixels] and saturated bins.

    Args:
        level: [steps + 1, pixels] log intensity, float32 or float64: the arithmetic of everything but the noise.
        key: the noise key.
        noise_scale: [steps], or None for no noise.
        hot_count, hot_sigma, hot_scale: hot pixels, their deviation, and [steps] durations.
        residual: [pixels] at the start; None draws it uniformly.
    """
    real = level.dtype.type
    steps, pixels = len(level) - 1, level.shape[1]
    positive, negative = real(threshold_pos), real(threshold_neg)
    tolerance = real(rounding_tolerance(threshold_pos, threshold_neg))
    if residual is None:
        residual = start_uniforms(key, pixels).astype(real) * (positive + negative) - negative
    normals = None if noise_scale is None else standard_normals(key, steps, pixels)
    position, normal = hot_pixels(key, hot_count, pixels)
    drift = normal.astype(real) * real(hot_sigma)
    counts = np.zeros((steps // frames_per_bin, pixels), real)
    for step in range(steps):
        residual[position] += drift * real(hot_scale[step])
        change = level[step + 1] - level[step]
        if normals is not None and noise_scale is not None:
            change += normals[step].astype(real) * real(noise_scale[step])
        potential = residual + change
        threshold = np.where(potential >= 0, positive, negative)
        events = np.floor((np.abs(potential) + tolerance) / threshold)
        signed = np.where(potential >= 0, events, -events)
        residual = potential - signed * threshold
        counts[step // frames_per_bin] += signed
    clipped = np.clip(counts, -real(LARGEST_COUNT[dtype]), real(LARGEST_COUNT[dtype]))
    return clipped.astype(dtype), int(np.count_nonzero(clipped != counts))
