"""Time surface: the age, in seconds, of a pixel's last negative (0) and positive (1) event at the end of each bin.

    A[p, b] = t_b - max(t of the events of polarity p up to t_b)

over the clip from its start, not only over the bin; infinity before the first event. So exp(-A / tau), the exponential
time surface of Lagorce et al., "HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition", TPAMI 2017,
is 0 there for every time constant tau. Ages beyond the range of float16 are clipped to it.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import BLOCK_PX
from v2v_server.simulation.representations import Clip
from v2v_server.simulation.voxel import LARGEST_FLOAT16, Moments, time_of


class Tables(NamedTuple):
    """
    Attributes:
        ages: [grids, 2, bins, pixels] float32.
        begin, lasts: [G] float64, start and duration of each segment, seconds since the clip's start.
        ends: [grids * bins] float64, end of each bin.
        latest: [2, block] float64, time of the last event; -infinity for none.
        limit: float64, largest age that the array stores.
        clipped: [1] int64, ages that were clipped to it.
    """

    ages: Any
    begin: Any
    lasts: Any
    ends: Any
    latest: Any
    limit: Any
    clipped: Any


def prepare(array: npt.NDArray[Any] | None, clip: Clip) -> Tables:
    """Return the tables, see ``representations/__init__.py``."""
    part, seconds = clip.segments, clip.step_seconds
    return Tables(
        clip.memory(None if array is None else np.empty(array.shape, np.float32), "float32", 2, clip.bins),
        time_of(Moments(part.step, part.start), seconds), part.share * seconds[part.step],
        time_of(clip.edges, seconds)[1:], np.empty((2, BLOCK_PX)),
        LARGEST_FLOAT16 if array is not None and array.dtype == np.float16 else np.inf, np.zeros(1, np.int64),
    )  # fmt: skip


@hook
def begin(tables, block):
    """Forget the events of other pixels."""
    if len(tables.ages) > 0:
        tables.latest[:] = -np.inf


@hook
def events(tables, train):
    """Note the time of the last one."""
    if len(tables.ages) > 0:
        passed = train.passed + (train.count - 1) * train.apart
        time = tables.begin[train.segment] + passed * tables.lasts[train.segment]
        tables.latest[train.is_rising, train.place] = max(tables.latest[train.is_rising, train.place], time)


@hook
def end(tables, counts):
    """Store the ages. Rounding must not put an event behind the end of its bin."""
    if len(tables.ages) > 0:
        bins, time = tables.ages.shape[2], tables.ends[counts.bin]
        for polarity in range(2):
            stored = tables.ages[counts.bin // bins, polarity, counts.bin % bins]
            for i in range(counts.last - counts.first):
                age = max(time - tables.latest[polarity, i], 0.0)
                if tables.limit < age < np.inf:
                    age = tables.limit
                    tables.clipped[0] += 1
                stored[counts.first + i] = age


def finish(tables: Tables, array: npt.NDArray[Any]) -> int:
    """Write the array; return the number of clipped ages."""
    array[...] = tables.ages.reshape(array.shape)
    return int(tables.clipped[0])
