"""Bilinear voxels: each event of sign p at time t is shared between the two bins next to it.

    V[b] = sum p max(0, 1 - |b - t*|),    t* = (B - 1) (t - t_0) / (t_B - t_0)

for a grid of B bins from t_0 to t_B. Source: Zhu et al., "Unsupervised Event-Based Learning of Optical Flow, Depth, and
Egomotion", CVPR 2019.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numpy as np

from v2v_server.simulation.effects.state import hook


def prepare(memory, given, segments, real):
    """Return [grids, bins, pixels], the sums; real [G], where in its grid a segment starts, and its length; grids and
    bins of the segments.
    """
    memory[...] = 0
    start, length = (segments.place * ((given.bins - 1) / given.bins)).astype(real)
    return memory, start, length, segments.bin // given.bins, given.bins


@hook
def events(tables, train):
    """Share events between the bins beside each, in closed form: they span less than a bin."""
    sums, starts, lengths, grids, bins = tables
    if len(sums) > 0:
        grid, sign, length = grids[train.segment], 2 * train.is_rising - 1, np.float64(lengths[train.segment])
        place, apart = np.float64(starts[train.segment]) + length * train.passed, length * train.apart
        lower, count = min(int(place), bins - 1), train.count
        below = count
        if place + (count - 1) * apart >= lower + 1:
            below = min(int(np.ceil((lower + 1 - place) / apart)), count)
        for _ in range(2):
            upper = below * (place - lower) + apart * 0.5 * below * (below - 1)
            sums[grid, lower, train.pixel] += np.float32(sign * (below - upper))
            if lower + 1 < bins:
                sums[grid, lower + 1, train.pixel] += np.float32(sign * upper)
            place, count, lower = place + below * apart, count - below, lower + 1
            below = count
            if count == 0:
                break
    return 0
