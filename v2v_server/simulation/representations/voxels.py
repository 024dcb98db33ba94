"""Voxels: V[b] is the number of positive less that of negative events in bin b (``voxel.py``)."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import store


@hook
def end(voxels, counts):
    """Store the bin in [grids, bins, pixels]."""
    if len(voxels) > 0:
        return store(counts.net, counts.limit, voxels[counts.grid, counts.bin, counts.first : counts.last])
    return 0
