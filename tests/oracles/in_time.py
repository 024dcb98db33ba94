"""Events with times, one by one in float64, and the arrays that are made of them: the reference of the general kernel.

Written from the docstrings of ``v2v_server/simulation/voxel.py`` and ``v2v_protocol/sample.py``, not from the kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """What one pixel fires: times, ascending, and the sign of each event."""

    times: list[float]
    signs: list[int]


def watch(
    times: Doubles, levels: Doubles, start: float, positive: float, negative: float, *, tolerance: float = 0.0,
    refractory: float = 0.0,
) -> Seen:  # fmt: skip
    """Simulate one pixel whose log intensity is linear between known levels.

    Args:
        times: [n] of the known levels, increasing.
        levels: [n] log intensity, with whatever else is added to it.
        start: the residual at the first of them.
        positive, negative, tolerance: log units.
        refractory: time without events after an event, in the unit of ``times``.
    """
    seen = Seen([], [])
    residual, blind_until = start, -math.inf
    for begin, end, low, high in zip(times[:-1], times[1:], levels[:-1], levels[1:], strict=True):
        slope, now = (high - low) / (end - begin), max(begin, min(blind_until, end))
        while now < end:
            reached = residual + slope * (end - now)
            sign = 1 if reached >= 0 else -1
            threshold = positive if sign > 0 else negative
            if abs(reached) + tolerance < threshold:
                residual = reached
                break
            if slope != 0:
                now = min(max(now + (threshold - sign * residual) / abs(slope), now), end)
            seen.times.append(now)
            seen.signs.append(sign)
            residual = 0.0 if slope != 0 else residual - sign * threshold
            blind_until = now + refractory
            now = min(blind_until, end) if refractory else now
    return seen


def counts_of(seen: Seen, edges: Doubles) -> npt.NDArray[np.int64]:
    """Return the negative and positive events of each bin: [2, bins]. An event at an edge belongs to the bin before."""
    place = np.clip(np.searchsorted(edges, seen.times, side="left") - 1, 0, len(edges) - 2)
    found = np.zeros((2, len(edges) - 1), np.int64)
    for bin_of, sign in zip(place, seen.signs, strict=True):
        found[int(sign > 0), bin_of] += 1
    return found


def bilinear_of(times: Doubles, signs: Doubles, begin: float, end: float, bins: int) -> Doubles:
    """Return the interpolated voxel grid of the events of one pixel from ``begin`` to ``end``: [bins].

    V[b] = sum p max(0, 1 - |b - t*|), t* = (B - 1) (t - begin) / (end - begin): Zhu et al. 2019.
    """
    place = (bins - 1) * (np.asarray(times) - begin) / (end - begin)
    weight = np.maximum(0.0, 1.0 - np.abs(np.arange(bins)[:, None] - place))
    return np.asarray((weight * np.asarray(signs)).sum(axis=1))


def ages_of(seen: Seen, edges: Doubles) -> Doubles:
    """Return the age of the last negative and positive event at the end of each bin: [2, bins], infinity without one.

    An event at an edge belongs to the bin before.
    """
    times, signs = np.array(seen.times), np.array(seen.signs)
    ages = [
        [end - max(times[(signs == sign) & (times <= end)], default=-math.inf) for end in edges[1:]] for sign in (-1, 1)
    ]
    return np.array(ages)


def stacked_histogram(
    x: npt.NDArray[np.int64], y: npt.NDArray[np.int64], polarity: npt.NDArray[np.int64], time: npt.NDArray[np.int64],
    bins: int, height: int, width: int, cutoff: int | None = None,
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """Return the stacked histogram of Gehrig and Scaramuzza, "Recurrent Vision Transformers for Object Detection with
    Event Cameras" (CVPR 2023), as its published code defines it: [2 * bins, height, width], negative bins first.

    Times are divided evenly from the first to the last event, the last event belonging to the last bin; counts above
    ``cutoff`` are clipped.
    """
    share = (time - time[0]).astype(np.float32) / np.float32(max(time[-1] - time[0], 1))
    bin_of = np.minimum(np.floor(share * np.float32(bins)).astype(np.int64), bins - 1)
    counts = np.zeros((2, bins, height, width), np.int64)
    np.add.at(counts, (polarity, bin_of, y, x), 1)
    return np.minimum(counts, 255 if cutoff is None else cutoff).astype(np.uint8).reshape(2 * bins, height, width)
