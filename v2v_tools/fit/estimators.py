"""Estimate noise, mismatch and defects of a camera from what :mod:`v2v_tools.fit.increments` measures.

mismatch               products of residuals of different increments of one pixel
shot noise, leak       events of pixels that see no change, unless their signs alternate
refractory period      end of the distribution of the shortest intervals, by profile likelihood
hot and dead pixels    pixels of a far higher rate and one sign; silent pixels among active ones
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from v2v_tools.fit.increments import Increments, events_of_steps
from v2v_tools.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded
from v2v_tools.fit.regression import LEAST_INCREMENTS, SYSTEMATIC, Regression

LEAST_SECONDS = 200.0
"""Pixel-seconds without a change that rates of noise need."""
_GLITCHES = 3e-5
_MANY_SHORT, _EDGE, _LEAST_FLOOR, _BALANCED = 100, 0.01, 60, 0.2
_MOST_BY_CHANCE, _SHARE_OF_DARK = 20.0, 0.7
_IGNORES = "noise ignores it"
_MOST_EXCESS, _MOST_MINORITY = 0.1, 0.2


def mismatch(fitted: Regression, given: Increments, blocks: npt.NDArray[np.int64]) -> Estimate:
    """Estimate the spread of the thresholds over pixels, as a share.

    A pixel that sees the same edge again and again repeats its errors in both polarities, while its two thresholds are
    independent: products of residuals of opposite changes are subtracted. Pixels far from the others drift by
    themselves. ``blocks``: [P], block of each pixel.
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
        share = np.abs(of_pixel[0]) / np.maximum(of_pixel[2], 1e-9)
        usual = share <= 4 * 1.4826 * (np.median(share[of_pixel[2] > 0]) if len(chosen) else 0.0)
        # Increments that follow each other share a frame, and its rounding.
        beside = np.flatnonzero((np.diff(pixel) == 0) & (np.diff(chosen) == 1))
        pair, pair_weight = product[beside] * product[beside + 1], (count[beside] * count[beside + 1]) ** 2
        of_pixel += [2 * np.bincount(pixel[beside], part, size) for part in (pair, pair_weight)]
        parts.append(np.stack(of_pixel).astype(np.float64) * usual)
    columns = []
    for one, squares, weight, fourth, near, near_weight in parts:
        scale = 1.0 / np.maximum(weight, 1e-9)  # a pixel counts by its events, not by the square of them
        columns += [(one**2 - squares - near) * scale, (weight**2 - fourth - near_weight) * scale]
    both = 1.0 / np.maximum(np.sqrt(parts[0][2] * parts[1][2]), 1e-9)
    columns += [parts[0][0] * parts[1][0] * both, parts[0][2] * parts[1][2] * both]
    on, on_weight, off, off_weight, cross, cross_weight = columns
    table = np.stack([on + off, on_weight + off_weight, cross, cross_weight], axis=1)
    sums = sums_by_block(blocks, table)
    if min(sums[:, 1].sum(), sums[:, 3].sum()) < LEAST_INCREMENTS:
        return unknown("too few pixels with several changes in both directions")

    def solve(s: Doubles) -> Doubles:
        common = max(s[2] / max(s[3], 1e-12), 0.0)
        return np.array([s[0] / max(s[1], 1e-12) - common, common])

    value, low, high = bootstrap(sums, solve)
    doubt = float(value[1]) / 2
    ends = [math.sqrt(max(float(end), 0.0)) for end in (value[0], low[0] - doubt, high[0] + doubt)]
    estimate = Estimate(ends[0], ends[1], ends[2], 0.05, "residuals of several changes of one pixel")
    return estimate.widened(SYSTEMATIC["threshold_mismatch_sigma"])


def unexplained(recording: Recorded, still: npt.NDArray[np.bool_], is_hot: npt.NDArray[np.bool_]) -> str:
    """Return why shot noise and leak do not explain the events of still pixels; nothing if they may.

    Both leave the sign of an event independent of the sign before it, because each event restarts its pixel. Pixels of
    other rates have fewer opposite signs together, not more. Noise before the comparator and a lamp alternate.

    Args:
        still: [n - 1, P], see ``is_still``.
        is_hot: [P].
    """
    step, owner, p = events_of_steps(recording)
    quiet = still[step, owner] & ~is_hot[owner]
    follows = (owner[1:] == owner[:-1]) & quiet[1:] & quiet[:-1]
    count, on = int(follows.sum()), float(p[quiet].mean()) if quiet.any() else 0.0
    opposite, expected = float((p[1:] != p[:-1])[follows].mean()) if count else 0.0, 2 * on * (1 - on)
    why = (
        f"events of still pixels alternate: {opposite:.0%} of {count} have the sign opposite to the one before, and "
        f"shot noise and leak explain {expected:.0%}"
    )
    return why if opposite > expected + _MOST_EXCESS + 1.5 / math.sqrt(max(count, 1)) else ""


def shot_noise(
    still: Doubles, blocks: npt.NDArray[np.int64], is_hot: npt.NDArray[np.bool_], static: bool = False
) -> Estimate:
    """Estimate shot noise, Hz, of a black pixel, both polarities. A leak fires brighter events, so the darker count.

    ``still`` is [4, P, 4] (``still_time``); ``blocks`` and ``is_hot`` are [P], of each pixel.
    """
    still = still * ~is_hot[:, None]
    seconds, _, on, off = still.sum(axis=(1, 2))
    if seconds < LEAST_SECONDS:
        return unknown(
            f"{seconds:.0f} pixel-seconds without motion; needs {LEAST_SECONDS:.0f}: "
            f"{'record for longer' if static else 'hold the camera still'}"
        )
    sums = sums_by_block((blocks[:, None] * 4 + np.arange(4)).ravel(), still.reshape(4, -1).T, 4)
    value, low, high = bootstrap(sums, lambda s: np.array([2 * s[3] / max(s[0] - 0.75 * s[1], 1e-9)]))
    note = f"{on:.0f} brighter and {off:.0f} darker events in {seconds:.0f} pixel-seconds without motion"
    # Without an event, the upper end is that of a Poisson process.
    made = Estimate(value[0], low[0], max(high[0], 6.0 / seconds), 0.2, note)
    return made.widened(SYSTEMATIC["shot_noise_hz"])


def refractory(gaps_us: Doubles) -> Estimate:
    """Estimate the refractory period, s, from intervals between events of a pixel, [2, n] (``intervals_us``).

    Near its end, the distribution shows how far below the shortest interval the period may lie.
    Noise that ignores the period makes shorter intervals, evenly long and of any two signs: the period lies below their
    end, and its lower end is not seen.
    """
    if gaps_us.shape[1] < 1000:
        return unknown(f"{gaps_us.shape[1]} intervals between events; needs 1000")
    in_order = np.argsort(gaps_us[0])
    gaps, is_same = gaps_us[0, in_order], gaps_us[1, in_order] > 0
    # A few events of a recording may have wrong times.
    glitches = int(_GLITCHES * len(gaps))
    edges = np.geomspace(25.0, 1e4, 100)
    below, half = np.searchsorted(gaps, edges), np.searchsorted(gaps, edges / 2)
    least = _LEAST_FLOOR + 3 * glitches
    is_flat = np.abs(half - below / 2) <= 1 + 1.75 * np.sqrt(below)
    end = int(np.argmin(is_flat | (below <= least))) or len(edges) - 1
    floor = int(below[end - 1])
    if floor > least and abs(is_same[:floor].mean() - 0.5) < _BALANCED:
        note = f"{_IGNORES}: {floor} intervals of any two signs end before {edges[end]:.0f} us"
        return Estimate(0.0, 0.0, float(edges[end]) * 1e-6, 1e-4, note)
    gaps, is_same = gaps[glitches:], is_same[glitches:]
    shortest = float(gaps[0])
    count = int(np.clip(np.count_nonzero(gaps <= 1.1 * shortest + 20), 20, 2000))
    smallest = gaps[: count + 1] + 0.5
    if smallest[0] < 30.0:
        return Estimate(0.0, 0.0, smallest[0] * 1e-6, 1e-4, f"shortest interval {smallest[0]:.0f} us")
    note = f"shortest of {len(gaps)} intervals {shortest:.0f} us"
    apart_by_sign = [gaps[chosen][:5] for chosen in (is_same, ~is_same)]
    if min(map(len, apart_by_sign)) < 5 or abs(np.diff([part[4] for part in apart_by_sign])[0]) > 0.15 * shortest + 20:
        # The fastest edge of the scene ends the intervals too, but at another value where the polarity turns.
        return Estimate(0.0, 0.0, shortest * 1e-6, 1e-4, f"at most that: {note}, which the scene's speed may explain")
    # The next intervals show how far apart they are near the end. Few: the shape of their distribution is a guess.
    apart = (smallest[-1] - smallest[0]) / count
    doubt = (SYSTEMATIC["refractory_seconds"] if count < _MANY_SHORT else _EDGE) * smallest[0]
    low = max(smallest[0] - max(3 * apart + 1, doubt), 0.0)
    return Estimate((smallest[0] - apart) * 1e-6, low * 1e-6, (smallest[0] + 1) * 1e-6, 1e-4, note)


def with_noise(period: Estimate, shot: Estimate, gaps_us: Doubles) -> Estimate:
    """Return the estimate of the period, with a note of whether noise obeys it where noise events tell.

    Noise that ignores it follows another event within the period by chance. ``gaps_us``: [M] intervals.
    """
    if not (period.told and shot.told) or _IGNORES in period.note:
        return period
    shorter = np.count_nonzero(gaps_us < 0.9e6 * period.low)
    by_chance = _SHARE_OF_DARK * shot.value * period.low * len(gaps_us)
    how = "obeys" if shorter < by_chance / 4 else "ignores"
    verdict = f"noise {how} it: {shorter} shorter intervals, {by_chance:.0f} if noise ignored it"
    return period if by_chance < _MOST_BY_CHANCE else dataclasses.replace(period, note=f"{period.note}; {verdict}")


def hot_mask(still: Doubles) -> npt.NDArray[np.bool_]:
    """Return which pixels fire far more often than the others while they see no motion: [P]."""
    seconds, lit, on, off = still.sum(axis=2)
    # Shot noise falls with the light.
    dark_seconds, events = seconds - 0.75 * lit, on + off
    seen = dark_seconds > 0
    rates = events[seen] / dark_seconds[seen]
    usual = rates[rates <= 4 * max(np.median(rates), 1.0 / np.median(seconds[seen]))] if seen.any() else rates
    expected = dark_seconds * (usual.mean() if len(usual) else 0.0)
    return np.asarray(events > expected + 5 * np.sqrt(expected) + 5)


def hot_pixels(
    still: Doubles, is_hot: npt.NDArray[np.bool_], thresholds: tuple[float, float], refractory_seconds: float,
    blocks: npt.NDArray[np.int64],
) -> tuple[Estimate, Estimate]:  # fmt: skip
    """Estimate the share of hot pixels and the deviation of their drift, log units a second.

    ``still`` is [4, P, 4] (``still_time``); ``is_hot`` and ``blocks`` are [P], of each pixel.
    """
    seconds, _, on, off = still.sum(axis=2)
    seen = seconds >= 0.3
    hot = is_hot & seen
    note = f"{hot.sum()} of {seen.sum()} pixels without a change fire far more often than the others"
    few, both = seen.sum() < 500, np.minimum(on, off)[hot].sum() > _MOST_MINORITY * (on + off)[hot].sum()
    if few or both:
        why = f"{seen.sum()} pixels without a change for 0.3 s; needs 500" if few else f"{note}, with both signs"
        return unknown(why), unknown(why)
    period = seconds[hot] / np.maximum(on + off, 1)[hot]
    drift = np.where((on > off)[hot], *thresholds) / np.maximum(period - refractory_seconds, 0.2 * period)
    others = seen & ~is_hot
    length = float(np.median(seconds[seen]))
    usual = length * float((on + off)[others].sum()) / max(float(seconds[others].sum()), 1e-9)
    least = min(thresholds) * (usual + 5 * math.sqrt(usual) + 5) / length
    table = np.stack([seen, hot, np.zeros(len(seen))], axis=1).astype(np.float64)
    table[hot, 2] = np.minimum(drift, 1e4) ** 2
    sums = sums_by_block(blocks, table)

    def solve(s: Doubles) -> Doubles:
        pixels, count, squares = s
        if count < 1:
            return np.zeros(2)
        sigma = _untruncated(math.sqrt(squares / count), least)
        return np.array([min(count / pixels / math.erfc(least / sigma / math.sqrt(2.0)), 1.0), sigma])

    value, low, high = bootstrap(sums, solve)
    most = 3.0 / float(seen.sum())
    # A share of 1 rests on so short a tail that the rest of the distribution is a guess.
    share = (
        Estimate(value[0], max(low[0], 0.0), min(max(high[0], most), 1.0), 1e-3, note)
        if value[0] < 1.0
        else unknown(f"{note}, but barely beyond the limit")
    )
    if hot.sum() < 5 or value[0] >= 1.0:
        return share, unknown(note)
    # Few pixels: a bootstrap of blocks is too sure of the width of a normal distribution.
    half = 1.645 / math.sqrt(2 * hot.sum())
    return share, Estimate(value[1], min(low[1], value[1] * (1 - half)), max(high[1], value[1] * (1 + half)), 0.0, note)


def _untruncated(root_mean_square: float, least: float) -> float:
    """Return the deviation of a normal distribution from the rms of its values beyond ``least``."""
    sigma = np.linspace(min(least / 6.0, root_mean_square), root_mean_square, 2000)
    a = least / sigma
    tail = np.array([max(math.erfc(each / math.sqrt(2.0)) / 2, 1e-300) for each in a])
    rms = sigma * np.sqrt(1 + a * np.exp(-a * a / 2) / math.sqrt(2 * math.pi) / tail)
    return float(np.interp(root_mean_square, rms, sigma))


def dead_pixels(recording: Recorded, blocks: npt.NDArray[np.int64]) -> Estimate:
    """Estimate the share of pixels that never fire, among those whose neighbours do. ``blocks``: [P], of each pixel."""
    import cv2

    counts = recording.counts.sum(axis=0)
    near = cv2.medianBlur(np.minimum(counts, 60_000).astype(np.uint16), 3).ravel()[recording.pixels]
    active = near >= 20
    if active.sum() < 500:
        return unknown(f"{active.sum()} pixels have active neighbours; needs 500")
    silent = active & (counts.ravel()[recording.pixels] == 0)
    sums = sums_by_block(blocks, np.stack([active, silent], axis=1).astype(np.float64))
    value, low, high = bootstrap(sums, lambda s: np.array([s[1] / max(s[0], 1.0)]))
    most = float(silent.sum() + 2.5 + 1.645 * math.sqrt(silent.sum())) / float(active.sum())
    note = f"{silent.sum()} of {active.sum()} pixels with active neighbours are silent"
    return Estimate(float(value[0]), max(float(low[0]), 0.0), max(float(high[0]), most), 1e-3, note)
