"""Event counts: the negative (0) and positive (1) events of each bin (``voxel.py``)."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import store
from v2v_server.simulation.representations import Clip


class Tables(NamedTuple):
    """[grids, 2, bins, pixels], the counts; real, the largest; [1] int64, bins that were clipped to it."""

    counts: Any
    limit: Any
    clipped: Any


def prepare(array: npt.NDArray[Any] | None, clip: Clip) -> Tables:
    """Return the tables, see ``representations/__init__.py``."""
    return Tables(clip.memory(array, clip.dtype, 2, clip.bins), clip.limit, np.zeros(1, np.int64))


@hook
def end(tables, counts):
    """Store the bin."""
    if len(tables.counts) > 0:
        bins = tables.counts.shape[2]
        grid, of_grid, first, last = counts.bin // bins, counts.bin % bins, counts.first, counts.last
        tables.clipped[0] += store(counts.off, tables.limit, tables.counts[grid, 0, of_grid, first:last])
        tables.clipped[0] += store(counts.on, tables.limit, tables.counts[grid, 1, of_grid, first:last])


def finish(tables: Tables, array: npt.NDArray[Any]) -> int:
    """Return the number of clipped bins."""
    return int(tables.clipped[0])
