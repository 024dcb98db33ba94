"""From figures of every frame to the pieces of a video. Pure, in integer arithmetic.

Still: for 16 frames or more, at most one block in a hundred changes by more than two grey levels over four frames.

Black, white: for four frames or more, 99 % of the blocks lie within 1.5 grey levels of their mean, so there is nothing
to see. A night scene is not black.

Fade: the light falls from frame to frame for at least 6 frames, to an eighth of what it was, and the contrast with it;
no single step is half of it. In reverse, the same from black.

Combing: in a block that changes, neighbouring lines differ twice as much as lines of the same field do. A shot is
combed if an eighth of its frames that were looked at have such blocks.

Bars (letterbox, pillarbox): dark rows and columns at the sides of the picture that show nothing.

Repeats: the change of a step is the sum of the squared changes of the means of 8 x 8 blocks, of those that change by
more than a grey level. Means of blocks hold little coder noise, and squares give most weight to moving edges. It is
compared with the steps around it, up to four on either side.

A halt is one small step, or up to seven, between two that are at least five times as large, of blocks and of pixels.
What swings or flickers halts too, where it turns. After a repeat it goes on, after a turn it comes back: with both
large steps the picture must change by at least 3/4 of the larger one, and by more than 9 times the small steps (three
even steps about a turn lead three times as far as the one in the middle, in amplitude).

    pattern   A step is small if its change is at most 1/5 (almost half of the amplitude) of the second largest around
              it: coders with few bits blend a repeat with its neighbours. A pattern is a period of 2 to 12 steps in
              which four fifths of the steps at some places are small, half of these halts, and at most half at the
              other places are small, in one shot.
    single    A halt is a repeat if its change is at most 1/12 of that of each of the four steps before and after,
              unless the step before it is large: a coder with few bits repeats its keyframes, which look unlike the
              frames before them.
    several   Where they are 3 % of the steps, and four, halts are repeats if their change is at most 1/6 of the median
              before and of that after.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.scenes.scene import LAG_FRAMES, NO_BARS, PIECE, SEGMENT_FRAMES, Flag, Pieces, Sides

Spans = tuple[tuple[int, int], ...]
"""(first frame, frame after the last) of each stretch."""

_MEDIAN_RATIO = 6
_HALT_RATIO = 5
_TURN_RATIO = 9
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
_DARKEST_PICTURE = 32
"""Grey level up to which a side may be a bar."""
_NOISE_LEVELS = 6
_FIRST_LINES = 16
"""Most pictures have no bars, which these lines tell."""
_EDGE_PX = 8
"""Coded with few bits, this part of a bar beside the picture is not flat."""
_LEAST_PX = 4
_LEAST_FLAT_PX = 2
_MOST_SPREAD_PX = 2
_LEAST_SHARE = 50
"""Thinner ones than 1/50 of the picture's side do not count."""
_STILL_CHANGE = 2 * 64
"""Change of a block, 1/64 grey level."""
_STILL_SHARE = 100
"""One of that number of blocks may change by more."""
_STILL_GAP = 2 * LAG_FRAMES
"""Frames. A step at a keyframe of low quality, which shows nothing new, spoils the lag's frames and a few after it."""
_STILL_FRAMES = 16
_FLAT_SPREAD = 96
"""1/64 grey level."""
_FLAT_SHARE = 100
_FLAT_FRAMES = 4
_BRIGHT_FROM = 128 * 64
_FADE_FRAMES = 6
_FADE_SMOOTH = 2
"""Frames on either side over which light is averaged."""
_FADE_LEAST_CONTRAST = (4 * 64) ** 2
_FADE_LEAST_STEP = 500
"""Smaller changes than 1/500 of the light are none."""
_FADE_RATIO = 8
_COMBED_SHARE = 8
_COMBED_COUNT = 2
_COMBED_GAP = 24
"""Frames between two that are combed: of 24 in 60 fields a second, not every picture is."""


def change_of(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64]) -> int:
    """Return the change from one picture to the next, (1/64 grey level)^2.

    Args:
        before, after: [rows, columns] means of their blocks, 1/64 grey level.
    """
    difference = after - before
    return int(np.square(difference, where=np.abs(difference) > _NOISE, out=np.zeros_like(difference)).sum())


def halt_before(blocks: Sequence[npt.NDArray[np.int64]], changes: Sequence[int], pixels: Sequence[int]) -> int:
    """Return the number of steps before the last one in which the picture halts; 0 if it moves, or comes back.

    Args:
        blocks: [n][rows, columns], means of the blocks of the last pictures, 1/64 grey level.
        changes: at least n - 1, those of the steps up to the last picture, (1/64 grey level)^2.
        pixels: at least n - 1, sums of the squared changes of all pixels in these steps, grey level^2.
    """
    for count in range(1, len(blocks) - 2):
        if _are_small(changes, count, _LEAST_CHANGE * blocks[-1].size):
            before, first, last, after = (blocks[at] for at in (-3 - count, -2 - count, -2, -1))
            way, step = change_of(before, after), max(change_of(before, last), change_of(first, after))
            goes_on = 4 * way > 3 * step and way > _TURN_RATIO * change_of(first, last)
            return count if goes_on and _are_small(pixels, count, 0) else 0
    return 0


def _are_small(changes: Sequence[int], count: int, least: int) -> bool:
    """Return whether the steps before the last one change little beside the two around them."""
    return min(changes[-2 - count], changes[-1]) >= max(least, _HALT_RATIO * max(changes[-1 - count : -1]))


def duplicated(
    changes: Sequence[int], halts: npt.NDArray[np.bool_], blocks: int, boundaries: Sequence[int] = ()
) -> npt.NDArray[np.bool_]:
    """Return which steps repeat a frame.

    Args:
        changes: [N] sums of squares, (1/64 grey level)^2.
        halts: [N], whether :func:`halt_before` counts the step.
        blocks: number of blocks in each sum.
        boundaries: frames at which another shot begins.

    Returns:
        [N]; repeats outside of patterns are False where there are too few to be more than chance, unless sure.
    """
    each, least = np.array(changes, np.int64), _LEAST_CHANGE * blocks
    flags, others = np.zeros(len(each), bool), np.zeros(len(each), bool)
    for first, end in pairwise([0, *boundaries, len(each) + 1]):
        shot = slice(first, end - 1)  # the steps between its frames
        steps, pattern = changes[shot], _in_pattern(each[shot], halts[shot], least)
        flags[shot] = pattern
        for at in np.flatnonzero(halts[shot]).tolist():
            flags[first + at] |= _is_surely_repeat(steps, at, least)
            others[first + at] = not pattern.any() and _is_repeat(steps, at, least)
    return flags | others if others.sum() >= max(_LEAST_COUNT, _LEAST_PER_MILLE * len(each) / 1000) else flags


def _in_pattern(changes: npt.NDArray[np.int64], halts: npt.NDArray[np.bool_], least: int) -> npt.NDArray[np.bool_]:
    """Return which steps of a shot repeat a frame in a regular pattern."""
    count, none = len(changes), np.zeros(len(changes), bool)
    if not count:
        return none
    around = np.lib.stride_tricks.sliding_window_view(np.pad(changes, _REACH), 2 * _REACH + 1)
    largest = np.partition(around, -2, axis=1)[:, -2]
    moves = largest >= least
    small = moves & (_HALT_RATIO * changes <= largest)
    for period in range(2, min(_LONGEST_PERIOD, int(moves.sum()) // 4) + 1):
        places = [[each[at::period].sum() for each in (small, small & halts, moves)] for at in range(period)]
        found, halted, steps = np.array(places).T
        repeats, others = (5 * found >= 4 * steps) & (steps > 0) & (2 * halted >= found), 2 * found <= steps
        if found[repeats].sum() >= _LEAST_COUNT and others.any() and (repeats | others).all():
            pattern: npt.NDArray[np.bool_] = moves & np.resize(repeats, count)
            return pattern
    return none


def _is_repeat(changes: Sequence[int], at: int, least: int) -> bool:
    """Return whether a halt of a shot repeats a frame if others do, outside of any pattern."""
    sides = sorted(changes[max(0, at - _REACH) : at]), sorted(changes[at + 1 : at + 1 + _REACH])
    return all(side and side[len(side) // 2] >= max(least, _MEDIAN_RATIO * changes[at]) for side in sides)


def _is_surely_repeat(changes: Sequence[int], at: int, least: int) -> bool:
    """Return whether a halt of a shot repeats a frame, by itself."""
    around = sorted([*changes[max(0, at - _REACH) : at], *changes[at + 1 : at + 1 + _REACH]])
    stands_out = len(around) == 2 * _REACH and around[0] >= max(2 * least, _SURE_RATIO * changes[at])
    return stands_out and changes[at - 1] <= 3 * around[_REACH]


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


def bars_of(picture: npt.NDArray[np.uint8]) -> Sides:
    """Return the bars of a picture at the top, bottom, left and right, in pixels.

    A row or column belongs to a bar if at most 1/50 of its pixels differ by more than 6 grey levels from the median of
    the outermost one, and so do all rows or columns outside of it. The bar then ends at the largest step nearby.

    Args:
        picture: [H, W] uint8.
    """
    return Sides(_depth(picture), _depth(picture[::-1]), _depth(picture.T), _depth(picture.T[::-1]))


def _depth(lines: npt.NDArray[np.uint8]) -> int:
    level = int(np.sort(lines[0])[lines.shape[1] // 2])
    if level > _DARKEST_PICTURE:
        return 0
    flat = _flat(lines[:_FIRST_LINES], level)
    if flat == _FIRST_LINES:
        flat = _flat(lines, level)
    around = lines[max(0, flat - 1) : flat + _EDGE_PX].astype(np.int16)
    if len(around) < 2 or flat < _LEAST_FLAT_PX:
        return flat
    steps = np.abs(np.diff(around, axis=0)).sum(axis=1, dtype=np.int64)
    return flat + int(steps.argmax())


def _flat(lines: npt.NDArray[np.uint8], level: int) -> int:
    # Levels 0 .. 38 suffice, and stay in uint8.
    different = (lines > level + _NOISE_LEVELS) | (lines < max(0, level - _NOISE_LEVELS))
    is_picture = different.sum(axis=1) > lines.shape[1] // 50
    return int(is_picture.argmax()) if is_picture.any() else len(lines)


def common_bars(found: Sequence[Sides], height: int, width: int) -> Sides:
    """Return the bars that half of the pictures have, and three quarters at least half as deep.

    Where they differ from picture to picture it is dark content, not a bar. Coded with few bits, a bar is less deep in
    some pictures.

    Args:
        found: of each picture.
        height, width: of the pictures.
    """
    if not found:
        return NO_BARS
    depths = []
    for side in map(sorted, zip(*found, strict=True)):
        middle = side[len(found) // 2]
        alike = sum(abs(depth - middle) <= _MOST_SPREAD_PX for depth in side)
        depths.append(middle if 2 * alike >= len(found) and 2 * side[len(found) // 4] >= middle else 0)
    if depths[0] + depths[1] >= height or depths[2] + depths[3] >= width:
        return NO_BARS  # flat pictures
    sizes = height, height, width, width
    least = [max(_LEAST_PX, size // _LEAST_SHARE) for size in sizes]
    return Sides(*(depth if depth >= limit else 0 for depth, limit in zip(depths, least, strict=True)))


def is_still(before: npt.NDArray[np.int64], after: npt.NDArray[np.int64]) -> bool:
    """Return whether two pictures show the same, from the means of their blocks, [rows, columns], 1/64 grey level."""
    moved = int(np.count_nonzero(np.abs(after - before) > _STILL_CHANGE))
    return moved * _STILL_SHARE <= after.size


def is_flat(blocks: npt.NDArray[np.int64]) -> bool:
    """Return whether a picture shows nothing, from the means of its blocks, [rows, columns], 1/64 grey level."""
    mean = int(blocks.sum()) // blocks.size
    return int(np.count_nonzero(np.abs(blocks - mean) > _FLAT_SPREAD)) * _FLAT_SHARE <= blocks.size


def fades_of(light: npt.NDArray[np.int64], contrast: npt.NDArray[np.int64]) -> Spans:
    """Return the fades to and from black.

    Args:
        light: [N] mean of each frame, 1/64 grey level.
        contrast: [N] variance of its blocks, (1/64 grey level)^2.
    """
    count = len(light)
    if count < _FADE_FRAMES:
        return ()
    backward = [(count - end, count - first) for first, end in _falls(light[::-1], contrast[::-1])]
    return tuple(sorted([*_falls(light, contrast), *backward]))


def _falls(light: npt.NDArray[np.int64], contrast: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
    padded = np.pad(light, _FADE_SMOOTH, mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, 2 * _FADE_SMOOTH + 1).sum(axis=1)
    drops = smooth[:-1] - smooth[1:]
    found = []
    for first, end in runs_of(drops * _FADE_LEAST_STEP > smooth[:-1], _FADE_FRAMES):
        falls = light[first:end] - light[first + 1 : end + 1]
        is_dark = light[end] * _FADE_RATIO <= light[first] and contrast[end] * _FADE_RATIO**2 <= contrast[first]
        if is_dark and contrast[first] >= _FADE_LEAST_CONTRAST and 2 * falls.max() <= light[first] - light[end]:
            found.append((first, end + 1))
    return found


def combed_runs(looks: Sequence[tuple[int, bool]], first: int, end: int) -> Spans:
    """Return the stretches of a shot whose pictures are combed.

    Args:
        looks: (frame, whether it is combed) of the frames that were looked at, of the whole video.
        first, end: the frames of the shot.
    """
    inside = [(frame, combed) for frame, combed in looks if first <= frame < end]
    combed = [frame for frame, combed in inside if combed]
    if len(combed) < _COMBED_COUNT or len(combed) * _COMBED_SHARE < len(inside):
        return ()
    reach = inside[1][0] - inside[0][0]
    flags = np.zeros(end - first, bool)
    for frame in combed:
        flags[max(0, frame - reach - first) : frame + reach - first] = True
    return tuple((first + low, first + high) for low, high in runs_of(flags, 1, _COMBED_GAP))


def pieces_of(
    light: npt.NDArray[np.int64],
    contrast: npt.NDArray[np.int64],
    still: npt.NDArray[np.bool_],
    flat: npt.NDArray[np.bool_],
    quiet: npt.NDArray[np.bool_],
    repeats: npt.NDArray[np.bool_],
    boundaries: Sequence[int],
    combed: Sequence[tuple[int, bool]],
    bars: Sequence[tuple[int, Sides]],
    size: tuple[int, int],
) -> Pieces:
    """Return the pieces of a video's frames.

    Args:
        light, contrast: see :func:`fades_of`.
        still, flat, quiet: [N] of each frame.
        repeats: [N - 1] of each step.
        boundaries: frames at which another shot begins.
        combed: see :func:`combed_runs`.
        bars: (frame, bars) of the frames that were measured.
        size: height and width of the pictures.
    """
    count = len(light)
    flags = np.zeros(count, np.uint16)
    flags[1:][repeats] |= Flag.REPEAT
    bright = light >= _BRIGHT_FROM
    shots = tuple(pairwise([0, *boundaries, count]))
    spans = {
        Flag.FADE: fades_of(light, contrast),
        Flag.STILL: runs_of(still & ~flat, _STILL_FRAMES, _STILL_GAP),
        Flag.QUIET: runs_of(quiet, SEGMENT_FRAMES),
        Flag.BLACK: runs_of(flat & ~bright, _FLAT_FRAMES),
        Flag.WHITE: runs_of(flat & bright, _FLAT_FRAMES),
        Flag.COMBED: [run for first, end in shots for run in combed_runs(combed, first, end)],
    }
    for flag, runs in spans.items():
        for first, end in runs:
            flags[first:end] |= flag
    flags[list(boundaries)] |= Flag.CUT
    changes = np.flatnonzero(np.diff(flags & ~np.uint16(Flag.CUT))) + 1
    ends = sorted({*changes.tolist(), *boundaries, count})
    pieces = np.empty(len(ends), PIECE)
    pieces["end"] = ends
    firsts = np.array([0, *ends[:-1]])
    pieces["flags"] = flags[firsts]
    for first, end in shots:
        shot = [sides for frame, sides in bars if first <= frame < end]
        sides = common_bars(shot, *size) if shot else NO_BARS
        inside = (firsts >= first) & (firsts < end)
        for name, depth in zip(Sides._fields, sides, strict=True):
            pieces[name][inside] = depth
    return pieces
