"""Estimates with intervals, from sums over blocks of space and time that a bootstrap draws again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
DRAWS = 200
LEVEL = 0.9
"""Probability with which an interval is meant to hold the truth."""
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

    def moved(self, value: float, doubt: float = 0.0) -> Estimate:
        """Return the estimate with another value, its interval scaled with it and widened by ``doubt``."""
        scale = value / self.value if self.value > 0.0 else 1.0
        low = value - math.hypot(scale * (self.value - self.low), doubt)
        high = value + math.hypot(scale * (self.high - self.value), doubt)
        return Estimate(value, max(low, 0.0), high, self.negligible, self.note)


def unknown(note: str) -> Estimate:
    """Return an estimate that tells nothing, and why."""
    return Estimate(math.nan, math.nan, math.nan, 0.0, note)


def bootstrap(sums: npt.NDArray[Any], solve: Callable[[Doubles], Doubles]) -> tuple[Doubles, Doubles, Doubles]:
    """Solve with all blocks, and with blocks drawn with replacement.

    Args:
        sums: [blocks, ...] additive statistics.
        solve: from the sum over blocks [...] to the values [k].

    Returns:
        the values [k], and the lower and upper ends of their intervals.
    """
    rng = np.random.default_rng(0)
    blocks = len(sums)
    flat = sums.reshape(blocks, -1)
    drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=DRAWS).astype(np.float64)
    value = solve(sums.sum(axis=0))
    values = np.array([solve((row @ flat).reshape(sums.shape[1:])) for row in drawn])
    spread = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return value, np.minimum(spread[0], value), np.maximum(spread[1], value)


def sums_by_block(block: npt.NDArray[np.int64], values: npt.NDArray[Any], blocks: int) -> Doubles:
    """Return the sums of [N, k] values over the entries of each block: [blocks, k]."""
    return np.stack([np.bincount(block, column, minlength=blocks) for column in values.T], axis=1)
