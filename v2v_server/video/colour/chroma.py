"""The colour differences of decoded frames.

One sample of Cb and Cr for each cell of 2 x 2 pixels, the sampling of most videos: that of the cell's upper left pixel.
Values are the stored ones, shifted and stretched like full-range luma
(:mod:`v2v_server.video.luma`), at 8 bits:

    Cb = round((stored - 128 s) 255 / (224 s)), limited range, s = 2**(bits - 8);
    Cb = round((stored - 2**(bits - 1)) 255 / (2**bits - 1)), full range.

The file states the matrix to red, green and blue; one that states none, or another than these, has that of BT.601, as
in FFmpeg.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace

from v2v_server.video.luma import BeyondBits, LumaFormat
from v2v_server.video.orientation import Orientation, PixelRect

CHROMA_CELL_PX = 2
DEFAULT_MATRIX = "BT.601"
SMPTE_240M = "SMPTE 240M"
_STATED = {
    int(Colorspace.ITU709): "BT.709", int(Colorspace.SMPTE240M): SMPTE_240M, int(Colorspace.BT2020): "BT.2020",
    10: "BT.2020",
}  # fmt: skip


class Chroma(NamedTuple):
    """Colour of some frames.

    Attributes:
        cells: [n, 2, rows, columns] int8, Cb and Cr, upright.
        matrix: "BT.601", "BT.709", "SMPTE 240M" or "BT.2020".
    """

    cells: npt.NDArray[np.int8]
    matrix: str


@dataclass(frozen=True, slots=True)
class ChromaCut:
    """What one sample takes of the colour of a clip.

    Attributes:
        frames: which frames of the cut, ascending.
        window: (top, left, height, width) in the upright picture, px.
        usable_px: first row in use (:mod:`v2v_server.video.rows`), and number of rows in use.
    """

    frames: tuple[int, ...]
    window: PixelRect
    usable_px: tuple[int, int]

    @property
    def cells(self) -> PixelRect:
        """Return the cells that hold the window: (top, left, rows, columns)."""
        rows, columns = self._places
        top, left = int(rows[0]), int(columns[0])
        return top, left, int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left

    @property
    def places(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the row of :attr:`cells` of each row of the window, [height], and likewise the columns, [width]."""
        rows, columns = self._places
        return rows - rows[0], columns - columns[0]

    @property
    def _places(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return row and column in the picture's cells of the rows and columns of the window.

        As many rows of cells are stored as the rows in use fill. If an even number of rows begins at an odd one, the
        last has the colour of the row before.
        """
        top, left, height, width = self.window
        first, count = self.usable_px
        last = first // CHROMA_CELL_PX + -(-count // CHROMA_CELL_PX) - 1
        rows = np.minimum((top + np.arange(height, dtype=np.int64)) // CHROMA_CELL_PX, last)
        return rows, (left + np.arange(width, dtype=np.int64)) // CHROMA_CELL_PX


class ChromaStack:
    """Collect the colour of the frames of one cut.

    Args:
        cut: what to collect.
        orientation: of the stored pictures.
        height_px, width_px: size of the upright picture.
    """

    def __init__(self, cut: ChromaCut, orientation: Orientation, height_px: int, width_px: int) -> None:
        first_row, first_column, rows, columns = cut.cells
        # The upper left pixel of each cell, in the stored picture.
        y = CHROMA_CELL_PX * np.arange(first_row, first_row + rows)
        x = CHROMA_CELL_PX * np.arange(first_column, first_column + columns)
        y = height_px - 1 - y if orientation.flip_y else y
        x = width_px - 1 - x if orientation.flip_x else x
        self._transpose = orientation.transpose
        self._stored = (x, y) if orientation.transpose else (y, x)
        self._frames = frozenset(cut.frames)
        self._cells = np.zeros((len(cut.frames), 2, rows, columns), np.int8)
        self._count = 0
        self._matrix = DEFAULT_MATRIX

    def add(self, frame: VideoFrame, ordinal: int) -> None:
        """Look at a frame; ``ordinal`` is its number in the cut."""
        if ordinal not in self._frames:
            return
        cells, matrix = self.cells_of(frame)
        if not self._count:
            self._matrix = matrix
        self._cells[self._count] = cells
        self._count += 1

    def cells_of(self, frame: VideoFrame) -> tuple[npt.NDArray[np.int8], str]:
        """Return Cb and Cr of one frame, [2, rows, columns], and the matrix.

        Raises:
            BeyondBits: a sample has more bits than the format states.
        """
        planes, table, matrix = _planes_of(frame)
        cells = np.zeros(self._cells.shape[1:], np.int8)
        for plane, (samples, down, across) in enumerate(planes):
            rows, columns = self._stored[0] // down, self._stored[1] // across
            stored = samples[rows][:, columns]
            if stored.max(initial=0) >= len(table):
                raise BeyondBits(
                    f"has a colour sample of {stored.max()}, beyond its {len(table).bit_length() - 1} bits"
                )
            values = table[stored]
            cells[plane] = values.T if self._transpose else values
        return cells, matrix

    def chroma(self) -> Chroma:
        """Return what was collected."""
        return Chroma(self._cells, self._matrix)


def stated_matrix(frame: VideoFrame) -> str:
    """Return the matrix of a decoded frame's colour."""
    return _STATED.get(int(frame.colorspace), DEFAULT_MATRIX)


_Plane = tuple[npt.NDArray[Any], int, int]


def _planes_of(frame: VideoFrame) -> tuple[Sequence[_Plane], npt.NDArray[np.int8], str]:
    """Return samples of Cb and Cr as stored, each with pixels per sample down and across; table of values; matrix.

    A grey picture has no samples.
    """
    luma = LumaFormat.of(frame)
    if luma.pixel_format.startswith("gray"):
        return (), _table(8, True), DEFAULT_MATRIX
    matrix = stated_matrix(frame)
    if not luma.has_plane:
        frame = frame.reformat(
            format="yuv444p", dst_colorspace=Colorspace.ITU601, dst_color_range=ColorRange.JPEG
        )  # has its own matrix, whatever the source states
        luma, matrix = LumaFormat(frame.format.name, int(ColorRange.JPEG), 8, True, True), DEFAULT_MATRIX
    planes = []
    name = frame.format.name
    size = luma.sample.itemsize
    for number in (1, 2):
        component = frame.format.components[number]
        plane = frame.planes[component.plane]
        is_pair = name.startswith("nv")  # Cb and Cr side by side in one plane; Cr first in nv21
        first = (number - 1) ^ (name == "nv21") if is_pair else 0
        step = 2 * size if is_pair else size
        buffer: Any = plane
        samples = np.ndarray(
            (component.height, component.width), luma.sample, buffer, first * size, (plane.line_size, step)
        )
        planes.append((samples, -(-frame.height // component.height), -(-frame.width // component.width)))
    return planes, _table(luma.bits, luma.full_range), matrix


@cache
def _table(bits: int, full_range: bool) -> npt.NDArray[np.int8]:
    """Return Cb or Cr of every stored value, [2**bits]."""
    values, scale = np.arange(2**bits, dtype=np.int64), 2 ** (bits - 8)
    span = 2**bits - 1 if full_range else 224 * scale
    # Rounding half up in whole numbers.
    levels = (510 * (values - 128 * scale) + span) // (2 * span)
    table: npt.NDArray[np.int8] = np.clip(levels, -128, 127).astype(np.int8)
    table.flags.writeable = False
    return table
