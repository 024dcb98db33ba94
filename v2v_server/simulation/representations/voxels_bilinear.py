"""Bilinear voxels: each event of sign p at time t is shared between the two bins next to it.

    V[b] = sum p max(0, 1 - |b - t*|),    t* = (B - 1) (t - t_0) / (t_B - t_0)

for a grid of B bins from t_0 to t_B. Source: Zhu et al., "Unsupervised Event-Based Learning of Optical Flow, Depth, and
Egomotion", CVPR 2019. Values beyond the range of float16 are clipped to it.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook
from v2v_server.simulation.representations import Clip
from v2v_server.simulation.voxel import LARGEST_FLOAT16


class Tables(NamedTuple):
    """
    Attributes:
        sums: [grids * bins, pixels] float32.
        start, length: [G] real, where in its voxel grid a segment starts and how much of it it takes, 0 .. bins - 1.
        row: [G] int64, first row of its grid.
        bins: of a grid.
    """

    sums: Any
    start: Any
    length: Any
    row: Any
    bins: Any


def prepare(array: npt.NDArray[Any] | None, clip: Clip) -> Tables:
    """Return the tables, see ``representations/__init__.py``."""
    sums = np.zeros((0 if array is None else array.size // clip.pixels, clip.pixels), np.float32)
    start, length = (clip.segments.place * ((clip.bins - 1) / clip.bins)).astype(clip.real)
    return Tables(sums, start, length, clip.segments.bin // clip.bins * clip.bins, clip.bins)


@hook
def events(tables, train):
    """Share events between the bins beside each, in closed form: they span less than a bin."""
    if len(tables.sums) > 0:
        start, length = np.float64(tables.start[train.segment]), np.float64(tables.length[train.segment])
        row, bins, sign = tables.row[train.segment], tables.bins, 2 * train.is_rising - 1
        place, apart, count = start + length * train.passed, length * train.apart, train.count
        lower = min(int(place), bins - 1)
        below = count
        if place + (count - 1) * apart >= lower + 1:
            below = min(int(np.ceil((lower + 1 - place) / apart)), count)
        for _ in range(2):
            upper = below * (place - lower) + apart * 0.5 * below * (below - 1)
            tables.sums[row + lower, train.pixel] += np.float32(sign * (below - upper))
            if lower + 1 < bins:
                tables.sums[row + lower + 1, train.pixel] += np.float32(sign * upper)
            place, count, lower = place + below * apart, count - below, lower + 1
            below = count
            if count == 0:
                break


def finish(tables: Tables, array: npt.NDArray[Any]) -> int:
    """Write the array; return the number of clipped values."""
    sums = within = tables.sums.reshape(array.shape)
    if array.dtype == np.float16:
        within = np.clip(sums, -LARGEST_FLOAT16, LARGEST_FLOAT16)
    array[...] = within
    return int(np.count_nonzero(within != sums))
