"""Unpack a block of recorded events, and keep those in a crop: the part that is compiled."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np


@numba.njit(nogil=True, cache=True)
def unpack_block(rows, first, begin_ns, unit_ns, window, is_flipped, t_ns, inside, pixel, brighter):
    """Unpack the events of a block (:mod:`v2v_recordings.block_file`).

    Args:
        rows: [8, n] uint8, the block.
        first: number of its first event.
        begin_ns, unit_ns: time of the first event, and unit of the steps.
        window: (top, left, height, width) of the crop.
        is_flipped: whether columns are counted from the right of the crop.
        t_ns: [n] int64, receives the times of all events.
        inside: [n] int64, receives the numbers of those in the crop.
        pixel: [n] int64, receives their places in the crop, row by row.
        brighter: [n] bool, receives their polarities.

    Returns:
        how many events are in the crop.
    """
    top, left, height, width = window
    now, kept = np.int64(begin_ns), 0
    for i in range(rows.shape[1]):
        step = (
            np.int64(rows[0, i]) | np.int64(rows[1, i]) << 8 | np.int64(rows[2, i]) << 16 | np.int64(rows[3, i]) << 24
        )
        now += step * unit_ns
        t_ns[i] = now
        x = (np.int64(rows[4, i]) | np.int64(rows[5, i]) << 8) - left
        y_and_p = np.int64(rows[6, i]) | np.int64(rows[7, i]) << 8
        y = (y_and_p >> 1) - top
        # What is not in the crop is overwritten: a branch here would be predicted wrongly too often.
        inside[kept] = first + i
        pixel[kept] = y * width + (width - 1 - x if is_flipped else x)
        brighter[kept] = y_and_p & 1
        kept += (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return kept
