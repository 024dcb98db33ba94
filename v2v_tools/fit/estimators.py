"""Estimate noise, mismatch and defects of a camera from what :mod:`v2v_tools.fit.increments` measures.

mismatch               products of residuals of different increments of one pixel
shot noise, leak       events of pixels that see no change
refractory period      end of the distribution of the shortest intervals, by profile likelihood
hot and dead pixels    pixels of a far higher rate than others; silent pixels among active ones
times of the frames    the offset at which their changes correlate best with the events
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from v2v_tools.fit.increments import BRIGHTEST_GREY, Increments, Still
from v2v_tools.fit.interval import Doubles, Estimate, bootstrap, sums_by_block, unknown
from v2v_tools.fit.recording import Recorded
from v2v_tools.fit.regression import LEAST_INCREMENTS, SYSTEMATIC, Regression, summit

LEAST_SECONDS = 200.0
"""Pixel-seconds without a change that rates of noise need."""
OFFSETS_US = np.arange(-15_000, 15_001, 1000)
_WIDEST_OFFSET_SECONDS = 0.004
_MOST_STEPS, _MOST_COUNT, _DARK = 32, 5, 0.03
_GLITCHES = 3e-5
_MANY_SHORT, _EDGE, _REACH = 100, 0.01, 1.3


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
    return estimate.moved(estimate.value, SYSTEMATIC["threshold_mismatch_sigma"] * estimate.value)


def noise_rates(
    still: Still, blocks: npt.NDArray[np.int64], is_hot: npt.NDArray[np.bool_], static: bool = False
) -> tuple[Estimate, Estimate]:
    """Estimate shot noise (of a black pixel, both polarities) and the surplus of brighter events, Hz."""
    seconds = float(still.seconds[~is_hot].sum())
    if seconds < LEAST_SECONDS:
        remedy = "record for longer" if static else "hold the camera still"
        note = f"{seconds:.0f} pixel-seconds without a change; needs {LEAST_SECONDS:.0f}: {remedy}"
        return unknown(note), unknown(note)
    block = (blocks[:, None] * 4 + np.arange(4)).ravel()
    columns = [part * ~is_hot[:, None] for part in (still.on, still.off, still.seconds, still.light)]
    sums = sums_by_block(block, np.stack([column.ravel() for column in columns], axis=1), 4)

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
    below, beyond = np.searchsorted(gaps, edges), np.searchsorted(gaps, _REACH * edges)
    expected = (_REACH - 1) * below
    end = int(np.argmax(beyond - below > 2 * expected + 5 * np.sqrt(expected) + 20))
    floor = int(below[end])
    half = np.searchsorted(gaps, edges[end] / 2)
    if floor > 10 + 3 * glitches and 0.35 < half / floor < 0.65 and 0.3 < is_same[:floor].mean() < 0.7:
        note = f"{floor} intervals of noise that ignores it, and the first others after {edges[end]:.0f} us"
        return Estimate(0.0, 0.0, _REACH * edges[end] * 1e-6, 1e-4, note)
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
    ends = np.linspace(0.0, smallest[0] - 0.5, 4000)
    apart = np.log((smallest[-1] - ends[:, None]) / (smallest[None, :-1] - ends[:, None]))
    shape = count / apart.sum(axis=1)
    likelihood = count * np.log(shape / (smallest[-1] - ends)) + ((shape - 1)[:, None] * -apart).sum(axis=1)
    likelihood = np.where((shape >= 1.0) | (np.arange(len(ends)) == 0), likelihood, -np.inf)
    best = int(np.argmax(likelihood))
    inside = np.flatnonzero(likelihood >= likelihood[best] - 1.353)
    # Few intervals near the end: the shape of their distribution is only a guess.
    doubt = (SYSTEMATIC["refractory_seconds"] if count < _MANY_SHORT else _EDGE) * ends[best]
    low = max(ends[inside[0]] - 1 - doubt, 0.0)
    return Estimate(float(ends[best]) * 1e-6, float(low) * 1e-6, float(smallest[0] + 1) * 1e-6, 1e-4, note)


def hot_mask(still: Still) -> npt.NDArray[np.bool_]:
    """Return which pixels fire far more often than the others while they see no change: [P]."""
    seconds, events = still.seconds.sum(axis=1), (still.on + still.off).sum(axis=1)
    seen, expected = np.flatnonzero(seconds > 0), np.full(len(seconds), np.inf)
    by_light = seen[np.argsort(still.light.sum(axis=1)[seen] / seconds[seen], kind="stable")]
    for mine in np.array_split(by_light, min(8, len(seen)) or 1):
        rates = events[mine] / seconds[mine]
        usual = rates <= 4 * max(np.median(rates), 1.0 / np.median(seconds[mine])) if len(mine) else rates
        expected[mine] = rates[usual].mean() * seconds[mine] if len(mine) else 0.0
    return np.asarray(events > expected + 5 * np.sqrt(expected) + 5)


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
    sums = sums_by_block(blocks, table)

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
    sigma = np.linspace(min(least / 6.0, root_mean_square), root_mean_square, 2000)
    a = least / sigma
    tail = np.array([max(math.erfc(each / math.sqrt(2.0)) / 2, 1e-300) for each in a])
    rms = sigma * np.sqrt(1 + a * np.exp(-a * a / 2) / math.sqrt(2 * math.pi) / tail)
    return float(np.interp(root_mean_square, rms, sigma))


def dead_pixels(recording: Recorded, blocks: npt.NDArray[np.int64]) -> Estimate:
    """Estimate the share of pixels that never fire, among those whose neighbours do."""
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
    return Estimate(float(value[0]), float(low[0]), max(float(high[0]), most), 1e-3, note)


def frame_offset(recording: Recorded) -> Estimate:
    """Estimate how much later than its time a frame was seen, s: where the correlation of changes of log intensity with
    signed events is largest. Clipped levels are left out, and counts limited: lamps that flicker have many events, and
    no frame shows them.
    """
    t, frame_us, reach = recording.t_us, recording.frame_us, OFFSETS_US[-1]
    steps = np.flatnonzero((frame_us[:-1] - reach >= t.min()) & (frame_us[1:] + reach <= t.max()))
    if not len(steps):
        return unknown(f"no two frames have events for {reach / 1000:g} ms before and after them")
    steps = steps[:: -(-len(steps) // _MOST_STEPS)]
    owner, blocks = np.repeat(np.arange(len(recording.pixels)), np.diff(recording.first)), recording.blocks()
    level = np.log(_DARK + recording.known_light.of(np.arange(256.0)))
    sums = np.zeros((64, len(OFFSETS_US), 2))
    for step in steps:
        before, after = recording.frames[step : step + 2]
        seen = np.maximum(before, after) <= BRIGHTEST_GREY
        change = np.where(seen, level[after] - level[before], 0.0)
        near = (t >= frame_us[step] - reach) & (t < frame_us[step + 1] + reach)
        at, pixel, sign = t[near], owner[near], np.where(recording.p[near], 1.0, -1.0)
        for number, offset in enumerate(OFFSETS_US):
            inside = (at >= frame_us[step] + offset) & (at < frame_us[step + 1] + offset)
            count = np.bincount(pixel[inside], sign[inside], len(change))
            count = np.clip(count, -_MOST_COUNT, _MOST_COUNT) * seen
            sums[:, number] += sums_by_block(blocks, np.stack([change * count, count**2], axis=1))
    seconds = np.asarray(OFFSETS_US * 1e-6, np.float64)
    value, low, high = bootstrap(
        sums, lambda s: np.array([summit(seconds, s[:, 0] / np.sqrt(np.maximum(s[:, 1], 1e-9)))])
    )
    note = f"{len(steps)} steps between frames"
    if high[0] - low[0] > _WIDEST_OFFSET_SECONDS or abs(value[0]) > seconds[-3]:
        return unknown(f"the events fit no offset much better than others, by {note}")
    return Estimate(float(value[0]), float(low[0]), float(high[0]), 0.0, note)
