"""The events one by one, of which ``kernels.list_events`` makes an event list."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from v2v_server.simulation.effects.state import hook

_WORD_BITS, _DIGIT_BITS = 63, 11
"""Bits of a word of the sort, and how many of a time one pass looks at."""


class EventRows(NamedTuple):
    """Memory for events, [capacity, 2] int64, and for the sort, [capacity] int64."""

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
    return EventRows(np.empty((capacity, 2), np.int64), np.empty(capacity, np.int64))


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


def columns_in_order(rows, spare, width, place, t, p):
    """Sort events by time, those of a microsecond by pixel, and write their columns; equal ones stay in their order.

    Args:
        rows: [n, 2] int64, as listed; changed, as is ``spare``, [n] int64.
        width: of the picture, px.
        place: [2, n] uint16, x and y; ``t``: [n] int64; ``p``: [n] bool; all written.
    """
    if len(rows) == 0:
        return
    times, codes = rows.T
    first = int(times.min())
    code_bits, time_bits = (int(codes.max()) | 1).bit_length(), (int(times.max()) - first).bit_length()
    if code_bits + time_bits < _WORD_BITS:
        _columns_of_words(rows, spare, first, code_bits, time_bits, np.uint32(width), place, t, p)
        return
    t[:], codes = rows[np.lexsort((codes >> 1, times))].T
    place[1], place[0], p[:] = (codes >> 1) // width, (codes >> 1) % width, codes & 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _columns_of_words(rows, spare, first, code_bits, time_bits, width, place, t, p):
    """Do it with an event in a word: its time after ``first`` in the upper bits."""
    passes = -(-time_bits // _DIGIT_BITS)
    digit = -(-time_bits // max(passes, 1))
    mask, ends = (1 << digit) - 1, np.zeros((max(passes, 1), (1 << digit) + 1), np.int64)
    for i in range(len(rows)):
        time = rows[i, 0] - first
        spare[i] = time << code_bits | rows[i, 1]
        for number in range(passes):
            ends[number, (time >> number * digit & mask) + 1] += 1
    words, other = spare, rows.reshape(-1)[: len(rows)]
    for number in range(passes):
        shift = code_bits + number * digit
        for value in range(1 << digit):
            ends[number, value + 1] += ends[number, value]
        for i in range(len(words)):
            value = words[i] >> shift & mask
            other[ends[number, value]] = words[i]
            ends[number, value] += 1
        words, other = other, words
    for i in range(1, len(words)):
        if words[i] >> 1 < words[i - 1] >> 1:  # a microsecond in two segments
            begin, end, time = i - 1, i + 1, words[i] >> code_bits
            while begin > 0 and words[begin - 1] >> code_bits == time:
                begin -= 1
            while end < len(words) and words[end] >> code_bits == time:
                end += 1
            words[begin:end] = words[begin:end][np.argsort(words[begin:end] >> 1, kind="mergesort")]
    for i in range(len(words)):
        pixel = np.uint32((words[i] & ((1 << code_bits) - 1)) >> 1)
        y = np.uint32(pixel // width)
        place[1, i], place[0, i] = y, pixel - y * width
        t[i], p[i] = first + (words[i] >> code_bits), words[i] & 1 == 1
