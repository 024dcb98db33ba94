"""Time surface: the age, in seconds, of a pixel's last negative (0) and positive (1) event at the end of each bin.

    A[p, b] = t_b - max(t of the events of polarity p up to t_b)

over the clip from its start, not only over the bin; infinity before the first event. So exp(-A / tau), the exponential
time surface of Lagorce et al., "HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition", TPAMI 2017,
is 0 there for every time constant tau.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numpy as np

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK
from v2v_server.simulation.voxel import Moments, time_of


def prepare(memory, given, segments, real):
    """Return [grids, 2, bins, pixels], the ages; [2, block] float64, times of the last events, seconds since the clip's
    start; float64 start and duration of each segment, [G], and end of each bin, [grids, bins].
    """
    seconds = given.step_seconds
    begins, ends = time_of(Moments(segments.step, segments.start), seconds), time_of(given.edges, seconds)[1:]
    return (
        memory,
        np.empty((2, PIXELS_A_BLOCK)),
        begins,
        segments.share * seconds[segments.step],
        ends.reshape(-1, given.bins),
    )


@hook
def begin(tables, first):
    """Forget the events of other pixels."""
    ages, latest, _, _, _ = tables
    if len(ages) > 0:
        latest[:] = -np.inf
    return 0


@hook
def events(tables, train):
    """Note the time of the last one."""
    ages, latest, begins, lasts, _ = tables
    if len(ages) > 0:
        passed = train.passed + (train.count - 1) * train.apart
        time = begins[train.segment] + passed * lasts[train.segment]
        latest[train.is_rising, train.place] = max(latest[train.is_rising, train.place], time)
    return 0


@hook
def end(tables, counts):
    """Store the ages. Rounding must not put an event behind the end of its bin."""
    ages, latest, _, _, ends = tables
    if len(ages) > 0:
        for polarity in range(2):
            for i in range(counts.last - counts.first):
                age = max(ends[counts.grid, counts.bin] - latest[polarity, i], 0.0)
                ages[counts.grid, polarity, counts.bin, counts.first + i] = age
    return 0
