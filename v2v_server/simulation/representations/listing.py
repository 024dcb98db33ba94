"""The events one by one, of which ``kernels.list_events`` makes an event list."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import hook

_WORD_BITS, _DIGIT_BITS = 63, 11
"""Bits of a word of the sort, and how many of a time one pass looks at."""


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


def columns_in_order(rows: npt.NDArray[np.int64], width: int) -> tuple[Any, Any, Any, Any]:
    """Return x, y, t and p of events by time, those of a microsecond by pixel; equal ones stay in their order.

    Args:
        rows: [n, 2] int64, as listed; changed.
        width: of the picture, px.

    Returns:
        [n] uint16, uint16, int64 and bool.
    """
    count = len(rows)
    (x, y), t, p = np.empty((2, count), np.uint16), np.empty(count, np.int64), np.empty(count, np.bool_)
    if count:
        times, codes = rows.T
        first = int(times.min())
        code_bits, time_bits = (int(codes.max()) | 1).bit_length(), (int(times.max()) - first).bit_length()
        if code_bits + time_bits < _WORD_BITS:
            _columns_of_words(rows, first, code_bits, time_bits, np.uint32(width), x, y, t, p)
        else:
            t[:], codes = rows[np.lexsort((codes >> 1, times))].T
            y[:], x[:], p[:] = (codes >> 1) // width, (codes >> 1) % width, codes & 1
    return x, y, t, p


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _columns_of_words(rows, first, code_bits, time_bits, width, x, y, t, p):
    """Write the columns; the sort sees an event as one word, with its time after ``first`` in the upper bits."""
    passes = -(-time_bits // _DIGIT_BITS)
    digit = -(-time_bits // max(passes, 1))
    words, mask = np.empty(len(rows), np.int64), (1 << digit) - 1
    ends = np.zeros((max(passes, 1), (1 << digit) + 1), np.int64)
    for i in range(len(rows)):
        time = rows[i, 0] - first
        words[i] = time << code_bits | rows[i, 1]
        for number in range(passes):
            ends[number, (time >> number * digit & mask) + 1] += 1
    other = rows.reshape(-1)[: len(rows)]
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
        row = np.uint32(pixel // width)
        y[i], x[i] = row, pixel - row * width
        t[i], p[i] = first + (words[i] >> code_bits), words[i] & 1 == 1
