"""Estimate the parameters of a camera from what :mod:`v2v_server.fit.increments` measures.

thresholds, corner, log_eps   least squares over increments: the pixel's level P obeys tau dP/dt = L - P, so
                              change of L = c+ on - c- off + tau (change of dP/dt), tau = 1 / (2 pi f (i + 0.1) / 1.1)
mismatch                      products of residuals of different increments of one pixel
shot noise, leak              events of pixels that see no change
refractory period             end of the distribution of the shortest intervals, by profile likelihood
hot and dead pixels           pixels of a far higher rate than others; silent pixels among active ones
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.fit.increments import Increments, Still, increments_of
from v2v_server.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_server.fit.recording import Recorded

GAMMA = 2.2
SYSTEMATIC = {
    "threshold_pos": 0.04,
    "threshold_neg": 0.04,
    "photoreceptor_hz": 0.08,
    "log_eps": 0.3,
    "threshold_mismatch_sigma": 0.2,
    "shot_noise_hz": 0.02,
    "leak_hz": 0.05,
    "refractory_seconds": 0.1,
}
"""Errors, as shares, that a bootstrap does not see: seen on simulated cameras (``python -m bench fit``)."""
_SOLVED = ("threshold_pos", "threshold_neg", "photoreceptor_hz")
_CLOCK_SECONDS = 2e-5
_GLITCHES = 3e-5
_MANY_SHORT = 100
DARKEST = 0.1
"""Light that the corner frequency keeps in the dark (``effects/photoreceptor.py``)."""
LEAST_INCREMENTS = 1000
LEAST_SECONDS = 200.0
"""Pixel-seconds without a change that rates of noise need."""
_LEAST_EVENTS = 2.0
_MOST_FOR_LOG_EPS = 40_000


def light_of(grey: Doubles) -> Doubles:
    """Return light, 0 (black) to 1 (white), of grey levels."""
    return np.asarray((grey / 255.0) ** GAMMA)


def is_large(increments: Increments) -> npt.NDArray[np.bool_]:
    """Return which increments have enough events that single noise events change little: [M]."""
    return np.asarray(np.abs(increments.on) + np.abs(increments.off) >= _LEAST_EVENTS)


class Regression:
    """Fit thresholds, corner frequency and log_eps to increments.

    Attributes:
        positive, negative, corner, log_eps: estimates; ``corner`` is 1 / Hz.
        residual: [M] residuals, log units.
        kept: [M] mask of the increments used.
    """

    def __init__(self, increments: Increments, blocks: npt.NDArray[np.int64], log_eps: float | None = None) -> None:
        """Fit.

        Args:
            blocks: [P] block of each pixel.
            log_eps: epsilon inside the logarithm; None fits it.
        """
        self.kept = is_large(increments)
        self.residual = np.zeros(len(self.kept))
        if self.kept.sum() < LEAST_INCREMENTS:
            note = f"{self.kept.sum()} changes of {_LEAST_EVENTS:.0f} events between frames; needs {LEAST_INCREMENTS}"
            self.positive = self.negative = self.corner = self.log_eps = unknown(note)
            return
        given = increments.take(self.kept)
        block = np.unique(blocks[given.pixel] * 4 + given.block, return_inverse=True)[1]
        note = f"{self.kept.sum()} changes between frames"
        if log_eps is None:
            self.log_eps = _fit_log_eps(given, blocks)
        else:
            self.log_eps = Estimate(log_eps, log_eps, log_eps)
        fit = _least_squares(given, self.log_eps.value)
        self.residual[self.kept] = fit.residual
        with_change = np.concatenate([fit.columns, fit.change[:, None]], axis=1)
        rows = fit.weight[:, None, None] * fit.columns[:, :, None] * with_change[:, None, :]
        sums = sums_by_block(block, rows.reshape(len(rows), -1), block.max() + 1).reshape(-1, 4, 5)
        value, low, high = bootstrap(sums, lambda s: _solve(s[:, :4], s[:, 4]))
        others = [_least_squares(given, max(end, 1e-5)).solved for end in (self.log_eps.low, self.log_eps.high)]
        doubt = np.abs(others[1] - others[0]) / 2
        doubt = np.hypot(doubt[:3], np.abs(value[:3]) * [SYSTEMATIC[name] for name in _SOLVED])
        low, high = value[:3] - np.hypot(value[:3] - low[:3], doubt), value[:3] + np.hypot(high[:3] - value[:3], doubt)
        self.positive, self.negative = (Estimate(value[k], low[k], high[k], 0.0, note) for k in range(2))
        ends = [max(float(end), 0.0) for end in (value[2], low[2], high[2])]
        self.corner = Estimate(ends[0], ends[1], ends[2], 1.0 / 500.0, note)


class _Fit(NamedTuple):
    """One solution: [M, 4] columns, [M] change, variance, weight and residual, [4] solved."""

    columns: Doubles
    change: Doubles
    variance: Doubles
    weight: Doubles
    residual: Doubles
    solved: Doubles


def _rows(given: Increments, log_eps: float, solved: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Return columns [M, 4], change [M] and variance [M] of increments, for thresholds known from a turn before."""
    light = light_of(given.grey)
    change = np.log(log_eps + light[1]) - np.log(log_eps + light[0])
    sensitivity = GAMMA * light / (light + log_eps) / given.grey
    positive, negative = np.maximum(solved[:2], 1e-4)
    lag = given.speed * (1.0 + DARKEST) / (2.0 * math.pi * (light + DARKEST))
    lag = lag * np.where(given.speed > 0, positive, negative)
    counted = np.abs(given.on) + np.abs(given.off)
    columns = np.stack([given.on, -given.off, lag[1] - lag[0], given.seconds], axis=1)
    variance = (sensitivity**2).sum(axis=0) / 12.0 + max(positive, negative) ** 2 * (0.02 + 0.02 * counted)
    return columns, change, variance


def _least_squares(given: Increments, log_eps: float, turns: int = 7, *, has_corner: bool = True) -> _Fit:
    """Solve for c+, c-, 1 / corner and a drift, with Huber's weights."""
    solved, robust = np.array([0.2, 0.2, 0.0, 0.0]), np.ones(len(given.on))
    for _ in range(turns):
        columns, change, variance = _rows(given, log_eps, solved)
        if not has_corner:
            columns[:, 2] = 0.0
        weight = robust / variance
        scaled = columns * weight[:, None]
        solved = _solve(scaled.T @ columns, scaled.T @ change)
        residual = change - columns @ solved
        deviation = np.abs(residual) / np.sqrt(variance)
        robust = np.minimum(1.0, 2.5 * 1.4826 * float(np.median(deviation)) / np.maximum(deviation, 1e-9))
    return _Fit(columns, change, variance, weight, residual, solved)


def _log_likelihood(given: Increments, log_eps: float, residual: Doubles, variance: Doubles, scale: float) -> Doubles:
    """Return the log likelihood of each increment's grey levels, [M]; their errors have long tails.

    A larger epsilon makes all changes smaller, residuals included. So the likelihood is that of grey levels, not of log
    intensity: it has the derivative dL / dF as a factor.
    """
    light = light_of(given.grey)
    derivative = np.log(light / (light + log_eps)).mean(axis=0)
    tails = np.log1p(residual**2 / variance / scale**2 / 4)
    return np.asarray(derivative - 0.5 * np.log(variance) - math.log(scale) - 2.5 * tails)


def _likelihood(given: Increments, log_eps: float) -> Doubles:
    """Return the log likelihood of each increment at the best thresholds, [M]."""
    fit = _least_squares(given, log_eps, turns=5)
    return _log_likelihood(given, log_eps, fit.residual, fit.variance, _scale(fit.residual, fit.variance))


def _scale(residual: Doubles, variance: Doubles) -> float:
    return 1.4826 * float(np.median(np.abs(residual) / np.sqrt(variance)))


def held_out_likelihood(
    seen: Increments, other: Increments, log_eps: float, mismatch_sigma: float = 0.0, *, has_corner: bool = True
) -> Doubles:
    """Fit some increments, and return the log likelihood of others: [M].

    Args:
        mismatch_sigma: spread of the thresholds over pixels, as a share.
        has_corner: whether the pixel has a low-pass.
    """
    solved = _least_squares(seen, log_eps, has_corner=has_corner).solved
    scale, made = 1.0, []
    for given in (seen, other):
        columns, change, variance = _rows(given, log_eps, solved)
        residual = change - columns @ solved
        variance = variance + mismatch_sigma**2 * ((solved[0] * given.on) ** 2 + (solved[1] * given.off) ** 2)
        made.append((given, residual, variance))
        scale = scale if len(made) == 2 else _scale(residual, variance)
    return _log_likelihood(made[1][0], log_eps, made[1][1], made[1][2], scale)


def _solve(normal: Doubles, right: Doubles) -> Doubles:
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)


def _sample(given: Increments, count: int) -> Increments:
    if len(given.on) <= count:
        return given
    chosen = np.sort(np.random.default_rng(0).choice(len(given.on), count, replace=False))
    return given.take(chosen)


def _summit(grid: Doubles, total: Doubles) -> float:
    """Return the place of the maximum of a function on a grid of even steps, between its points by a parabola."""
    k = int(np.clip(np.argmax(total), 1, len(grid) - 2))
    left, middle, right = total[k - 1 : k + 2]
    bend = left - 2 * middle + right
    shift = np.clip(0.5 * (left - right) / bend, -1, 1) if bend < 0 else np.sign(right - left)
    return float(grid[k] + shift * (grid[1] - grid[0]))


def _fit_log_eps(given: Increments, blocks: npt.NDArray[np.int64]) -> Estimate:
    given = _sample(given, _MOST_FOR_LOG_EPS)
    block = blocks[given.pixel] * 4 + given.block
    coarse = np.log(np.geomspace(1e-4, 0.3, 14))
    best = coarse[int(np.argmax([_likelihood(given, math.exp(x)).sum() for x in coarse]))]
    grid = best + np.linspace(-1.25, 1.25, 11) * (coarse[1] - coarse[0])
    values = np.stack([_likelihood(given, math.exp(x)) for x in grid], axis=1)
    sums = sums_by_block(block, values, int(block.max()) + 1)
    value, low, high = bootstrap(sums, lambda total: np.exp([_summit(grid, total)]))
    made = Estimate(float(value[0]), float(low[0]), float(high[0]), 1e-3, f"{len(given.on)} changes between frames")
    return made.moved(made.value, SYSTEMATIC["log_eps"] * made.value)


def refractory_by_change(
    recording: Recorded, blocks: npt.NDArray[np.int64], bound: Estimate, longest_us: float
) -> Estimate:
    """Estimate the refractory period, s, by the change that is lost in it: the likelihood of the frames.

    Args:
        bound: estimate whose upper end is the shortest interval between events.
    """
    grid = np.linspace(0.0, bound.high, 11)
    columns, counts = [], []
    for period in grid:
        increments = increments_of(recording, period, longest_us)
        kept = is_large(increments)
        if kept.sum() < LEAST_INCREMENTS:
            return bound
        given = _sample(increments.take(kept), _MOST_FOR_LOG_EPS // 4)
        best = max((_likelihood(given, eps) for eps in np.geomspace(1e-4, 0.3, 12)), key=np.sum)
        size = int(blocks.max()) + 1
        columns.append(np.bincount(blocks[given.pixel], best, size))
        counts.append(np.bincount(blocks[given.pixel], minlength=size))
    sums = np.stack([np.stack(columns, axis=1), np.stack(counts, axis=1)], axis=1)
    value, low, high = bootstrap(sums, lambda s: np.clip([_summit(grid, s[0] / np.maximum(s[1], 1))], 0.0, bound.high))
    made = Estimate(float(value[0]), float(low[0]), float(high[0]), 1e-4, f"change lost between events; {bound.note}")
    return made.moved(made.value, SYSTEMATIC["refractory_seconds"] * made.value + _CLOCK_SECONDS)


def mismatch(fitted: Regression, given: Increments, blocks: npt.NDArray[np.int64]) -> Estimate:
    """Estimate the spread of the thresholds over pixels, as a share.

    A pixel that sees the same edge again and again repeats its errors in both polarities, while its two thresholds are
    independent: products of residuals of opposite changes are subtracted.
    """
    if not fitted.positive.told or not fitted.negative.told:
        return unknown("needs the thresholds")
    size = len(blocks)
    parts: list[Doubles] = []
    for own, other, threshold in (
        (given.on, given.off, fitted.positive.value), (given.off, given.on, -fitted.negative.value),
    ):  # fmt: skip
        chosen = np.flatnonzero(fitted.kept & (np.abs(other) < 0.5) & (own >= 1.0))
        pixel, count = given.pixel[chosen], own[chosen]
        product = np.clip(fitted.residual[chosen] / (threshold * count), -0.6, 0.6) * count * count
        of_pixel = [np.bincount(pixel, part, size) for part in (product, product**2, count**2, count**4)]
        # Increments that follow each other share a frame, and its rounding.
        beside = np.flatnonzero((np.diff(pixel) == 0) & (np.diff(chosen) == 1))
        pair, pair_weight = product[beside] * product[beside + 1], (count[beside] * count[beside + 1]) ** 2
        of_pixel += [2 * np.bincount(pixel[beside], part, size) for part in (pair, pair_weight)]
        parts.append(np.stack(of_pixel))
    columns = []
    for one, squares, weight, fourth, near, near_weight in parts:
        scale = 1.0 / np.maximum(weight, 1e-9)  # a pixel counts by its events, not by the square of them
        columns += [(one**2 - squares - near) * scale, (weight**2 - fourth - near_weight) * scale]
    both = 1.0 / np.maximum(np.sqrt(parts[0][2] * parts[1][2]), 1e-9)
    columns += [parts[0][0] * parts[1][0] * both, parts[0][2] * parts[1][2] * both]
    on, on_weight, off, off_weight, cross, cross_weight = columns
    table = np.stack([on + off, on_weight + off_weight, cross, cross_weight], axis=1)
    sums = sums_by_block(blocks, table, int(blocks.max()) + 1)
    if min(sums[:, 1].sum(), sums[:, 3].sum()) < LEAST_INCREMENTS:
        return unknown("too few pixels with several changes in both directions")

    def solve(s: Doubles) -> Doubles:
        common = max(s[2] / max(s[3], 1e-12), 0.0)
        return np.array([s[0] / max(s[1], 1e-12) - common, common])

    value, low, high = bootstrap(sums, solve)
    doubt = float(value[1]) / 2
    ends = [math.sqrt(max(float(end), 0.0)) for end in (value[0], low[0] - doubt, high[0] + doubt)]
    estimate = Estimate(ends[0], ends[1], ends[2], 0.05, "residuals of several changes of one pixel")
    return estimate.moved(estimate.value, SYSTEMATIC["threshold_mismatch_sigma"] * estimate.value)


def noise_rates(
    still: Still, blocks: npt.NDArray[np.int64], is_hot: npt.NDArray[np.bool_]
) -> tuple[Estimate, Estimate]:
    """Estimate shot noise (of a black pixel, both polarities) and the surplus of brighter events, Hz."""
    seconds = float(still.seconds[~is_hot].sum())
    if seconds < LEAST_SECONDS:
        note = f"{seconds:.0f} pixel-seconds without a change; needs {LEAST_SECONDS:.0f}: hold the camera still"
        return unknown(note), unknown(note)
    block = (blocks[:, None] * 4 + np.arange(4)).ravel()
    columns = [part * ~is_hot[:, None] for part in (still.on, still.off, still.seconds, still.light)]
    sums = sums_by_block(block, np.stack([column.ravel() for column in columns], axis=1), 4 * (int(blocks.max()) + 1))
    sums = sums[sums[:, 2] > 0]

    def solve(s: Doubles) -> Doubles:
        on, off, time, lit = s
        return np.array([2 * off / max(time - 0.75 * lit, 1e-9), (on - off) / max(time, 1e-9)])

    value, low, high = bootstrap(sums, solve)
    on, off = sums[:, 0].sum(), sums[:, 1].sum()
    note = f"{on:.0f} brighter and {off:.0f} darker events in {seconds:.0f} pixel-seconds without a change"
    # Without an event, the upper end is that of a Poisson process.
    most = 3.0 / seconds
    return (
        Estimate(value[0], low[0], max(high[0], 2 * most), 0.2, note).moved(
            value[0], SYSTEMATIC["shot_noise_hz"] * value[0]
        ),
        Estimate(value[1], low[1] - most, high[1] + most, 0.03, note),
    )


def refractory(gaps_us: Doubles) -> Estimate:
    """Estimate the refractory period, s, from intervals between events of a pixel.

    Near the end r of the distribution, P(interval < x) = (x - r) ** a, r and a unknown: likelihood of the smallest.
    """
    if gaps_us.shape[1] < 1000:
        return unknown(f"{gaps_us.shape[1]} intervals between events; needs 1000")
    # A few events of a recording may have wrong times.
    glitches = int(_GLITCHES * gaps_us.shape[1])
    gaps_us = gaps_us[:, gaps_us[0] >= np.partition(gaps_us[0], glitches)[glitches]]
    gaps, is_same = gaps_us[0], gaps_us[1] > 0
    shortest = float(gaps.min())
    count = int(np.clip(np.count_nonzero(gaps <= 1.1 * shortest + 20), 20, 2000))
    smallest = np.sort(np.partition(gaps, count)[: count + 1]) + 0.5
    if smallest[0] < 30.0:
        return Estimate(0.0, 0.0, smallest[0] * 1e-6, 1e-4, f"shortest interval {smallest[0]:.0f} us")
    note = f"shortest of {len(gaps)} intervals {shortest:.0f} us"
    apart_by_sign = [np.sort(gaps[chosen])[:5] for chosen in (is_same, ~is_same)]
    if min(map(len, apart_by_sign)) < 5 or abs(np.diff([part[4] for part in apart_by_sign])[0]) > 0.15 * shortest + 20:
        # The fastest edge of the scene ends the intervals too, but at another value where the polarity turns.
        return Estimate(0.0, 0.0, shortest * 1e-6, 1e-4, f"at most that: {note}, which the scene's speed may explain")
    ends = np.linspace(0.0, smallest[0] - 0.5, 4000)
    apart = np.log((smallest[-1] - ends[:, None]) / (smallest[None, :-1] - ends[:, None]))
    shape = count / apart.sum(axis=1)
    likelihood = count * np.log(shape / (smallest[-1] - ends)) + ((shape - 1)[:, None] * -apart).sum(axis=1)
    likelihood = np.where((shape >= 1.0) | (np.arange(len(ends)) == 0), likelihood, -np.inf)
    best = int(np.argmax(likelihood))
    inside = np.flatnonzero(likelihood >= likelihood[best] - 1.353)
    # Few intervals near the end: the shape of their distribution is only a guess.
    doubt = SYSTEMATIC["refractory_seconds"] * ends[best] if count < _MANY_SHORT else 0.0
    low = max(ends[inside[0]] - 1 - doubt, 0.0)
    return Estimate(float(ends[best]) * 1e-6, float(low) * 1e-6, float(smallest[0] + 1) * 1e-6, 1e-4, note)


def hot_mask(still: Still) -> npt.NDArray[np.bool_]:
    """Return which pixels fire far more often than the others while they see no change: [P]."""
    seconds, events = still.seconds.sum(axis=1), (still.on + still.off).sum(axis=1)
    lit = still.light.sum(axis=1)
    usual = np.zeros(len(seconds))
    seen = seconds > 0
    if not seen.any():
        return np.zeros(len(seconds), bool)
    light = np.divide(lit, seconds, out=np.zeros_like(lit), where=seen)
    edges = np.quantile(light[seen], np.linspace(0, 1, 9)[1:-1])
    group = np.searchsorted(edges, light)
    for number in range(8):
        mine = seen & (group == number)
        if mine.any():
            rates = events[mine] / seconds[mine]
            rate = rates[rates <= 4 * max(float(np.median(rates)), 1.0 / float(np.median(seconds[mine])))]
            usual[mine] = rate.mean() if len(rate) else 0.0
    expected = usual * seconds
    return np.asarray(seen & (events > expected + 5 * np.sqrt(expected) + 5))


def hot_pixels(
    still: Still, is_hot: npt.NDArray[np.bool_], thresholds: tuple[float, float], refractory_seconds: float,
    blocks: npt.NDArray[np.int64],
) -> tuple[Estimate, Estimate]:  # fmt: skip
    """Estimate the share of hot pixels and the deviation of their drift, log units a second."""
    seconds = still.seconds.sum(axis=1)
    seen = seconds >= 0.3
    if seen.sum() < 500:
        note = f"{seen.sum()} pixels without a change for 0.3 s; needs 500"
        return unknown(note), unknown(note)
    hot = is_hot & seen
    on, off = still.on.sum(axis=1)[hot], still.off.sum(axis=1)[hot]
    period = seconds[hot] / np.maximum(on + off, 1)
    drift = np.where(on > off, *thresholds) / np.maximum(period - refractory_seconds, 0.2 * period)
    others = seen & ~is_hot
    usual = (still.on + still.off).sum(axis=1)[others].sum() / max(seconds[others].sum(), 1e-9)
    length = float(np.median(seconds[seen]))
    least = min(thresholds) * (usual * length + 5 * math.sqrt(usual * length) + 5) / length
    table = np.stack([seen, hot, np.zeros(len(seen))], axis=1).astype(np.float64)
    table[hot, 2] = np.minimum(drift, 1e4) ** 2
    sums = sums_by_block(blocks, table, int(blocks.max()) + 1)

    def solve(s: Doubles) -> Doubles:
        pixels, count, squares = s
        if count < 1:
            return np.zeros(2)
        sigma = _untruncated(math.sqrt(squares / count), least)
        return np.array([count / pixels / math.erfc(least / sigma / math.sqrt(2.0)), sigma])

    value, low, high = bootstrap(sums, solve)
    note = f"{hot.sum()} of {seen.sum()} pixels without a change fire far more often than the others"
    most = 3.0 / float(seen.sum())
    share = Estimate(value[0], low[0], max(high[0], most), 1e-3, note)
    if hot.sum() < 5:
        return share, unknown(note)
    # Few pixels: a bootstrap of blocks is too sure of the width of a normal distribution.
    half = 1.645 / math.sqrt(2 * hot.sum())
    return share, Estimate(value[1], min(low[1], value[1] * (1 - half)), max(high[1], value[1] * (1 + half)), 0.0, note)


def _untruncated(root_mean_square: float, least: float) -> float:
    """Return the deviation of a normal distribution from the rms of its values beyond ``least``."""
    low, high = least / 6.0, root_mean_square
    for _ in range(60):
        sigma = (low + high) / 2
        a = least / sigma
        tail = math.erfc(a / math.sqrt(2.0)) / 2
        rms = sigma * math.sqrt(1 + a * math.exp(-a * a / 2) / math.sqrt(2 * math.pi) / max(tail, 1e-300))
        low, high = (sigma, high) if rms < root_mean_square else (low, sigma)
    return (low + high) / 2


def dead_pixels(recording: Recorded, blocks: npt.NDArray[np.int64]) -> Estimate:
    """Estimate the share of pixels that never fire, among those whose neighbours do."""
    import cv2

    counts = recording.counts.sum(axis=0)
    near = cv2.medianBlur(np.minimum(counts, 60_000).astype(np.uint16), 3).ravel()[recording.pixels]
    active = near >= 20
    if active.sum() < 500:
        return unknown(f"{active.sum()} pixels have active neighbours; needs 500")
    silent = active & (counts.ravel()[recording.pixels] == 0)
    sums = sums_by_block(blocks, np.stack([active, silent], axis=1).astype(np.float64), int(blocks.max()) + 1)
    value, low, high = bootstrap(sums, lambda s: np.array([s[1] / max(s[0], 1.0)]))
    most = float(silent.sum() + 2.5 + 1.645 * math.sqrt(silent.sum())) / float(active.sum())
    note = f"{silent.sum()} of {active.sum()} pixels with active neighbours are silent"
    return Estimate(float(value[0]), float(low[0]), max(float(high[0]), most), 1e-3, note)
