"""The events one by one, of which ``kernels.list_events`` makes an event list."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from v2v_server.simulation.effects.state import hook

_DIGIT_BITS = 16
"""Bits of a time that one pass of the sort looks at; its counters then fit into a core's cache."""


class EventRows(NamedTuple):
    """Memory for events, [capacity, 2] int64, and as much again for the sort."""

    own: Any
    spare: Any


class Listing(NamedTuple):
    """The listed events, and when the segments are.

    Attributes:
        rows: [capacity, 2] int64, the first events: time, microseconds, and 2 x pixel + 1 for a positive one.
        start_us, span_us: [G] float64, of each segment.
        first_us, last_us: [G] int64, first and last whole microsecond of the bin that holds it.
    """

    rows: Any
    start_us: Any
    span_us: Any
    first_us: Any
    last_us: Any


def new_rows(capacity: int) -> EventRows:
    """Return memory for events."""
    return EventRows(np.empty((capacity, 2), np.int64), np.empty((capacity, 2), np.int64))


def prepare(memory, given, segments, real):
    """Return the listing; [1] int64, number of events."""
    return memory, np.zeros(1, np.int64)


@hook
def events(tables, train):
    """List events while there is room; count all."""
    listing, count = tables
    if len(listing.rows) > 0:
        segment = train.segment
        start, span = listing.start_us[segment], listing.span_us[segment]
        for k in range(train.count):
            place = count[0] + k
            if place < len(listing.rows):
                passed = train.passed + k * train.apart
                time = min(np.int64(start + passed * span), listing.last_us[segment])
                listing.rows[place, 0] = max(time, listing.first_us[segment])
                listing.rows[place, 1] = 2 * train.pixel + train.is_rising
        count[0] += train.count
        return train.count
    return 0


@numba.njit(nogil=True, cache=True)
def columns_in_order(rows, spare, width, place, t, p):
    """Sort events by time, those of a microsecond by pixel, and write their columns; equal ones stay in their order.

    Args:
        rows: [n, 2] int64, as listed; changed, as is ``spare``, [n, 2] int64.
        width: of the picture, px.
        place: [2, n] uint16, x and y; ``t``: [n] int64; ``p``: [n] bool; all written.
    """
    if len(rows) == 0:
        return
    first, last = rows[0, 0], rows[0, 0]
    for i in range(len(rows)):
        first, last = min(first, rows[i, 0]), max(last, rows[i, 0])
    bits = 0
    while (last - first) >> bits > 0:
        bits += 1
    passes = -(-bits // _DIGIT_BITS)
    digit = -(-bits // max(passes, 1))
    for number in range(passes):
        shift, mask = number * digit, (1 << digit) - 1
        ends = np.zeros((1 << digit) + 1, np.int64)
        for i in range(len(rows)):
            ends[((rows[i, 0] - first) >> shift & mask) + 1] += 1
        for value in range(1 << digit):
            ends[value + 1] += ends[value]
        for i in range(len(rows)):
            value = (rows[i, 0] - first) >> shift & mask
            spare[ends[value], 0], spare[ends[value], 1] = rows[i, 0], rows[i, 1]
            ends[value] += 1
        rows, spare = spare, rows
    begin = 0
    for i in range(1, len(rows) + 1):
        if i == len(rows) or rows[i, 0] != rows[begin, 0]:
            _order_pixels(rows[begin:i, 1])
            begin = i
    for i in range(len(rows)):
        code = rows[i, 1]
        place[1, i], place[0, i] = (code >> 1) // width, (code >> 1) % width
        t[i], p[i] = rows[i, 0], code & 1 == 1


@numba.njit(nogil=True, cache=True)
def _order_pixels(codes):
    """Sort the events of one microsecond by pixel. They are in order, apart from a microsecond in two segments."""
    for i in range(1, len(codes)):
        if codes[i] >> 1 < codes[i - 1] >> 1:
            codes[:] = codes[np.argsort(codes >> 1, kind="mergesort")]
            return
