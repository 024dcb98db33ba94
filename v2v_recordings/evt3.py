"""Read and write EVT 3, words of 16 bits of Prophesee's sensors. The upper four bits are the type of a word.

    0x0        row of the events that follow; bit 11 is set by the second camera of a pair
    0x2        an event: its column, and its polarity in bit 11
    0x3        column and polarity at which vectors begin
    0x4, 0x5   vector: an event for each bit set of 12 or 8, from the column on, which then advances by 12 or 8
    0x6, 0x8   lower and upper 12 bits of the time of the events that follow, us
    0x7, 0xf   continue a word; 0xa is an external trigger, 0xe another message: passed over
    0x1        row of grey levels, whose columns and vectors are no events
    others     reserved: passed over, and counted

The upper bits go round every 16.8 s. A sensor repeats them every 16 us, but converters write them with events only: a
step back is a new round if it is a quarter of a round forward or less.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import EventChunk, Note
from v2v_recordings.limits import FORM_LIMITS

Longs = npt.NDArray[np.int64]
Uint16s = npt.NDArray[np.uint16]
WORD = np.dtype("<u2")
BLOCK_WORDS = 1 << 17
"""Words that are decoded at once; a word holds at most 12 events, which take 100 bytes each while they are decoded."""
ROUND, HIGH_US = 1 << 12, 1 << 12
"""Number of values of the upper bits of a time, and their unit."""
MOST_LATE, MOST_AHEAD = 2, ROUND // 4
"""The upper bits may step back by this within a round, and forward by this into the next one."""
RESERVED, FEW_RESERVED = (0x9, 0xB, 0xC, 0xD), 64
"""Types of words that have no meaning, and how many such words may be in any file."""
_UNKNOWN = -(1 << 40)
"""Stands for upper bits or a column of which no word was read yet."""
_ADVANCE_PX, _VALID = np.zeros(16, np.int64), np.zeros(16, np.uint16)
_ADVANCE_PX[[4, 5]], _VALID[[4, 5]] = (12, 8), (0xFFF, 0xFF)
_COUNTED, _COUNTER_BITS = np.zeros(16, np.int64), 20
_COUNTED[[6, 8]], _COUNTED[[0, 1]], _COUNTED[3] = 1, 1 << _COUNTER_BITS, 1 << 2 * _COUNTER_BITS
"""Counters of the words of times, rows and columns, in one number; a block has fewer words than a counter holds."""


class Decoder:
    """Decode the words of a stream in blocks of at most BLOCK_WORDS.

    Attributes:
        words, reserved: number of words, and of those that have reserved types.
        foreign: number of rows of a second camera. Their events are left out.
    """

    word = WORD

    def __init__(self) -> None:
        self.words = self.reserved = self.foreign = 0
        self._high, self._camera = _UNKNOWN, -1
        self._last = {"t_ns": _UNKNOWN * HIGH_US * 1000, "row": -1, "base": 2 * _UNKNOWN}

    def decode(self, words: Uint16s) -> EventChunk:
        """Return the events of the next words, [N]. Events before the first time, row or column are left out.

        Raises:
            UsageError: more than an eighth of the words have reserved types.
        """
        kinds = (words >> 12).astype(np.uint8)
        self.words += len(words)
        self.reserved += sum(int(np.count_nonzero(kinds == kind)) for kind in RESERVED)
        if self.reserved > max(FEW_RESERVED, self.words // 8):
            raise UsageError(
                f"{self.reserved} of {self.words} words have types that EVT 3 reserves: the file is damaged, or its "
                "words begin with their upper byte, which is not supported"
            )
        times, rows = self._times(kinds, words), self._rows(words[np.flatnonzero(kinds <= 1)])
        places = np.flatnonzero((kinds == 2) | (kinds == 4) | (kinds == 5))
        counted = _COUNTED[kinds]
        seen, mask = np.cumsum(counted, out=counted)[places], (1 << _COUNTER_BITS) - 1
        t_ns = self._held("t_ns", times)[seen & mask]
        row = self._held("row", rows)[seen >> _COUNTER_BITS & mask]
        events, kinds, bases = words[places], kinds[places], np.flatnonzero(kinds == 3)
        x, p, is_known = events & 0x7FF, events & 0x800 != 0, (row >= 0) & (t_ns > _UNKNOWN)
        if (kinds == 2).all() and not len(bases):
            chosen = slice(None) if is_known.all() else is_known
            return EventChunk(t_ns[chosen], x[chosen], row[chosen], p[chosen])

        # A vector begins at its base, and as much later as the vectors between the two advance.
        is_vector = kinds != 2
        before = np.concatenate([[0], np.cumsum(_ADVANCE_PX[kinds])])
        columns = (words[bases] & 0x7FF) - before[np.searchsorted(places, bases)]
        base = self._held("base", 2 * columns + (words[bases] >> 11 & 1))[seen >> 2 * _COUNTER_BITS]
        self._last["base"] += 2 * int(before[-1])
        x = np.where(is_vector, (base >> 1) + before[:-1], x)
        p = np.where(is_vector, base & 1 == 1, p)
        events = np.where(is_vector, events & _VALID[kinds], 1) * (is_known & (x >= 0))
        bits = np.unpackbits(events.astype(WORD).view(np.uint8), bitorder="little")
        flat = np.flatnonzero(bits.view(np.bool_))
        which = flat >> 4
        flat &= 15
        return EventChunk(t_ns[which], x[which] + flat, row[which], p[which])

    def notes(self) -> Iterator[Note]:
        """Yield what was left out."""
        if self.reserved:
            yield Note(f"{self.reserved} words of types that EVT 3 reserves are passed over")
        if self.foreign:
            yield Note(f"the events of a second camera, in {self.foreign} rows, are left out")

    def _held(self, name: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return what is in force after each number of words that set it, [1 + S]: the last value before, and these."""
        values = np.concatenate([np.array([self._last[name]], values.dtype), values])
        self._last[name] = int(values[-1])
        return values

    def _rows(self, words: Uint16s) -> npt.NDArray[np.int16]:
        """Return the row that each word sets, [R]; -1 if its events are to be left out."""
        if self._camera < 0 and (words < 0x1000).any():
            self._camera = int(words[words < 0x1000][0]) >> 11
        row, camera = (words & 0x7FF).astype(np.int16), words >> 11
        row[camera != self._camera] = -1
        self.foreign += int(np.count_nonzero(camera == 1 - self._camera))
        return row

    def _times(self, kinds: npt.NDArray[np.uint8], words: Uint16s) -> Longs:
        """Return the time after each word that changes it, [T], ns. Repeated upper bits get a type to pass over.

        Args:
            kinds, words: [M], types of the words, some of which are changed, and the words.
        """
        places = np.flatnonzero((kinds == 6) | (kinds == 8))
        low = (words[places] & 0xFFF).astype(np.int64)
        at = np.flatnonzero(kinds[places] == 8)
        highs = low[at]
        before = int(highs[0]) if self._high == _UNKNOWN and len(highs) else self._high
        steps = np.diff(highs, prepend=before % ROUND)
        is_next = (steps < -MOST_LATE) & (steps % ROUND <= MOST_AHEAD)
        is_previous = steps >= ROUND - MOST_LATE
        highs += before - before % ROUND + ROUND * np.cumsum(is_next.astype(np.int64) - is_previous)
        highs = np.concatenate([[self._high], highs])
        self._high, repeated = int(highs[-1]), at[np.diff(highs) == 0]
        low[at] = 0
        low += np.repeat(highs * HIGH_US, np.diff(at, prepend=0, append=len(low)))
        changes = np.ones(len(low), bool)
        changes[repeated] = False
        kinds[places[repeated]] = 0xF
        return low[np.flatnonzero(changes)] * 1000


def header_of(width_px: int, height_px: int) -> bytes:
    """Return the lines before the words of a file."""
    size = f"% format EVT3;height={height_px};width={width_px}\n% geometry {width_px}x{height_px}\n"
    return f"% evt 3.0\n{size}% end\n".encode()


class Encoder:
    """Encode events in order, chunk by chunk. Times count from the beginning of the file.

    As with a sensor, upper bits are never skipped: from the beginning on, a word follows every 4.1 ms.
    """

    def __init__(self) -> None:
        self._t_us, self._high, self._row = -1, -1, -1

    def encode(self, chunk: EventChunk) -> Uint16s:
        """Return the words of the next events, [M].

        Args:
            chunk: events in order of time, whose coordinates have at most 11 bits.

        Raises:
            UsageError: times are below 0, step back, or are beyond the limit.
        """
        if not len(chunk):
            return np.empty(0, WORD)
        t_us, end_us = chunk.t_ns // 1000, FORM_LIMITS["EVT 3"].end_us
        if min(t_us[0], t_us[0] - self._t_us) < 0 or (t_us[1:] < t_us[:-1]).any() or t_us[-1] >= end_us:
            raise UsageError(
                f"events at {t_us.min()} to {t_us.max()} us: EVT 3 takes times in order, from 0 to {end_us - 1} us"
            )
        table, is_sent = np.empty((len(t_us), 3), WORD), np.ones((len(t_us), 3), bool)
        table[:, 0], table[:, 1] = 0x6000 | t_us & 0xFFF, chunk.y
        table[:, 2] = 0x2000 | chunk.p.astype(WORD) << 11 | chunk.x.astype(WORD)
        is_sent[0, :2] = t_us[0] > self._t_us, chunk.y[0] != self._row
        is_sent[1:, 0], is_sent[1:, 1] = t_us[1:] > t_us[:-1], chunk.y[1:] != chunk.y[:-1]
        sent = np.flatnonzero(is_sent)
        words, high = table.reshape(-1)[sent], t_us // HIGH_US
        risen = np.diff(high, prepend=self._high)
        if len(places := np.flatnonzero(risen)):
            highs = 0x8000 | (np.arange(self._high + 1, high[-1] + 1) % ROUND).astype(WORD)
            words = np.insert(words, np.repeat(np.searchsorted(sent, 3 * places), risen[places]), highs)
            self._high = int(high[-1])
        self._t_us, self._row = int(t_us[-1]), int(chunk.y[-1])
        return words
