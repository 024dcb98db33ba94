"""Duplicated frames and their pattern.

The change of a step is the sum of the squared changes of the means of 8 x 8 blocks, of those that change by more than a
grey level. Means of blocks hold little coder noise, and squares give most weight to moving edges. A step is a duplicate
if its change is at most 1/25 (so 1/5 of the amplitude) of the largest one of the four steps before it, and of the four
after it. Where motion comes to rest or begins, only one side is that large; beside a cut, too. Near the first and the
last frame one side is enough.

Coders with few bits blend a repeat with its neighbours. So 1/5 (almost half of the amplitude) suffices where repeats
come in a regular pattern.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Spans = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch."""

_RATIO = 25
_BLENDED_RATIO = 5
_REACH = 4
_CUT_REACH = 8
_NOISE = 64
"""Change of a block that may be coder noise: a grey level, in 1/64."""
_LEAST_CHANGE = (2 * 64) ** 2 // 100
"""Of a block in the mean, (1/64 grey level)^2: one block in a hundred changes by two levels."""
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


def duplicated(changes: Sequence[int], blocks: int) -> npt.NDArray[np.bool_]:
    """Return which steps repeat a frame.

    Args:
        changes: [N] sums of squares, (1/64 grey level)^2.
        blocks: number of blocks in each sum.

    Returns:
        [N]; all False where there are too few to be more than chance.
    """
    moving = np.zeros(len(changes), np.int64)
    for at in range(len(changes)):
        before, after = changes[max(0, at - _REACH) : at], changes[at + 1 : at + 1 + _REACH]
        sides = max(before, default=0), max(after, default=0)
        moving[at] = min(sides) if len(before) == len(after) else max(sides)
    is_moving, each = moving >= _LEAST_CHANGE * blocks, np.array(changes, np.int64)
    blended = is_moving & (_BLENDED_RATIO * each <= moving)
    if blended.sum() >= 2 * _LEAST_COUNT and _period(blended):
        return blended
    flags = is_moving & (_RATIO * each <= moving)
    count = int(flags.sum())
    return flags if count >= _LEAST_COUNT and 1000 * count >= _LEAST_PER_MILLE * len(flags) else np.zeros_like(flags)


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
