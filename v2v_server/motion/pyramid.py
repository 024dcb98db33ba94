"""A picture between which and another motion is searched: its levels from fine to coarse, read or made when needed."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.motion.lanes import CELL_PX
from v2v_server.video.picture import PixelRect

GreyPicture = npt.NDArray[np.uint8]
"""[h, w] uint8."""
PAD_PX = 16
"""Border of a level: its edge repeated."""
_LEVELS = 4
_SMALLEST_SIDE_PX = 16
compiled: Any = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Decorator of this folder's compiled functions."""


class Cells(NamedTuple):
    """A rectangle of cells."""

    top: int
    left: int
    rows: int
    columns: int


class Pyramid:
    """A picture, and its padded levels, of which only what is needed is read or made.

    Args:
        height, width: of the picture, pixels; at least CELL_PX each.
        read: returns a part (top, left, rows, columns) of it, [rows, columns] uint8, C-contiguous.
    """

    def __init__(self, height: int, width: int, read: Callable[[PixelRect], GreyPicture]) -> None:
        self.height, self.width, self._read = height, width, read
        self._part: tuple[PixelRect, GreyPicture] | None = None

    @classmethod
    def of(cls, picture: GreyPicture) -> Pyramid:
        """Return the pyramid of a [h, w] uint8 picture. It is not copied, so it may not change."""

        def part(window: PixelRect) -> GreyPicture:
            top, left, rows, columns = window
            return np.ascontiguousarray(picture[top : top + rows, left : left + columns])

        height, width = picture.shape
        return cls(height, width, part)

    def part(self, window: PixelRect) -> GreyPicture:
        """Return a part of the picture; the last one is kept."""
        if self._part is None or self._part[0] != window:
            self._part = window, self._read(window)
        return self._part[1]

    @property
    def cells(self) -> Cells:
        """Return all cells of the picture."""
        return Cells(0, 0, -(-self.height // CELL_PX), -(-self.width // CELL_PX))

    @cached_property
    def levels(self) -> list[GreyPicture]:
        """Return the picture and its rounded means of four, each with PAD_PX more on each side."""
        picture = self.part((0, 0, self.height, self.width))
        levels = [padded(picture)]
        while len(levels) < _LEVELS and min(picture.shape) >= 2 * _SMALLEST_SIDE_PX:
            picture = _halved(picture)
            levels.append(padded(picture))
        return levels


@compiled
def padded(picture):
    """Return a picture with PAD_PX more on each side."""
    height, width = picture.shape
    larger = np.empty((height + 2 * PAD_PX, width + 2 * PAD_PX), np.uint8)
    for row in range(height):
        line = larger[row + PAD_PX]
        line[PAD_PX : PAD_PX + width] = picture[row]
        line[:PAD_PX] = picture[row, 0]
        line[PAD_PX + width :] = picture[row, width - 1]
    for row in range(PAD_PX):
        larger[row] = larger[PAD_PX]
        larger[PAD_PX + height + row] = larger[PAD_PX + height - 1]
    return larger


@compiled
def _halved(picture):
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    half = np.empty((height, width), np.uint8)
    for y in range(height):
        above, below = picture[2 * y], picture[2 * y + 1]
        for x in range(width):
            total = np.uint16(above[2 * x]) + np.uint16(above[2 * x + 1])
            total += np.uint16(below[2 * x]) + np.uint16(below[2 * x + 1])
            half[y, x] = np.uint8((total + 2) >> 2)
    return half
