"""The events one by one, of which ``kernels.list_events`` makes an event list."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numpy as np

from v2v_server.simulation.effects.state import hook


def prepare(memory, given, segments, real):
    """Return [capacity, 4] float64, the first events: pixel, segment, 1 or 0 for the polarity, and share of the segment
    that has passed; [1] int64, number of events.
    """
    return memory, np.zeros(1, np.int64)


@hook
def events(tables, train):
    """List events while there is room; count all."""
    rows, count = tables
    if len(rows) > 0:
        for k in range(train.count):
            place = count[0]
            if place < len(rows):
                rows[place, 0], rows[place, 1], rows[place, 2] = train.pixel, train.segment, train.is_rising
                rows[place, 3] = train.passed + k * train.apart
            count[0] += 1
        return train.count
    return 0
