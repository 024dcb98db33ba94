"""Voxels: V[b] is the number of positive less that of negative events in bin b (``voxel.py``)."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import store
from v2v_server.simulation.representations import Clip


class Tables(NamedTuple):
    """[grids * bins, pixels], the voxels; real, their largest count; [1] int64, bins that were clipped to it."""

    voxels: Any
    limit: Any
    clipped: Any


def prepare(array: npt.NDArray[Any] | None, clip: Clip) -> Tables:
    """Return the tables, see ``representations/__init__.py``."""
    return Tables(clip.memory(array, clip.dtype), clip.limit, np.zeros(1, np.int64))


@hook
def end(tables, counts):
    """Store the bin."""
    if len(tables.voxels) > 0:
        stored = tables.voxels[counts.bin, counts.first : counts.last]
        tables.clipped[0] += store(counts.net, tables.limit, stored)


def finish(tables: Tables, array: npt.NDArray[Any]) -> int:
    """Return the number of clipped bins."""
    return int(tables.clipped[0])
