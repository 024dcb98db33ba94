"""Pictures between two pictures, made of both along the motion.

A cell at the share s of the time between them, 0 < s < 1, with the motion v of its middle, shows

    (1 - s) A(x - s v) + s B(x + (1 - s) v)

read between pixels by a separable cubic (a = -0.75) and rounded to 1/16 of a grey level. Where only one of the two
places lies in the picture, that one alone is shown. Without motion it is the mean of both at the pixel. The arithmetic
is integer: shares in 1/256, places in 1/32 px, weights in 1/64.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_server.motion.lanes import CELL_PX, WEIGHT_BITS, warp_cell
from v2v_server.motion.matching import Vectors
from v2v_server.motion.pyramid import PAD_PX, GreyPicture, compiled

FineGrey = npt.NDArray[np.uint16]
_FRACTIONS = 32
_SHARES = 256
_HALF, _FINER = np.uint16(8), np.uint16(4)  # of 2**-8 in 2**-4
_SHIFT_BITS = 7  # from 1/_SHARES of 1/UNITS_PER_PX px to 1/_FRACTIONS px


def _cubic_weights():
    # Exact in float64: every term is a multiple of 2**-17.
    x = np.arange(_FRACTIONS) / _FRACTIONS
    near, far = (
        [1.25 * d**3 - 2.25 * d**2 + 1 for d in (x, 1 - x)],
        [-0.75 * d**3 + 3.75 * d**2 - 6 * d + 3 for d in (1 + x, 2 - x)],
    )
    weights = np.floor(np.stack([far[0], near[0], near[1], far[1]], axis=1) * 2**WEIGHT_BITS + 0.5).astype(np.int16)
    weights[:, 1] += 2**WEIGHT_BITS - weights.sum(axis=1)
    return weights


_WEIGHTS = _cubic_weights()


def between(
    first: GreyPicture,
    second: GreyPicture,
    vectors: Vectors,
    shortest: int,
    top: int,
    left: int,
    out: FineGrey,
    *,
    mirrored: bool = False,
) -> None:
    """Write the pictures at the shares 1/(n + 1) .. n/(n + 1) of the time between two pictures.

    Args:
        first, second: of one size, padded (``matching.padded``).
        vectors: [2, rows, columns], the motion between them in the cells of the part.
        shortest: length, in 1/UNITS_PER_PX px, below which a cell counts as still.
        top, left: place of the part that is written.
        out: [n, h, w] uint16, C-contiguous, at least CELL_PX on each side: grey levels in 1/16.
        mirrored: whether rows are written from right to left.
    """
    _between(first, second, vectors, max(shortest * shortest, 1), top, left, _WEIGHTS, out, mirrored)


@compiled
def _between(first, second, vectors, shortest_squared, top, left, weights, out, mirrored):
    pitch = first.shape[1]
    height, width = first.shape[0] - 2 * PAD_PX, first.shape[1] - 2 * PAD_PX
    count, rows, columns = out.shape
    a, b, flat, table = first.ravel(), second.ravel(), out.ravel(), weights.ravel()
    has_still = False
    for row in range(vectors.shape[1]):
        for column in range(vectors.shape[2]):
            x, y = np.int64(vectors[0, row, column]), np.int64(vectors[1, row, column])
            has_still |= x * x + y * y < shortest_squared
    for number in range(count):
        share = ((number + 1) * 2 * _SHARES + count + 1) // (2 * (count + 1))
        if has_still:
            start = (PAD_PX + top) * pitch + PAD_PX + left
            _mean(a, b, start, pitch, share, flat[number * rows * columns :], rows, columns, mirrored)
        for line in range(0, rows, CELL_PX):
            row = min(line, rows - CELL_PX)
            cell_row = min((row + CELL_PX // 2) // CELL_PX, vectors.shape[1] - 1)
            for each in range(0, columns, CELL_PX):
                column = min(each, columns - CELL_PX)
                cell_column = min((column + CELL_PX // 2) // CELL_PX, vectors.shape[2] - 1)
                x, y = np.int64(vectors[0, cell_row, cell_column]), np.int64(vectors[1, cell_row, cell_column])
                if x * x + y * y < shortest_squared:
                    x, y = np.int64(0), np.int64(0)
                    if row == line and column == each:
                        continue
                weight = share
                at, at_x, at_y, is_first = _place(top + row, left + column, -share * x, -share * y, height, width)
                rest = _SHARES - share
                to, to_x, to_y, is_second = _place(top + row, left + column, rest * x, rest * y, height, width)
                if is_first != is_second:
                    weight = 0 if is_first else _SHARES
                warp_cell(
                    a, at, at_x, at_y, b, to, to_x, to_y, table, pitch, weight, flat,
                    (number * rows + row) * columns + (columns - CELL_PX - column if mirrored else column), columns,
                    mirrored,
                )  # fmt: skip


@compiled
def _mean(first, second, at, pitch, share, out, rows, columns, mirrored):
    """Write the weighted mean of two pictures: what a warp without motion gives."""
    line = np.empty(columns, np.uint16)
    one_weight, other_weight = np.uint16(_SHARES - share), np.uint16(share)
    for row in range(rows):
        one, other = first[at + row * pitch :], second[at + row * pitch :]
        into = out[row * columns : (row + 1) * columns]
        mixed = line if mirrored else into
        for column in range(columns):
            mean = np.uint16(np.uint16(one[column]) * one_weight)
            mean = np.uint16(mean + np.uint16(np.uint16(other[column]) * other_weight))
            mixed[column] = np.uint16(np.uint16(mean + _HALF) >> _FINER)
        if mirrored:
            for column in range(columns):
                into[column] = line[np.uint64(columns - 1 - column)]  # a signed index would not be vectorised


@compiled
def _place(row, column, right, down, height, width):
    """Return where a moved cell is read: the pixel above and left of it in the padded picture, the fractions, and
    whether its middle lies in the picture.
    """
    half = 1 << (_SHIFT_BITS - 1)
    y, x = (down + half) >> _SHIFT_BITS, (right + half) >> _SHIFT_BITS
    middle_y, middle_x = row + CELL_PX // 2 + (y // _FRACTIONS), column + CELL_PX // 2 + (x // _FRACTIONS)
    is_inside = 0 <= middle_y < height and 0 <= middle_x < width
    first_row = min(max(row + y // _FRACTIONS - 1 + PAD_PX, 0), height + 2 * PAD_PX - 8)
    first_column = min(max(column + x // _FRACTIONS - 1 + PAD_PX, 0), width + 2 * PAD_PX - 8)
    return first_row * (width + 2 * PAD_PX) + first_column, x % _FRACTIONS, y % _FRACTIONS, is_inside
