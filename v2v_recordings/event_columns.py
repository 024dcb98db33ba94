"""Say what the numbers of events mean: polarities, coordinates and times, and whether pictures are on their clock.

Files write them in several ways, and most do not say in which. So each meaning is tested where the numbers enter: what
has no plausible meaning is refused, with what was found and the flag that states the meaning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings.items import NS_PER_UNIT, ConvertOptions, EventChunk, Note

POLARITY_CODES = {
    frozenset({0, 1}): 1,
    frozenset({-1, 1}): 1,
    **{frozenset({1, 2**bits - 1}): 1 for bits in (8, 16, 32, 64)},  # -1 in a column without signs
    frozenset({1, 2}): 2,  # 0 and 1, counted from 1 as MATLAB does
}
"""The number of a brightness increase, by the two numbers of a column."""
LARGEST_COORDINATE = np.iinfo(np.uint16).max
LARGEST_NS = 2.0**62
"""Limit of times: 146 years. Differences of two fit int64."""
WRAPPING_BYTES = 4
"""Size of times that may go round."""
SHOWN_CODES = 6
ANY_DURATION_EVENTS = 1000
"""At most this many events may have any duration."""
SHORTEST_RECORDING_SECONDS, USUAL_SECONDS, LIKELY_SECONDS, LONGEST_RECORDING_SECONDS = 1e-3, 10e-3, 10.0, 86_400.0
RATES = 100.0, 2e6, 1e10
"""Events a second: at least, at most below USUAL_SECONDS, at most. The first two only where the unit is a guess."""
FEW_HZ = 1000.0
"""Fewer events a second are questioned where the unit is a guess."""
CLOCK_SLACK_SECONDS = 1.0
"""One or two pictures may be outside of the time of the events by this, and by at most the time between the two."""
MANY_TIMES = 300
"""Pictures that last more than this many times as long as the events are in another unit."""
LEAST_PERIOD_SECONDS = 50e-6
"""No camera takes pictures faster."""
_UNIT_WORDS = {
    "s": "s|secs?|seconds?",
    "ms": "ms|msecs?|milli-?seconds?",
    "us": "[uµμ]s|usecs?|micro-?seconds?",
    "ns": "ns|nsecs?|nano-?seconds?",
}


@dataclass(frozen=True)
class TimeUnit:
    """Hold the unit of a recording's times.

    Attributes:
        name: key of NS_PER_UNIT.
        is_stated: whether the file or its form states it; otherwise it is a guess.
        is_given: whether the user states it, so that any duration is believed.
    """

    name: str
    is_stated: bool = False
    is_given: bool = False

    @classmethod
    def of(cls, options: ConvertOptions, usual: str, stated: Any = None) -> TimeUnit:
        """Return the unit of the options, else that which a file states in words, else the usual one, as a guess.

        Raises:
            UsageError: the words are no unit of time.
        """
        words = stated.decode("utf-8", "replace") if isinstance(stated, bytes) else str(stated or usual)
        words = options.time_unit or words.strip().lower()
        found = [name for name, pattern in _UNIT_WORDS.items() if re.fullmatch(pattern, words)]
        if not found:
            raise UsageError(f"times in {words!r}: give one of {', '.join(NS_PER_UNIT)} with --time-unit")
        return cls(found[0], stated is not None, options.time_unit is not None)

    def check(self, events: int, seconds: float, where: str) -> None:
        """Check the duration of a recording.

        Raises:
            UsageError: no camera records this number of events in this time: the unit is wrong.
        """
        if events <= ANY_DURATION_EVENTS or self.is_given or _is_plausible(events, seconds, self.is_stated):
            return
        lasting = {name: seconds * ns / NS_PER_UNIT[self.name] for name, ns in NS_PER_UNIT.items() if name != self.name}
        likely = [name for name in lasting if _is_plausible(events, lasting[name], False)]
        likely.sort(key=lambda name: abs(math.log10(lasting[name] / LIKELY_SECONDS)))
        other = "".join(f"; in {name} they are {lasting[name]:.6g} s: give --time-unit {name}" for name in likely[:1])
        raise UsageError(
            f"{where}: {events} events in {seconds:.6g} s, if their times are in {self.name}, are not of a "
            f"camera{other}. If {self.name} is right, give --time-unit {self.name} (flags of v2v-convert and v2v-fit)"
        )


def _is_plausible(events: int, seconds: float, is_stated: bool) -> bool:
    least, most_of_short, most = RATES
    if not is_stated:
        most = most_of_short if seconds < USUAL_SECONDS else most
    lasts = SHORTEST_RECORDING_SECONDS <= seconds <= LONGEST_RECORDING_SECONDS
    return lasts and (is_stated or least * seconds <= events) and events <= most * seconds


class Rounds:
    """Tell times that go round by a clock of some bits, part by part.

    A step back by at least three quarters of the range begins a new round; any other is a late event, or a reset clock.
    """

    def __init__(self, bits: int) -> None:
        self._period, self._last = 1 << bits, np.empty(0, np.int64)

    def unwrap(self, times: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
        """Return the next times, [n], with the rounds before them."""
        joined, before = np.append(self._last, times.astype(np.int64)), len(self._last)
        if len(joined) and np.ptp(joined) >= 3 * self._period // 4:
            joined = np.unwrap(joined, 3 * self._period // 4, period=self._period).astype(np.int64)
        self._last = joined[-1:]
        return joined[before:]


class EventColumns:
    """Turn the columns of a recording, part by part, into chunks of events.

    Args:
        where: beginning of the error messages.
        unit: of the times; a reader of texts, which learns it later, sets the attribute.
        offset_ns: added to the times.
    """

    def __init__(self, where: str, unit: TimeUnit | None = None, offset_ns: int = 0) -> None:
        self.where, self.unit, self._polarities = where, unit, Polarities()
        self._rounds = Rounds(8 * WRAPPING_BYTES)
        self._offset_ns, self._count, self._first_ns, self._last_ns = offset_ns, 0, int(LARGEST_NS), -int(LARGEST_NS)

    def part(self, t: Numbers, x: Numbers, y: Numbers, p: Numbers) -> EventChunk:
        """Return the next events.

        Args:
            t, x, y, p: [n] numbers; p may be bool.

        Raises:
            UsageError: a time is out of range, a coordinate is not an integer from 0 to 65535, or the polarities have
                no known meaning.
        """
        assert self.unit is not None
        if t.dtype.kind in "iu" and t.dtype.itemsize == WRAPPING_BYTES:
            t = self._rounds.unwrap(t)
        t_ns = to_ns(t, self.where, NS_PER_UNIT[self.unit.name], self._offset_ns)
        x, y, p = self._coordinates(x, "x"), self._coordinates(y, "y"), self._polarities.are_brighter(p, self.where)
        self._first_ns, self._last_ns = t_ns.min(initial=self._first_ns), t_ns.max(initial=self._last_ns)
        self._count += len(t_ns)
        return EventChunk(t_ns, x, y, p)

    def end(self) -> Iterator[Note]:
        """Check the duration, and yield how times and polarities were taken if that is not usual.

        Raises:
            UsageError: see :meth:`TimeUnit.check`.
        """
        seconds = (self._last_ns - self._first_ns) * 1e-9
        if self.unit is not None:
            self.unit.check(self._count, seconds, self.where)
            is_guess = not (self.unit.is_stated or self.unit.is_given) and self._count > ANY_DURATION_EVENTS
            if is_guess and self._count < FEW_HZ * seconds:
                yield Note(
                    f"times are taken for {self.unit.name}, {self._count / seconds:.4g} events a second: if these are "
                    "few for this camera, give --time-unit"
                )
        if self._polarities.meaning:
            yield Note(self._polarities.meaning)

    def _coordinates(self, values: Numbers, axis: str) -> npt.NDArray[np.integer]:
        is_whole = values.dtype.kind in "iu"
        if is_whole and (not len(values) or 0 <= values.min() <= values.max() <= LARGEST_COORDINATE):
            return values
        wrong = (values != np.rint(values)) | ~((values >= 0) & (values <= LARGEST_COORDINATE))
        if wrong.any():
            at = int(wrong.argmax())
            raise UsageError(
                f"{self.where}: {axis} of event {self._count + at} is {values[at]}: coordinates must be integers from "
                f"0 to {LARGEST_COORDINATE}; are the columns in another order?"
            )
        return values.astype(np.int32)


class Polarities:
    """Tell brighter events from darker ones by the numbers in a column, read part by part.

    Attributes:
        meaning: how unusual numbers are taken; "" for 0 and 1, -1 and 1.
    """

    def __init__(self) -> None:
        self._seen, self._brighter, self.meaning = set[Any](), 0, ""

    def are_brighter(self, values: Numbers, where: str) -> npt.NDArray[np.bool_]:
        """Return which events, [n], are brightness increases.

        Raises:
            UsageError: the numbers so far are none of POLARITY_CODES, or differ in meaning from earlier ones.
        """
        if not len(values):
            return np.zeros(0, np.bool_)
        ends = np.array([values.min(), values.max()])
        is_two = ((values == ends[0]) | (values == ends[1])).all()  # quicker than to sort all
        self._seen.update((ends if is_two else np.unique(values)).tolist())
        meanings = {POLARITY_CODES[two] for two in POLARITY_CODES if self._seen <= two and self._seen & {-1, 0, 1, 2}}
        # A part of ones alone is taken as brighter: it may not turn out later to be the darker half of 1 and 2.
        brighter = self._brighter or min(meanings, default=0)
        shown = ", ".join(f"{value:g}" for value in sorted(self._seen)[:SHOWN_CODES])
        if brighter not in meanings:
            more = f" ... ({len(self._seen)} numbers)" if len(self._seen) > SHOWN_CODES else ""
            after = ", after many events of 1 alone" if meanings else ""
            raise UsageError(
                f"{where}: polarities are {shown}{more}{after}; they must be 0 and 1, -1 and 1 (also 255 and 1), or 1 "
                "and 2, of which the larger is brighter: correct the column"
            )
        self.meaning = f"polarities are {shown}: {brighter} is taken for brighter" if max(self._seen) > 1 else ""
        self._brighter = brighter
        return np.asarray(values == brighter)


def to_ns(times: Numbers, where: str, ns_per_unit: float = 1e9, offset_ns: int = 0) -> npt.NDArray[np.int64]:
    """Convert times, [n], to int64 nanoseconds: integers exactly, others as float64, rounded to the nearest.

    Args:
        where: beginning of the error message.
        ns_per_unit: nanoseconds per unit of ``times``; the default means seconds.
        offset_ns: added to the result.

    Raises:
        UsageError: a time is NaN or beyond LARGEST_NS, so its unit or the offset is probably wrong.
    """
    ns = np.rint(times.astype(np.float64) * ns_per_unit)
    ends = np.array([ns.min(initial=0), ns.max(initial=0)])
    if not (np.abs([ends, ends + offset_ns]) < LARGEST_NS).all():
        # A cast would turn all of them into the same number.
        later = f", and {offset_ns * 1e-9:.10g} s are added to it" if offset_ns else ""
        raise UsageError(
            f"{where}: a time is {ends[np.abs(ends).argmax()] * 1e-9:.10g} s{later}, which is out of range; give the "
            "unit with --time-unit"
        )
    exact = times.astype(np.int64) * int(ns_per_unit) if times.dtype.kind in "iu" else ns.astype(np.int64)
    return exact + offset_ns


def clock_fault(times: Sequence[float], first: float, last: float) -> str:
    """Return in words why pictures are not on the clock of the events; "" if they may be.

    Args:
        times: of the pictures, s, at least one.
        first, last: time of the first and the last event, s.
    """
    begin, end = min(times), max(times)
    period = (end - begin) / max(1, len(times) - 1)
    slack = min(CLOCK_SLACK_SECONDS, period or CLOCK_SLACK_SECONDS)
    among = sum(first - slack <= time <= last + slack for time in times)
    is_long = among < 2 < len(times) and end - begin > MANY_TIMES * (last - first)
    is_dense = len(times) > 2 and period < LEAST_PERIOD_SECONDS and end - begin < last - first
    is_apart = len(times) > 2 and (end < first or last < begin)
    if among and not (is_long or is_dense or is_apart):
        return ""
    cure = (
        "in different units: correct those of the pictures"
        if is_long or is_dense
        else f"and --frame-offset {1e3 * (first - begin):.3f} (flag of v2v-convert and v2v-fit) would put the first "
        "picture at the first event"
    )
    return (
        f"{len(times)} pictures are from {begin:.6f} to {end:.6f} s, the events from {first:.6f} to {last:.6f} s: they "
        f"have different clocks, {cure}"
    )


Numbers = npt.NDArray[Any]
