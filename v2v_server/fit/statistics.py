"""Statistics in which a recording and its simulation are compared, and the distance between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.fit.increments import intervals_us, still_time
from v2v_server.fit.interval import DRAWS, LEVEL, Doubles
from v2v_server.fit.recording import Recorded

BRIGHTNESS_EDGES = np.array([0, 24, 48, 80, 112, 144, 176, 208, 256])
COUNT_EDGES = np.array([0, 1, 2, 4, 8, 16, 32, 128, 512, 1 << 40])
INTERVAL_EDGES_US = np.concatenate([[0.0], np.geomspace(50, 5e6, 21), [np.inf]])
_BLOCK_SIDE = 8
_EXPOSURES = {"rates": "exposure", "still": "still_exposure"}


@dataclass(frozen=True, eq=False)
class Panels:
    """Statistics by block of the sensor, [blocks, k] sums each.

    Attributes:
        rates: events by brightness, darker then brighter: k = 16; ``exposure``, pixel-seconds of each brightness: 8.
        still: the same of pixels that see no change.
        pixels, still_pixels: pixels by their number of events, in all time and while they see no change: 9.
        intervals: between events of a pixel, of one polarity, then of opposite ones: 44.
    """

    rates: Doubles
    exposure: Doubles
    still: Doubles
    still_exposure: Doubles
    pixels: Doubles
    still_pixels: Doubles
    intervals: Doubles


def panels_of(recording: Recorded, light: Doubles, begin_us: int, end_us: int) -> Panels:
    """Measure the events between two times."""
    count, blocks = len(recording.pixels), recording.blocks(_BLOCK_SIDE)
    owner = np.repeat(np.arange(count), np.diff(recording.first))
    inside = (recording.t_us >= begin_us) & (recording.t_us < end_us)
    mean_grey = recording.frames.mean(axis=0) if len(recording.frames) else np.full(count, 128.0)
    bright = np.searchsorted(BRIGHTNESS_EDGES, mean_grey, side="right") - 1
    seconds = np.full(count, (end_us - begin_us) * 1e-6)
    sign = recording.p.astype(np.int64)
    events = owner[inside]
    still = still_time(recording, light)
    gaps = np.empty((2, 0)) if len(events) < 2 else intervals_us(recording)
    after = np.flatnonzero(np.diff(owner) == 0) if len(owner) else np.empty(0, np.int64)
    number = np.searchsorted(INTERVAL_EDGES_US, gaps[0], side="right") - 1
    totals, quiet_seconds = np.bincount(events, minlength=count), still.seconds.sum(axis=1)
    noise = np.stack([still.off.sum(axis=1), still.on.sum(axis=1)])
    quiet = np.flatnonzero(quiet_seconds > 0.5 * quiet_seconds.max(initial=0.0))
    return Panels(
        _table(blocks[events], sign[inside] * 8 + bright[events], None, 16),
        _table(blocks, bright, seconds, 8),
        _table(np.tile(blocks, 2), np.concatenate([bright, 8 + bright]), noise.ravel(), 16),
        _table(blocks, bright, still.seconds.sum(1), 8),
        _table(blocks, _class_of(totals), None, len(COUNT_EDGES) - 1),
        _table(blocks[quiet], _class_of((still.on + still.off).sum(axis=1)[quiet]), None, len(COUNT_EDGES) - 1),
        _table(blocks[owner[after]], number + 22 * (gaps[1] < 0.5), None, 44),
    )  # fmt: skip


def distance(measured: Panels, simulated: Panels, weights: Doubles, names: tuple[str, ...]) -> float:
    """Return the squared distance of the square roots of statistics, each normalised to a sum of 1, summed.

    Args:
        weights: [blocks] number of times that each block counts.
        names: the statistics to compare, attributes of :class:`Panels`.
    """
    total = 0.0
    for name in names:
        mine, other = (weights @ getattr(panels, name) for panels in (measured, simulated))
        if name in _EXPOSURES:
            exposures = (weights @ getattr(panels, _EXPOSURES[name]) for panels in (measured, simulated))
            mine, other = map(per_second, (mine, other), exposures)
        scale = max((mine.sum() + other.sum()) / 2, 1e-12)
        total += float(((np.sqrt(mine / scale) - np.sqrt(other / scale)) ** 2).sum())
    return total


def gain(
    measured: Panels, simulated: Panels, without: Panels, held_out: npt.NDArray[np.bool_], names: tuple[str, ...]
) -> tuple[float, float]:
    """Return how much closer a simulation is than the one without an effect, and the lower end of its interval.

    Args:
        held_out: [blocks] mask of the blocks that the fit has not seen.
        names: see :func:`distance`.
    """
    rng, chosen = np.random.default_rng(0), np.flatnonzero(held_out)
    values = []
    for draw in range(DRAWS + 1):
        drawn = chosen if draw == 0 else rng.choice(chosen, len(chosen))
        weights = np.bincount(drawn, minlength=len(held_out)).astype(np.float64)
        values.append(distance(measured, without, weights, names) - distance(measured, simulated, weights, names))
    return values[0], float(np.quantile(values[1:], (1 - LEVEL) / 2))


def per_second(events: Doubles, exposure: Doubles) -> Doubles:
    """Return [2 k] rates of events, darker then brighter, from [k] pixel-seconds; 0 where there is no time."""
    time = np.tile(exposure, 2)
    return np.divide(events, time, out=np.zeros_like(events), where=time > 0)


def _class_of(counts: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    return np.searchsorted(COUNT_EDGES, counts, side="right") - 1


def _table(block: npt.NDArray[Any], column: npt.NDArray[Any], weight: Doubles | None, columns: int) -> Doubles:
    blocks = _BLOCK_SIDE**2
    sums = np.bincount(block * columns + column, weight, blocks * columns)
    return sums.astype(np.float64).reshape(blocks, columns)
