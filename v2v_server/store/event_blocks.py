"""Unpack blocks of recorded events, and keep the events of a crop: the part that is compiled."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np

from v2v_recordings.binning import NEVER


@numba.njit(nogil=True, cache=True)
def unpack_block(rows, begin_ns, unit_ns, edges_ns, window, is_flipped, times, span_ns, t_ns, pixel, brighter):
    """Unpack the events of a block (:mod:`v2v_recordings.block_file`).

    Args:
        rows: [8, n] uint8, the block.
        begin_ns, unit_ns: time of the first event, and unit of the steps.
        edges_ns: [G + 1] int64, ascending; events before the first and from the last on are left out.
        window: (top, left, height, width) of the crop.
        is_flipped: whether columns are counted from the right of the crop.
        times: [n] int64, is overwritten.
        span_ns: [G, 2] int64, receives the times of the first and last event between two edges; NEVER before.
        t_ns: [n] int64, receives the times of the events in the crop.
        pixel: [n] int64, receives their places in the crop, row by row.
        brighter: [n] bool, receives their polarities.

    Returns:
        how many events are in the crop.
    """
    top, left, height, width = window
    step_0, step_1, step_2, step_3, x_low, x_high, y_low, y_high = rows
    byte, two, three = np.uint32(8), np.uint32(16), np.uint32(24)
    now, kept, count = np.int64(begin_ns), np.int64(0), rows.shape[1]
    for i in range(count):
        step = np.uint32(step_0[i]) | np.uint32(step_1[i]) << byte
        now += np.int64(step | np.uint32(step_2[i]) << two | np.uint32(step_3[i]) << three) * unit_ns
        times[i] = now
    for grid in range(len(span_ns)):
        first = np.searchsorted(times[:count], edges_ns[grid])
        last = np.searchsorted(times[:count], edges_ns[grid + 1])
        if first < last:
            if span_ns[grid, 0] == NEVER:
                span_ns[grid, 0] = times[first]
            span_ns[grid, 1] = times[last - 1]
    begin, end = np.searchsorted(times[:count], edges_ns[0]), np.searchsorted(times[:count], edges_ns[-1])
    for i in range(begin, end):
        # Unsigned: what is left of the crop, or above it, wraps to large numbers.
        x = (np.uint32(x_low[i]) | np.uint32(x_high[i]) << byte) - np.uint32(left)
        y_and_p = np.uint32(y_low[i]) | np.uint32(y_high[i]) << byte
        y = (y_and_p >> np.uint32(1)) - np.uint32(top)
        # What is not in the crop is overwritten: a branch here would be predicted wrongly too often.
        t_ns[kept] = times[i]
        pixel[kept] = np.int64(y) * width + (width - 1 - np.int64(x) if is_flipped else np.int64(x))
        brighter[kept] = y_and_p & np.uint32(1)
        kept += (x < np.uint32(width)) & (y < np.uint32(height))
    return kept
