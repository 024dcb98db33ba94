"""Estimates with intervals, from sums over blocks of space and time that a bootstrap draws again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
DRAWS, SIDE = 200, 8
"""Draws of a bootstrap; blocks along a side of the sensor."""
LEVEL = 0.9
"""Probability with which an interval is meant to hold the truth."""
_DEVIATIONS, _LARGEST_PIECE = 1.645, 0.65
WIDEST = 0.5
"""An interval of more than this share to either side tells nothing."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its interval.

    Attributes:
        value, low, high: in the unit of the parameter.
        negligible: below this value the parameter makes no difference in a clip.
        note: what the value rests on, or why it cannot be told.
    """

    value: float
    low: float
    high: float
    negligible: float = 0.0
    note: str = ""

    @property
    def told(self) -> bool:
        """Whether the recording can tell the value: the interval is narrow, or lies below ``negligible``."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            return False
        return bool(self.high <= self.negligible or self.high - self.low <= 2 * WIDEST * max(self.value, 1e-12))

    @property
    def is_absent(self) -> bool:
        """Whether the value is too small to matter."""
        return self.told and self.high <= self.negligible

    def widened(self, share: float, more: float = 0.0) -> Estimate:
        """Return the estimate with an interval that also has an error of this share of the value, and more."""
        doubt = share * self.value + more
        low, high = math.hypot(self.value - self.low, doubt), math.hypot(self.high - self.value, doubt)
        return dataclasses.replace(self, low=max(self.value - low, 0.0), high=self.value + high)


def unknown(note: str) -> Estimate:
    """Return an estimate that tells nothing, and why."""
    return Estimate(math.nan, math.nan, math.nan, 0.0, note)


def bootstrap(sums: npt.NDArray[Any], solve: Callable[[Doubles], Doubles]) -> tuple[Doubles, Doubles, Doubles]:
    """Solve with all blocks, with blocks drawn with replacement, and without single pieces of the recording.

    Blocks drawn one by one show chance alone. Quarters of the sensor and of the time differ by more where the scene or
    the model does: their spread (a jackknife) widens the interval, unless one of them has most of the data.

    Args:
        sums: [SIDE * SIDE * parts, ...] additive statistics: blocks of the sensor, each in parts of the time. The first
            of them tells how much a block counts.
        solve: from the sum over blocks [...] to the values [k].

    Returns:
        the values [k], and the lower and upper ends of their intervals.
    """
    rng, blocks, flat = np.random.default_rng(0), len(sums), sums.reshape(len(sums), -1)
    is_seen = np.asarray(flat.any(axis=1)) | (not flat.any())
    filled = int(is_seen.sum())
    drawn = rng.multinomial(filled, np.full(filled, 1.0 / max(filled, 1)), size=DRAWS).astype(np.float64)
    value = solve(sums.sum(axis=0))
    values = np.array([solve((row @ flat[is_seen]).reshape(sums.shape[1:])) for row in drawn])
    spread = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    space, time = np.divmod(np.arange(blocks), blocks // SIDE**2)
    half = np.zeros_like(value)
    for piece in (space // SIDE // (SIDE // 2) * 2 + space % SIDE // (SIDE // 2), time):
        share = np.bincount(piece, np.abs(flat[:, 0]), 4)
        pieces = np.flatnonzero(share)
        if 0 < share.max() <= _LARGEST_PIECE * share.sum():
            without = np.array([solve(sums[piece != each].sum(axis=0)) for each in pieces])
            half = np.maximum(half, _DEVIATIONS * np.sqrt(without.var(axis=0) * (len(pieces) - 1)))
    return value, np.minimum(spread[0], value - half), np.maximum(spread[1], value + half)


def sums_by_block(block: npt.NDArray[np.int64], values: npt.NDArray[Any], parts: int = 1) -> Doubles:
    """Return the sums of [N, k] values over the entries of each block: [SIDE * SIDE * parts, k]."""
    return np.stack([np.bincount(block, column, minlength=SIDE**2 * parts) for column in values.T], axis=1)
