"""Fit thresholds, low-pass and dark floor to increments by least squares, and judge a fit by its likelihood.

A pixel's level P follows log intensity L by tau dP/dt = L - P, tau = 1 / (2 pi f (i + 20/255) / (1 + 20/255)) for
light i. Between two frames P changes by c+ on - c- off, so that

    change of L = c+ on - c- off + (tau + late) (change of dP/dt) + drift x time + rounding of the grey levels

where frames are seen ``late`` seconds after their times: tau depends on the light, ``late`` does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.photoreceptor import DARKEST
from v2v_tools.fit.increments import Increments, increments_of
from v2v_tools.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded

SYSTEMATIC = {
    "threshold_pos": 0.09,
    "threshold_neg": 0.09,
    "photoreceptor_hz": 0.08,
    "log_eps": 0.3,
    "threshold_mismatch_sigma": 0.3,
    "shot_noise_hz": 0.02,
    "leak_hz": 0.15,
    "refractory_seconds": 0.25,
}
"""Errors, as shares, that a bootstrap does not see: seen on simulated cameras (``python -m bench fit``)."""
LEAST_INCREMENTS = 1000
_SOLVED = ("threshold_pos", "threshold_neg", "photoreceptor_hz")
_CLOCK_SECONDS = 2e-5
_LEAST_EVENTS, _SPEED_ERROR = 2.0, 0.3
_MOST_FOR_LOG_EPS = 40_000
_LEAST_LOG_EPS = 5e-4


def is_large(increments: Increments) -> npt.NDArray[np.bool_]:
    """Return which increments have enough events that single noise events change little: [M]."""
    return np.asarray(np.abs(increments.on) + np.abs(increments.off) >= _LEAST_EVENTS)


class Regression:
    """Fit thresholds, corner frequency and log_eps to increments.

    Attributes:
        positive, negative, corner, log_eps: estimates; ``corner`` is 1 / Hz.
        late: how much later than their times the frames were seen, s.
        residual: [M] residuals, log units.
        kept: [M] mask of the increments used.
    """

    def __init__(self, increments: Increments, blocks: npt.NDArray[np.int64]) -> None:
        """Fit.

        Args:
            blocks: [P] block of each pixel.
        """
        self.kept = is_large(increments)
        self.residual = np.zeros(len(self.kept))
        if self.kept.sum() < LEAST_INCREMENTS:
            note = f"{self.kept.sum()} changes of {_LEAST_EVENTS:.0f} events between frames; needs {LEAST_INCREMENTS}"
            self.positive = self.negative = self.corner = self.log_eps = self.late = unknown(note)
            return
        given = increments.take(self.kept)
        block = blocks[given.pixel] * 4 + given.block
        note = f"{self.kept.sum()} changes between frames"
        self.log_eps = _fit_log_eps(given, blocks)
        fit = _least_squares(given, self.log_eps.value)
        self.residual[self.kept] = fit.residual
        with_change = np.concatenate([fit.columns, fit.change[:, None]], axis=1)
        rows = fit.weight[:, None, None] * fit.columns[:, :, None] * with_change[:, None, :]
        sums = sums_by_block(block, rows.reshape(len(rows), -1), 4).reshape(-1, 5, 6)
        value, low, high = bootstrap(sums, lambda s: _solve(s[:, :5], s[:, 5]))
        eps = self.log_eps
        ends = (eps.low, eps.high) if eps.told else (eps.value / 2, eps.value * 2)
        others = [_least_squares(given, max(end, 1e-5)).solved for end in ends]
        doubt = np.abs(others[1] - others[0]) / 2
        usual = np.array([SYSTEMATIC[name] for name in _SOLVED]) * (1.0 if self.log_eps.told else 2.0)
        self.late = Estimate(float(value[4]), float(low[4]), float(high[4]), 0.0, note)
        doubt = np.hypot(doubt[:3], np.abs(value[:3]) * usual)
        low, high = value[:3] - np.hypot(value[:3] - low[:3], doubt), value[:3] + np.hypot(high[:3] - value[:3], doubt)
        self.positive, self.negative = (Estimate(value[k], low[k], high[k], 0.0, note) for k in range(2))
        corner, least, most = (max(float(end[2]), 0.0) for end in (value, low, high))
        seen = f"{note}, which show the light of {1e3 * self.late.value:.1f} ms later"
        self.corner = Estimate(corner, least, most, 1.0 / 500.0, seen)


class _Fit(NamedTuple):
    """One solution: [M, 5] columns, [M] change, variance, weight and residual, [5] solved."""

    columns: Doubles
    change: Doubles
    variance: Doubles
    weight: Doubles
    residual: Doubles
    solved: Doubles


def _rows(given: Increments, log_eps: float, solved: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Return columns [M, 5], change [M] and variance [M] of increments, for thresholds known from a turn before."""
    light = given.light
    change = np.log(log_eps + light[1]) - np.log(log_eps + light[0])
    sensitivity = given.slope / (light + log_eps)
    positive, negative = np.maximum(solved[:2], 1e-4)
    pace = given.speed * np.where(given.speed > 0, positive, negative)
    lag = pace * (1.0 + DARKEST) / (2.0 * math.pi * (light + DARKEST))
    counted = np.abs(given.on) + np.abs(given.off)
    columns = np.stack([given.on, -given.off, lag[1] - lag[0], given.seconds, pace[1] - pace[0]], axis=1)
    variance = (sensitivity**2).sum(axis=0) / 12.0 + max(positive, negative) ** 2 * (0.02 + 0.02 * counted)
    # A noise event beside a frame makes the speed there too large.
    variance += (_SPEED_ERROR**2 * (solved[2] * lag + solved[4] * pace) ** 2).sum(axis=0)
    return columns, change, variance


def _least_squares(given: Increments, log_eps: float, turns: int = 7) -> _Fit:
    """Solve for c+, c-, 1 / corner, a drift and the frames' delay, with Huber's weights."""
    solved, robust = np.array([0.2, 0.2, 0.0, 0.0, 0.0]), np.ones(len(given.on))
    for _ in range(turns):
        columns, change, variance = _rows(given, log_eps, solved)
        weight = robust / variance
        scaled = columns * weight[:, None]
        solved = _solve(scaled.T @ columns, scaled.T @ change)
        residual = change - columns @ solved
        deviation = np.abs(residual) / np.sqrt(variance)
        robust = np.minimum(1.0, 2.5 * 1.4826 * float(np.median(deviation)) / np.maximum(deviation, 1e-9))
    return _Fit(columns, change, variance, weight, residual, solved)


def _likelihood(given: Increments, log_eps: float) -> Doubles:
    """Return the log likelihood of each increment's grey levels at the best thresholds, [M]; errors have long tails.

    A larger epsilon makes all changes smaller, residuals included. So the likelihood is that of grey levels, not of log
    intensity: it has the derivative dL / dF as a factor.
    """
    fit, light = _least_squares(given, log_eps, turns=5), given.light
    scale = 1.4826 * float(np.median(np.abs(fit.residual) / np.sqrt(fit.variance)))
    derivative = np.log(light / (light + log_eps)).mean(axis=0)
    tails = np.log1p(fit.residual**2 / fit.variance / scale**2 / 4)
    return np.asarray(derivative - 0.5 * np.log(fit.variance) - math.log(scale) - 2.5 * tails)


def _solve(normal: Doubles, right: Doubles) -> Doubles:
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)


def summit(grid: Doubles, total: Doubles) -> float:
    """Return the place of the maximum of a function, [n], on a grid of even steps, [n], between them by a parabola."""
    k = int(np.clip(np.argmax(total), 1, len(grid) - 2))
    left, middle, right = total[k - 1 : k + 2]
    bend = left - 2 * middle + right
    shift = np.clip(0.5 * (left - right) / bend, -1, 1) if bend < 0 else np.sign(right - left)
    return float(grid[k] + shift * (grid[1] - grid[0]))


def _fit_log_eps(given: Increments, blocks: npt.NDArray[np.int64]) -> Estimate:
    given = given.take(slice(None, None, 1 + len(given.on) // _MOST_FOR_LOG_EPS))
    grid = np.log(np.geomspace(1e-4, 0.3, 40))
    values = np.stack([_likelihood(given, math.exp(x)) for x in grid], axis=1)
    sums = sums_by_block(blocks[given.pixel] * 4 + given.block, values, 4)
    value, low, high = bootstrap(sums, lambda total: np.exp([summit(grid, total)]))
    note = f"{len(given.on)} changes between frames"
    if value[0] < _LEAST_LOG_EPS:
        return Estimate(float(value[0]), 0.0, math.inf, 0.0, f"too little in the dark: {note}")
    made = Estimate(float(value[0]), float(low[0]), float(high[0]), 0.0, note)
    return made.widened(SYSTEMATIC["log_eps"])


def refractory_by_change(
    recording: Recorded, blocks: npt.NDArray[np.int64], bound: Estimate, longest_us: float
) -> Estimate:
    """Estimate the refractory period, s, by the change that is lost in it: the likelihood of the frames.

    Args:
        blocks: [P], block of each pixel.
        bound: estimate whose upper end is the shortest interval between events.
    """
    grid = np.linspace(0.0, bound.high, 11)
    columns = []
    for period in grid:
        increments = increments_of(recording, period, longest_us)
        large = increments.take(is_large(increments))
        if len(large.on) < LEAST_INCREMENTS:
            return bound
        given = large.take(slice(None, None, 1 + 4 * len(large.on) // _MOST_FOR_LOG_EPS))
        best = max((_likelihood(given, eps) for eps in np.geomspace(1e-4, 0.3, 12)), key=np.sum)
        columns.append(sums_by_block(blocks[given.pixel], np.stack([best, np.ones(len(best))], axis=1)))
    sums = np.stack(columns, axis=2)
    value, low, high = bootstrap(sums, lambda s: np.clip([summit(grid, s[0] / np.maximum(s[1], 1))], 0.0, bound.high))
    made = Estimate(float(value[0]), float(low[0]), float(high[0]), 1e-4, f"change lost between events; {bound.note}")
    return made.widened(SYSTEMATIC["refractory_seconds"], _CLOCK_SECONDS)
