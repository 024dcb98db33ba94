"""The events one by one, of which ``kernels.list_events`` makes an event list."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.representations import Clip


class Tables(NamedTuple):
    """
    Attributes:
        rows: [capacity, 4] float64 of the first events: pixel, segment, 1 or 0 for the polarity, and the share of the
            segment that has passed.
        count: [1] int64, number of all events.
        is_on: whether they are counted.
    """

    rows: Any
    count: Any
    is_on: Any


def prepare(array: npt.NDArray[Any] | None, clip: Clip) -> Tables:
    """Return the tables, see ``representations/__init__.py``."""
    return Tables(np.empty((0, 4)) if array is None else array, np.zeros(1, np.int64), array is not None)


@hook
def events(tables, train):
    """List events while there is room; count them."""
    if tables.is_on:
        for k in range(train.count):
            place = tables.count[0]
            if place < len(tables.rows):
                tables.rows[place, 0], tables.rows[place, 1] = train.pixel, train.segment
                tables.rows[place, 2], tables.rows[place, 3] = train.is_rising, train.passed + k * train.apart
            tables.count[0] += 1


def finish(tables: Tables, array: npt.NDArray[Any]) -> int:
    """Return the number of events that there was no room for."""
    return int(tables.count[0]) - len(array)
