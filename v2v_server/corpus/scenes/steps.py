"""Duplicated frames and their pattern.

The change of a step is the sum of the squared changes of the means of 8 x 8 blocks, of those that change by more than a
grey level. Means of blocks hold little coder noise, and squares give most weight to moving edges. It is compared with
the steps around it, up to four on either side.

In a regular pattern a step is a repeat if its change is at most 1/5 (almost half of the amplitude) of the second
largest around it: coders with few bits blend a repeat with its neighbours. A pattern is a period of 2 to 12 steps in
which four fifths of the steps at some places are such repeats, and at most half at the other places, in one shot.

A single step is a repeat if its change is at most 1/12 of that of each of the four steps before and after, unless the
step before it is large: a coder with few bits repeats its keyframes, which look unlike the frames before them.

Elsewhere a step is a repeat if its change is at most 1/6 of the median before it and of that after it, and either at
most 1/25 of the largest on either side, or the next step makes up for it. Where motion comes to rest or begins, only
one side is that large.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Spans = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch."""

_RATIO = 25
_MEDIAN_RATIO = 6
_PATTERN_RATIO = 5
_REACH = 4
_CUT_REACH = 8
_SURE_RATIO = 12
_NOISE = 64
"""Change of a block that may be coder noise: a grey level, in 1/64."""
_LEAST_CHANGE = (5 * 64) ** 2 // 150
"""Of a block in the mean, (1/64 grey level)^2: one block in 150 changes by five levels. Smaller steps, of few blocks
above the noise, come and go by rounding."""
_LEAST_PER_MILLE = 30
_LEAST_COUNT = 4
_LONGEST_PERIOD = 12
_NAMES = {(2, 1): "every picture twice", (5, 1): "24 in 30", (5, 3): "24 in 60, 3:2 pulldown", (6, 1): "25 in 30"}


def change_of(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64]) -> int:
    """Return the change from one picture to the next, (1/64 grey level)^2.

    Args:
        before, after: means of their blocks, 1/64 grey level.
    """
    difference = after - before
    return int(np.square(difference, where=np.abs(difference) > _NOISE, out=np.zeros_like(difference)).sum())


def duplicated(changes: Sequence[int], blocks: int, boundaries: Sequence[int] = ()) -> npt.NDArray[np.bool_]:
    """Return which steps repeat a frame.

    Args:
        changes: [N] sums of squares, (1/64 grey level)^2.
        blocks: number of blocks in each sum.
        boundaries: frames at which another shot begins.

    Returns:
        [N]; repeats outside of patterns are False where there are too few to be more than chance, unless sure.
    """
    each, least = np.array(changes, np.int64), _LEAST_CHANGE * blocks
    flags, others = np.zeros(len(each), bool), np.zeros(len(each), bool)
    for first, end in pairwise([0, *boundaries, len(each) + 1]):
        shot = slice(first, end - 1)  # the steps between its frames
        pattern = _in_pattern(each[shot], least)
        flags[shot] = pattern
        if not pattern.any():
            others[shot] = [_is_repeat(changes[shot], at, least) for at in range(end - 1 - first)]
        sure = [_is_surely_repeat(changes[shot], at, least) for at in range(end - 1 - first)]
        flags[shot] |= np.array(sure, bool)
    count = int(others.sum())
    return flags | others if count >= _LEAST_COUNT and 1000 * count >= _LEAST_PER_MILLE * len(each) else flags


def _in_pattern(changes: npt.NDArray[np.int64], least: int) -> npt.NDArray[np.bool_]:
    """Return which steps of a shot repeat a frame in a regular pattern."""
    count, none = len(changes), np.zeros(len(changes), bool)
    if not count:
        return none
    around = np.lib.stride_tricks.sliding_window_view(np.pad(changes, _REACH), 2 * _REACH + 1)
    largest = np.partition(around, -2, axis=1)[:, -2]
    moves = largest >= least
    small = moves & (_PATTERN_RATIO * changes <= largest)
    for period in range(2, min(_LONGEST_PERIOD, int(moves.sum()) // 4) + 1):
        shares = [(int(small[place::period].sum()), int(moves[place::period].sum())) for place in range(period)]
        repeats = [5 * found >= 4 * steps > 0 for found, steps in shares]
        others = [2 * found <= steps for found, steps in shares]
        enough = sum(found for (found, _), repeat in zip(shares, repeats, strict=True) if repeat) >= _LEAST_COUNT
        if enough and any(others) and all(one or other for one, other in zip(repeats, others, strict=True)):
            pattern: npt.NDArray[np.bool_] = moves & np.resize(repeats, count)
            return pattern
    return none


def _is_repeat(changes: Sequence[int], at: int, least: int) -> bool:
    """Return whether a step of a shot repeats a frame outside of any pattern."""
    before, after = changes[max(0, at - _REACH) : at], changes[at + 1 : at + 1 + _REACH]
    sides = sorted(before), sorted(after)
    if not all(sides):
        return False
    largest, median = min(side[-1] for side in sides), min(side[len(side) // 2] for side in sides)
    if largest < least or _MEDIAN_RATIO * changes[at] > median:
        return False
    around = sorted([*before, *after])
    return _RATIO * changes[at] <= largest or 2 * after[0] >= 3 * around[len(around) // 2]


def _is_surely_repeat(changes: Sequence[int], at: int, least: int) -> bool:
    """Return whether a step of a shot repeats a frame, by itself."""
    around = sorted([*changes[max(0, at - _REACH) : at], *changes[at + 1 : at + 1 + _REACH]])
    if len(around) < 2 * _REACH or around[0] < max(2 * least, _SURE_RATIO * changes[at]):
        return False
    return changes[at - 1] <= 3 * around[_REACH]


def is_cut(changes: Sequence[int], step: int) -> bool:
    """Return whether a step changes at least twice as much (in amplitude) as four fifths of the steps around it.

    A shot boundary is found by the median of the steps around it, which repeats make small.
    """
    around = sorted([*changes[max(0, step - _CUT_REACH) : step], *changes[step + 1 : step + 1 + _CUT_REACH]])
    return len(around) < _CUT_REACH or changes[step] >= 4 * around[-1 - len(around) // 5]


def pattern_of(flags: npt.NDArray[np.bool_]) -> str:
    """Return the name of the pattern in which frames repeat.

    Args:
        flags: [N] of :func:`duplicated`, at least one of them True.
    """
    if not (period := _period(flags)):
        return "no regular pattern"
    each = (period * int(flags.sum()) + len(flags) // 2) // len(flags)
    return _NAMES.get((period, each), f"{each} of every {period}")


def _period(flags: npt.NDArray[np.bool_]) -> int:
    """Return the number of steps after which four fifths of the repeats come again; 0 without any."""
    for period in range(2, min(_LONGEST_PERIOD, len(flags) // 3) + 1):
        repeated, expected = int((flags[period:] & flags[:-period]).sum()), int(flags[period:].sum())
        if 5 * repeated >= 4 * expected > 0:
            return period
    return 0


def runs_of(flags: npt.NDArray[np.bool_], least: int, most_gap: int = 0) -> Spans:
    """Return (first, after the last) of each stretch of at least ``least`` frames whose flags are True.

    Args:
        flags: [N].
        least: frames.
        most_gap: other frames that a stretch may hold in a row.
    """
    runs: list[tuple[int, int]] = []
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8))).reshape(-1, 2)
    for first, end in edges.tolist():
        start = runs.pop()[0] if runs and first - runs[-1][1] <= most_gap else first
        runs.append((start, end))
    return tuple((first, end) for first, end in runs if end - first >= least)
