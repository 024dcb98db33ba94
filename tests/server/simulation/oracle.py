"""The pixel model again, slowly: float64, one pixel and one step at a time, straight from the equations.

Written from the docstrings of ``v2v_protocol.recipe`` (the model) and ``v2v_server.simulation.voxel`` (when a change
counts), not from the kernel. The noise comes in as an argument, so that both sides see the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Trace:
    """What one simulation did.

    Attributes:
        voxels: [steps / frames_per_bin, pixels] float64 signed counts.
        residual_start, residual_end: [pixels] float64.
        signed_change: [pixels] float64, sum over the steps of threshold_pos N+ - threshold_neg N-.
        residual_low, residual_high: extremes that any residual took.
    """

    voxels: npt.NDArray[np.float64]
    residual_start: npt.NDArray[np.float64]
    residual_end: npt.NDArray[np.float64]
    signed_change: npt.NDArray[np.float64]
    residual_low: float
    residual_high: float


def log_intensity(grey: npt.NDArray[np.uint8], gamma: float, log_eps: float) -> npt.NDArray[np.float64]:
    """L = log(log_eps + (F / 255) ** gamma), float64."""
    return np.log(log_eps + (grey / 255.0) ** gamma)


def simulate(
    level: npt.NDArray[np.float64],
    noise: npt.NDArray[np.float64],
    start: npt.NDArray[np.float64],
    *,
    threshold_pos: float,
    threshold_neg: float,
    tolerance: float,
    frames_per_bin: int = 1,
) -> Trace:
    """Simulate pixel by pixel.

    Args:
        level: [steps + 1, pixels] log intensity.
        noise: [steps, pixels] noise and hot drift of each step.
        start: [pixels] uniform in [0, 1): where the residual starts between -threshold_neg and threshold_pos.
        tolerance: by how much a threshold may be missed and still count; 0.0 is the paper's plain floor.
    """
    steps, pixels = noise.shape
    voxels = np.zeros((steps // frames_per_bin, pixels))
    first, last, total = np.empty(pixels), np.empty(pixels), np.zeros(pixels)
    low, high = math.inf, -math.inf
    for p in range(pixels):
        changes = (np.diff(level[:, p]) + noise[:, p]).tolist()
        residual = first[p] = -threshold_neg + float(start[p]) * (threshold_pos + threshold_neg)
        signed = 0.0
        for step, change in enumerate(changes):
            d = residual + change
            positive = max(0, math.floor((d + tolerance) / threshold_pos)) if d >= 0 else 0
            negative = max(0, math.floor((-d + tolerance) / threshold_neg)) if d < 0 else 0
            moved = threshold_pos * positive - threshold_neg * negative
            residual = d - moved
            signed += moved
            low, high = min(low, residual), max(high, residual)
            voxels[step // frames_per_bin, p] += positive - negative
        last[p], total[p] = residual, signed
    return Trace(voxels, first, last, total, low, high)
