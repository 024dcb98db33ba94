"""Event counts: the negative (0) and positive (1) events of each bin (``voxel.py``)."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.pixel import store


@hook
def end(stored, counts):
    """Store the bin in [grids, 2, bins, pixels]."""
    if len(stored) > 0:
        off = store(counts.off, counts.limit, stored[counts.grid, 0, counts.bin, counts.first : counts.last])
        return off + store(counts.on, counts.limit, stored[counts.grid, 1, counts.bin, counts.first : counts.last])
    return 0
