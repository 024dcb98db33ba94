"""Block motion between two pictures, in integer arithmetic: the same vectors on every host.

A vector belongs to a cell of CELL_PX x CELL_PX px and to the moment halfway between the pictures: what the cell shows
then is half the vector back in the first picture and half the vector ahead in the second one. So one search gives the
motion at every pixel between the pictures, those that a moving thing uncovers included.

Vectors are searched from coarse to fine on a pyramid of rounded means of four. At each level, the block of
BLOCK_PX x BLOCK_PX px around a cell tries zero and the vectors that the coarser level found for its cell and the four
neighbours; then the places around the best. It minimises

    sum of absolute differences + COST_PER_PX (|dx - px| + |dy - py|)        (px, py): the coarser level's vector

with half of the vector, rounded, on each side. The field is smoothed by the median of nine. At the finest level, the
minimum of the V through three sums gives 1/UNITS_PER_PX px (equiangular fit). Before the search, the second picture is
scaled to the mean of the first, so that a lamp that flickers does not look like motion.

A block that changes by no more than a coder's noise rests; most blocks of most videos do, and cost one sum. Other
vectors are zero where a shift of less than half a pixel would explain the block as well: along an edge, whole pixels
often imitate such a shift.

The motion of a cell depends on the whole pictures, and not on the cells that are asked for: those that a crop shows
have the same motion as in the whole video, whose motion a store holds.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.motion.lanes import BLOCK_PX, CELL_PX, block_difference
from v2v_server.motion.pyramid import PAD_PX, Cells, GreyPicture, Pyramid, compiled
from v2v_server.video.picture import PixelRect

Vectors = npt.NDArray[np.int16]
"""[2, ceil(h / CELL_PX), ceil(w / CELL_PX)] int16: x (right) and y (down), in 1/UNITS_PER_PX px."""

UNITS_PER_PX = 16
COST_PER_PX = 4
_TOP_RADIUS_PX = 3
_AROUND_PX = (BLOCK_PX - CELL_PX) // 2
_LARGEST_SHIFT = 1 << 14
_REST = BLOCK_PX * BLOCK_PX
"""Difference of a block that a coder's noise makes: a grey level per pixel."""


def motion(first: Pyramid, second: Pyramid, cells: Cells | None = None) -> Vectors:
    """Return the motion between two pictures of one size.

    Args:
        first, second: the pictures.
        cells: those whose motion is wanted; None: all. The others cost only what these need of them, and change
            nothing.

    Returns:
        [2, rows, columns] of these cells.
    """
    cells = first.cells if cells is None else cells
    moves = _moving_cells(first, second, cells)
    if moves is None:
        return np.zeros((2, cells.rows, cells.columns), np.int16)
    one, other = first.levels, _scaled(first.levels, second.levels)
    needed = [cells]
    for level in one[1:]:
        needed.append(_parents(needed[-1], level))
    found = np.zeros((2, 1, 1), np.int16)
    for number in reversed(range(len(one))):
        radius = _TOP_RADIUS_PX if number == len(one) - 1 else 1
        rest = _REST >> number
        found = _median(_search(one[number], other[number], found, radius, rest, *needed[number]), *needed[number])
    top, left, rows, columns = cells
    found = np.ascontiguousarray(found[:, top : top + rows, left : left + columns])
    _refine(one[0], other[0], found, moves, top, left)
    return found


def _moving_cells(first: Pyramid, second: Pyramid, cells: Cells) -> npt.NDArray[np.bool_] | None:
    """Return [rows, columns], the cells whose blocks differ by more than a coder's noise; None if none does."""
    if min(first.height, first.width) < BLOCK_PX:
        return np.ones(cells[2:], np.bool_)
    window, place = _blocks_of(cells, first.height, first.width)
    moves = np.empty(cells[2:], np.bool_)
    return moves if _mark_moving(first.part(window), second.part(window), *place, moves) else None


@lru_cache(maxsize=16)
def _blocks_of(cells: Cells, height: int, width: int) -> tuple[PixelRect, tuple[int, ...]]:
    """Return the part of a picture with the blocks of some cells, and the numbers that ``_mark_moving`` wants."""
    (top, bottom), (left, right) = (
        tuple(min(max(CELL_PX * cell - _AROUND_PX, 0), side - BLOCK_PX) for cell in (at, at + count - 1))
        for at, count, side in zip(cells[:2], cells[2:], (height, width), strict=True)
    )
    window = top, left, bottom + BLOCK_PX - top, right + BLOCK_PX - left
    return window, (*cells[:2], top, left, height - BLOCK_PX, width - BLOCK_PX)


def _parents(cells: Cells, level: GreyPicture) -> Cells:
    """Return the cells of the next coarser level, given with its padding, that a search for some cells looks at."""
    sides = []
    for first, count, side in zip(cells[:2], cells[2:], level.shape, strict=True):
        last = -(-(side - 2 * PAD_PX) // CELL_PX) - 1
        low = max(min((first - 1) // 2, last) - 1, 0)
        sides.append((low, min((first + count) // 2 + 1, last) + 1 - low))
    (top, rows), (left, columns) = sides
    return Cells(top, left, rows, columns)


def _scaled(first: list[GreyPicture], second: list[GreyPicture]) -> list[GreyPicture]:
    """Return the second pyramid with the brightness of the first."""
    within = slice(PAD_PX, -PAD_PX)
    mine, other = (int(levels[-1][within, within].sum(dtype=np.int64)) for levels in (first, second))
    if other == 0 or abs(mine - other) * 64 < other:
        return second
    grey = np.minimum((2 * np.arange(256) * mine + other) // (2 * other), 255).astype(np.uint8)
    return [grey[level] for level in second]


@compiled
def _mark_moving(first, second, top, left, first_y, first_x, last_y, last_x, moves):
    """Mark moving cells in parts of pictures.

    Args:
        first, second: the parts that hold all blocks.
        top, left: the first cell.
        first_y, first_x: place of the parts.
        last_y, last_x: of the last block of the pictures.
        moves: written.
    """
    pitch = first.shape[1]
    a, b = first.ravel(), second.ravel()
    any_moves = False
    for row in range(moves.shape[0]):
        y = min(max(CELL_PX * (top + row) - _AROUND_PX, 0), last_y) - first_y
        for column in range(moves.shape[1]):
            x = min(max(CELL_PX * (left + column) - _AROUND_PX, 0), last_x) - first_x
            at = y * pitch + x
            differs = block_difference(a, at, b, at, pitch) > _REST
            moves[row, column] = differs
            any_moves |= differs
    return any_moves


@numba.njit(nogil=True, inline="always")
def _fits(place, ahead, most):
    back = ahead >> 1
    return 0 <= place - back <= most and 0 <= place + (ahead - back) <= most


@compiled
def _search(first, second, coarser, radius, rest, top_row, left_column, wanted_rows, wanted_columns):
    """Return the best vectors of some cells and their neighbours; the others are not set."""
    pitch = first.shape[1]
    lowest, rightmost = first.shape[0] - BLOCK_PX, first.shape[1] - BLOCK_PX
    a, b = first.ravel(), second.ravel()
    rows = (first.shape[0] - 2 * PAD_PX + CELL_PX - 1) // CELL_PX
    columns = (first.shape[1] - 2 * PAD_PX + CELL_PX - 1) // CELL_PX
    found = np.empty((2, rows, columns), np.int16)
    last_row, last_column = coarser.shape[1] - 1, coarser.shape[2] - 1
    tried = np.empty((2, 5), np.int64)
    for row in range(max(top_row - 1, 0), min(top_row + wanted_rows + 1, rows)):
        for column in range(max(left_column - 1, 0), min(left_column + wanted_columns + 1, columns)):
            top, left = PAD_PX + CELL_PX * row - _AROUND_PX, PAD_PX + CELL_PX * column - _AROUND_PX
            at = top * pitch + left
            still = block_difference(a, at, b, at, pitch)
            if still <= rest:
                found[0, row, column], found[1, row, column] = 0, 0
                continue
            parent_row, parent_column = min(row // 2, last_row), min(column // 2, last_column)
            expected_x = 2 * np.int64(coarser[0, parent_row, parent_column])
            expected_y = 2 * np.int64(coarser[1, parent_row, parent_column])
            x, y = np.int64(0), np.int64(0)
            best = still + COST_PER_PX * (abs(expected_x) + abs(expected_y))
            for candidate in range(5 + (2 * radius + 1) ** 2):
                if candidate < 5:
                    r = min(max(parent_row + (candidate == 1) - (candidate == 2), 0), last_row)
                    c = min(max(parent_column + (candidate == 3) - (candidate == 4), 0), last_column)
                    dx, dy = 2 * np.int64(coarser[0, r, c]), 2 * np.int64(coarser[1, r, c])
                    tried[0, candidate], tried[1, candidate] = dx, dy
                    is_known = dx == 0 and dy == 0
                    for earlier in range(candidate):
                        is_known |= tried[0, earlier] == dx and tried[1, earlier] == dy
                    if is_known:
                        continue
                else:
                    if candidate == 5:
                        middle_x, middle_y = x, y
                    dx = middle_x + (candidate - 5) % (2 * radius + 1) - radius
                    dy = middle_y + (candidate - 5) // (2 * radius + 1) - radius
                    if dx == middle_x and dy == middle_y:
                        continue
                if _fits(top, dy, lowest) and _fits(left, dx, rightmost):
                    back = (dy >> 1) * pitch + (dx >> 1)
                    cost = block_difference(a, at - back, b, at + dy * pitch + dx - back, pitch)
                    cost += COST_PER_PX * (abs(dx - expected_x) + abs(dy - expected_y))
                    if cost < best:
                        best, x, y = cost, dx, dy
            found[0, row, column], found[1, row, column] = x, y
    return found


@numba.njit(nogil=True, inline="always")
def _ordered(a, b, c):
    low, high = min(a, b), max(a, b)
    middle = max(low, min(high, c))
    return min(low, c), middle, max(high, c)


@compiled
def _median(found, top, left, wanted_rows, wanted_columns):
    """Return the median of each value and its eight neighbours in some cells; the edge is repeated."""
    rows, columns = found.shape[1], found.shape[2]
    smooth = np.empty_like(found)
    lines = np.empty((3, wanted_columns + 2), np.int16)
    for axis in range(2):
        for row in range(top, top + wanted_rows):
            for near in range(3):
                values = found[axis, min(max(row + near - 1, 0), rows - 1)]
                lines[near, 1 : wanted_columns + 1] = values[left : left + wanted_columns]
                lines[near, 0] = values[max(left - 1, 0)]
                lines[near, wanted_columns + 1] = values[min(left + wanted_columns, columns - 1)]
            above, here, below, into = lines[0], lines[1], lines[2], smooth[axis, row, left:]
            for c in range(wanted_columns):
                low0, mid0, high0 = _ordered(above[c], here[c], below[c])
                low1, mid1, high1 = _ordered(above[c + 1], here[c + 1], below[c + 1])
                low2, mid2, high2 = _ordered(above[c + 2], here[c + 2], below[c + 2])
                _, middle, _ = _ordered(mid0, mid1, mid2)
                _, into[c], _ = _ordered(max(low0, low1, low2), middle, min(high0, high1, high2))
    return smooth


@compiled
def _refine(first, second, found, moves, top_row, left_column):
    """Make vectors of whole pixels finer, and those without evidence zero.

    Args:
        found: [2, rows, columns] of the cells from (top_row, left_column) on; changed.
        moves: [rows, columns], whether their blocks differ at rest.
    """
    pitch = first.shape[1]
    lowest, rightmost = first.shape[0] - BLOCK_PX, first.shape[1] - BLOCK_PX
    a, b = first.ravel(), second.ravel()
    for row in range(found.shape[1]):
        for column in range(found.shape[2]):
            top = PAD_PX + CELL_PX * (top_row + row) - _AROUND_PX
            left = PAD_PX + CELL_PX * (left_column + column) - _AROUND_PX
            dx, dy = np.int64(found[0, row, column]), np.int64(found[1, row, column])
            found[0, row, column], found[1, row, column] = 0, 0
            if not moves[row, column] or (dx == 0 and dy == 0) or abs(dx) + abs(dy) >= _LARGEST_SHIFT // UNITS_PER_PX:
                continue
            at = top * pitch + left
            _, _, rest = _fit(a, at, b, at, pitch)
            back = (dy >> 1) * pitch + (dx >> 1)
            inside = (
                _fits(top, dy - 1, lowest) and _fits(top, dy + 1, lowest)
                and _fits(left, dx - 1, rightmost) and _fits(left, dx + 1, rightmost)
            )  # fmt: skip
            if not inside:
                continue
            difference = block_difference(a, at - back, b, at + dy * pitch + dx - back, pitch)
            if 4 * difference >= rest:
                continue
            x, y, _ = _fit(a, at - back, b, at + dy * pitch + dx - back, pitch)
            x, y = UNITS_PER_PX * dx + x, UNITS_PER_PX * dy + y
            found[0, row, column], found[1, row, column] = x, y


@numba.njit(nogil=True, inline="always")
def _fit(a, at, b, to, pitch):
    """Return the minimum about a place, x and y in 1/UNITS_PER_PX px, and four times the sum that is expected there."""
    here = block_difference(a, at, b, to, pitch)
    x, gain_x = _lowest(block_difference(a, at, b, to - 1, pitch), here, block_difference(a, at, b, to + 1, pitch))
    y, gain_y = _lowest(
        block_difference(a, at, b, to - pitch, pitch), here, block_difference(a, at, b, to + pitch, pitch)
    )
    return x, y, max(4 * here - gain_x - gain_y, 0)


@numba.njit(nogil=True, inline="always")
def _lowest(before, here, after):
    """Return the place of the minimum of a V through three sums, at most half a step away, and four times its gain."""
    apart = abs(before - after)
    steepest = 2 * (max(before, after) - here)
    if steepest <= 0:
        return np.int64(0), np.int64(0)
    offset = np.int64(UNITS_PER_PX * (before - after) // steepest)
    half = np.int64(UNITS_PER_PX // 2)
    return min(max(offset, -half), half), 2 * apart if here <= min(before, after) else apart
