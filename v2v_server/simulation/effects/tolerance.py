"""Leave effects out of a clip that they change less than a tolerance (``tolerance`` of the spec).

An effect moves the residual of a pixel by some thresholds. Each step in which the pixel fires then ends at another
event with that probability, and the bins on both sides change by one. So the changed events are

    photoreceptor    2 sum |dL| / c x lag / T: a low-pass lags by 1 / (2 pi f), f by grey level
    refractory       what is lost, sum n |dL| / c x t / T, and 2 |what was lost before, rising less falling| in each
                     step with events
    shot noise       the events, and one more in each later step with events, since they clear the residual
    leak             the events, and 2 x what has leaked before in each step with events

with n events and a change of log intensity dL in a step of T seconds, c the smaller threshold. Their share of all
events is compared, times MARGINS. The figures are those of the paper's pixel without noise at every eighth row and
column. They are sums of whole numbers, so every host chooses alike. Of the sets of effects whose shares together are
within the tolerance, the one that takes the most time is left out. Mismatch and dead pixels always stay.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import combinations

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.photoreceptor import DARKEST
from v2v_server.simulation.effects.shot_noise import WHITE_SHOT_NOISE
from v2v_server.simulation.intensity import Intensity, linear_light, log_table_float64
from v2v_server.simulation.kernels import KernelInput, fill
from v2v_server.simulation.voxel import Longs, bin_edges

MARGINS = {"shot_noise_hz": 2.0, "refractory_seconds": 4.0, "photoreceptor_hz": 2.0, "leak_hz": 6.0}
"""Factors by which more events may change than the model says, on real footage."""
_COSTS = {"shot_noise_hz": 10, "refractory_seconds": 8, "photoreceptor_hz": 7, "leak_hz": 1}
"""Processor time of each effect, relative."""
_UNITS = 2**20
"""Parts of a threshold, and of a log unit, that figures are counted in."""
_EVERY_PX = 8


def left_out(shares: Mapping[str, float], tolerance: float) -> frozenset[str]:
    """Return the effects to leave out of a clip.

    Args:
        shares: of :func:`changed_shares`.
        tolerance: largest sum of the shares.
    """
    names = [name for name in _COSTS if shares.get(name, math.inf) <= tolerance]
    sets = [each for count in range(1, len(names) + 1) for each in combinations(names, count)]
    fit = [each for each in sets if math.fsum(shares[name] for name in each) <= tolerance]
    return frozenset(max(fit, key=lambda each: sum(_COSTS[name] for name in each), default=()))


def changed_shares(given: KernelInput) -> dict[str, float]:
    """Return which share of a clip's events each of its effects changes at most; nothing for a clip without events."""
    intensity, source, seconds, params = given.intensity, given.source_index, given.step_seconds, given.params
    if intensity is None or not params.effects.keys() & _COSTS:
        return {}
    part = np.ascontiguousarray(given.frames[: source[-1] + 1, ::_EVERY_PX, ::_EVERY_PX]).reshape(source[-1] + 1, -1)
    pixels, smaller = part.shape[1], min(params.threshold_pos, params.threshold_neg)
    moves = np.flatnonzero(source[1:] > source[:-1])  # other steps show a frame again
    pace = 1.0 / (smaller * seconds[moves])  # thresholds a log unit and second
    light, effects = linear_light(*intensity), params.effects
    lag_hz = effects.get("photoreceptor_hz", math.inf)
    lag = np.rint((1.0 + DARKEST) / (2.0 * np.pi * lag_hz * (light + DARKEST)) * 2**40).astype(np.int64) >> 20
    blind = effects.get("refractory_seconds", 0.0) * pace
    total, fires, lagged, lost, shown = _sums(part, _plain_events(given, part), moves, _levels(intensity), lag, blind)
    if not total:
        return {}
    clip_seconds, later = math.fsum(seconds), math.fsum(fires * (np.cumsum(seconds) - seconds)[moves])
    changed = {}
    for name, value in effects.items():
        if name == "photoreceptor_hz":
            changed[name] = 2.0 * math.fsum(lagged * pace) / 2.0**40
        elif name == "refractory_seconds":
            changed[name] = lost / _UNITS + pixels * _lost_to_noise(given, value, smaller)
        elif name == "shot_noise_hz":
            rate = value * math.fsum(shown * (1.0 - (1.0 - WHITE_SHOT_NOISE) * light)) / part.size
            changed[name] = rate * (pixels * clip_seconds + later)
        elif name == "leak_hz":
            changed[name] = value * (pixels * clip_seconds + 2.0 * later)
    return {name: MARGINS[name] * number / total for name, number in changed.items()}


@numba.njit(nogil=True, cache=True)
def _sums(part, events, moves, levels, lag, blind):  # type: ignore[no-untyped-def]
    """Sum up the figures of a clip, whole numbers.

    Args:
        part: [n, P] grey levels.
        events: [steps, P] signed events.
        moves: [n - 1] the steps that show another frame.
        levels, lag: by grey level: log intensity, and the lag of the low-pass, seconds in 1/_UNITS.
        blind: [n - 1] thresholds that a log unit, and an event, are lost in.

    Returns:
        all events; [n - 1] pixels that fire, [n - 1] change x lag; what a refractory period changes, in 1/_UNITS;
        [levels] pixels of each grey level.
    """
    count, pixels = part.shape
    fires, lagged = np.zeros(count - 1, np.int64), np.zeros(count - 1, np.int64)
    shown, before = np.zeros(len(levels), np.int64), np.zeros(pixels, np.int64)
    total = changed = 0
    for step in range(len(events)):
        for i in range(pixels):
            total += abs(events[step, i])
    for i in range(pixels):
        shown[part[0, i]] += 1
    for k in range(count - 1):
        for i in range(pixels):
            grey, fired = part[k + 1, i], events[moves[k], i]
            change = abs(levels[grey] - levels[part[k, i]])
            shown[grey] += 1
            lagged[k] += change * lag[grey]
            if fired != 0:
                fires[k] += 1
                lost = np.int64(np.rint(float(fired * change) * blind[k]))
                changed += abs(lost) + 2 * min(abs(before[i]), _UNITS)
                before[i] += lost
    return total, fires, lagged, changed, shown


def _plain_events(given: KernelInput, part: npt.NDArray[np.unsignedinteger]) -> Longs:
    """Return the signed events of each step without noise and effects, [steps, pixels].

    Args:
        part: [n, pixels], grey levels of some pixels.
    """
    steps = len(given.step_seconds)
    params = dataclasses.replace(given.params, noise_sigma=0.0, hot_pixel_count=0, effects={})
    plain = dataclasses.replace(
        given, frames=part[:, None], params=params, bins=1, edges=bin_edges(steps, 1), levels=None,
        grids_have_durations=False,
    )  # fmt: skip
    voxels = fill(plain, np.float32, {"voxels": None})[0]["voxels"]
    return np.asarray(voxels.reshape(steps, -1), np.int64)


def _lost_to_noise(given: KernelInput, refractory: float, threshold: float) -> float:
    """Return the events of a pixel that change because noise and hot drift are lost while it is blind.

    What a hot pixel loses adds up, until every bin ends at another event.
    """
    params, durations = given.params, given.noise_durations
    blind = refractory / given.step_seconds
    lost = math.fsum(params.noise_sigma**2 / threshold**2 * durations * blind)
    of_hot = math.fsum((params.hot_pixel_sigma * durations / threshold) ** 2 * blind)
    steps = len(durations)
    return float(lost + params.hot_pixel_count / given.frames[0].size * min(of_hot * steps, 2.0 * steps))


@lru_cache(maxsize=64)
def _levels(intensity: Intensity) -> Longs:
    """Return log intensity by grey level, whole numbers of 1/_UNITS."""
    return np.rint(log_table_float64(*intensity) * _UNITS).astype(np.int64)
