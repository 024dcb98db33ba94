"""Leave effects out of a clip that they change less than a tolerance (``tolerance`` of the spec).

An effect moves the residual of a pixel by some thresholds. Each step in which the pixel fires then ends at another
event with that probability, and the bins on both sides change by one. Each effect states how many events it changes so
(``changed`` of its file); their share of all events is compared, times its ``MARGIN``. The figures are those of the
paper's pixel without noise at every eighth row and column. They are sums of whole numbers, so every host chooses alike.
Of the sets of effects whose shares together are within the tolerance, the one that takes the most time (``COST``) is
left out. An effect without these, such as mismatch and dead pixels, always stays.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import lru_cache, partial
from itertools import combinations

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects import EFFECTS
from v2v_server.simulation.effects.state import UNITS, Fired
from v2v_server.simulation.intensity import Intensity, linear_light, log_table_float64
from v2v_server.simulation.kernels import KernelInput, fill
from v2v_server.simulation.voxel import Longs, bin_edges

COSTS: Mapping[str, float] = {effect.FIELD: effect.COST for effect in EFFECTS if hasattr(effect, "COST")}
"""Processor time of each effect that can be left out, relative."""
_EVERY_PX = 8


def left_out(shares: Mapping[str, float], tolerance: float) -> frozenset[str]:
    """Return the effects to leave out of a clip.

    Args:
        shares: of :func:`changed_shares`.
        tolerance: largest sum of the shares.
    """
    names = [name for name in COSTS if shares.get(name, math.inf) <= tolerance]
    sets = [each for count in range(1, len(names) + 1) for each in combinations(names, count)]
    fit = [each for each in sets if math.fsum(shares[name] for name in each) <= tolerance]
    return frozenset(max(fit, key=lambda each: sum(COSTS[name] for name in each), default=()))


def changed_shares(given: KernelInput) -> dict[str, float]:
    """Return which share of a clip's events each of its effects changes at most; nothing for a clip without events."""
    intensity, source, seconds, params = given.intensity, given.source_index, given.step_seconds, given.params
    if intensity is None or not params.effects.keys() & COSTS:
        return {}
    grey = np.ascontiguousarray(given.frames[: source[-1] + 1, ::_EVERY_PX, ::_EVERY_PX]).reshape(source[-1] + 1, -1)
    smaller = min(params.threshold_pos, params.threshold_neg)
    moves = np.flatnonzero(source[1:] > source[:-1])  # other steps show a frame again
    plain = _plain_events(given, grey)
    total, events = int(np.abs(plain).sum()), plain[moves]
    if not total:
        return {}
    later = math.fsum(np.count_nonzero(events, axis=1) * (np.cumsum(seconds) - seconds)[moves])
    fired = Fired(
        grey, linear_light(*intensity), np.abs(np.diff(_levels(intensity)[grey], axis=0)), events,
        1.0 / (smaller * seconds[moves]), later, math.fsum(seconds), partial(_lost_to_noise, given, threshold=smaller),
    )  # fmt: skip
    own = {effect.FIELD: effect for effect in EFFECTS if effect.FIELD in COSTS and effect.FIELD in params.effects}
    return {name: each.MARGIN * each.changed(params.effects[name], fired) / total for name, each in own.items()}


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


def _lost_to_noise(given: KernelInput, refractory: float, *, threshold: float) -> float:
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
    """Return log intensity by grey level, whole numbers of 1/UNITS."""
    return np.rint(log_table_float64(*intensity) * UNITS).astype(np.int64)
