"""Noise below a corner as it is in continuous time: float64, steps of a thirtieth of its time constant and less.

Written from the equation of the process, not from the kernel: an Ornstein-Uhlenbeck process of its own random numbers.
Between two samples it counts as a Brownian bridge, whose extremes are drawn exactly, so that no crossing is missed.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators
from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
_PARTS_OF_TAU = 30.0
_FAR = 6.0
"""Standard deviations of a part beyond which a threshold is not reached within it."""


@dataclass(frozen=True)
class Counted:
    """Events of a camera.

    Attributes:
        on, off: [steps, pixels] int64.
        pairs, opposite: successive events of a pixel, and how many of them have opposite signs.
    """

    on: npt.NDArray[np.int64]
    off: npt.NDArray[np.int64]
    pairs: int
    opposite: int


def continuous(
    levels: Doubles, step_seconds: float, thresholds: Doubles, residual: Doubles, sigma: float, corner_hz: float,
    seed: int = 1,
) -> Counted:  # fmt: skip
    """Count the events of pixels whose log light is linear in time between frames.

    Args:
        levels: [steps + 1, pixels] log light at the frames.
        thresholds: [2, pixels] positive and negative, log units.
        residual: [pixels] at the start, log units, which contain the noise then.
        sigma: of the noise, log units.
        corner_hz: of the noise.
    """
    tau = 1.0 / (2.0 * math.pi * corner_hz)
    parts = math.ceil(step_seconds / tau * _PARTS_OF_TAU)
    on, off, pairs, opposite = _walked(levels, parts, step_seconds / parts / tau, thresholds, residual, sigma, seed)
    return Counted(on, off, pairs, opposite)


@numba.njit(cache=True)
def _walked(levels, parts, h, thresholds, residual, sigma, seed):
    np.random.seed(seed)
    steps, pixels = len(levels) - 1, levels.shape[1]
    on, off = np.zeros((steps, pixels), np.int64), np.zeros((steps, pixels), np.int64)
    pairs, opposite = 0, 0
    rho = math.exp(-h)
    scale, local = sigma * math.sqrt(1.0 - rho * rho), 2.0 * h * sigma * sigma
    far = _FAR * math.sqrt(local)
    for p in range(pixels):
        positive, negative, last = thresholds[0, p], thresholds[1, p], 0
        x = sigma * np.random.standard_normal()
        base = residual[p] - x
        for step in range(steps):
            change = (levels[step + 1, p] - levels[step, p]) / parts
            for _ in range(parts):
                after = rho * x + scale * np.random.standard_normal()
                # The level without noise moves during the part, too: a bridge between both ends.
                one, other = base + x, base + change + after
                high, low = max(one, other), min(one, other)
                if high > positive - far:
                    high = (
                        one + other + math.sqrt((one - other) ** 2 - 2.0 * local * math.log(np.random.random()))
                    ) / 2
                if low < far - negative:
                    low = (one + other - math.sqrt((one - other) ** 2 - 2.0 * local * math.log(np.random.random()))) / 2
                base, x = base + change, after
                while high >= positive:
                    on[step, p] += 1
                    pairs, opposite, last = pairs + (last != 0), opposite + (last < 0), 1
                    base, high, low = base - positive, high - positive, low - positive
                while low <= -negative:
                    off[step, p] += 1
                    pairs, opposite, last = pairs + (last != 0), opposite + (last > 0), -1
                    base, low = base + negative, low + negative
    return on, off, pairs, opposite


def triangular_starts(thresholds: Doubles, rng: np.random.Generator) -> Doubles:
    """Draw residuals between thresholds, [2, pixels], as they stand in a camera that has run for long: [pixels]."""
    return np.asarray(rng.triangular(-thresholds[1], 0.0, thresholds[0]))
