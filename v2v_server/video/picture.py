"""What the samples of a decoded picture mean: its luma, its colour differences, and how it is turned upright.

Which grey is meant: the luma Y that the file stores, stretched to the full range 0 .. W.

W is 255, or 2**k - 1 where a caller keeps k of the b bits of a deeper clip. No colour conversion takes place; where a
picture has a luma plane, that plane is the picture.

* limited ("tv", "mpeg") range, 8 bit:  grey = clip(round((Y - 16) 255 / 219), 0, 255), Y = 16 .. 235 (ITU-R BT.601);
* limited range, b bit:                 grey = clip(round((Y - 16 s) W / (219 s)), 0, W), s = 2**(b - 8);
* full ("pc", "jpeg") range:            grey = Y at 8 bit, round(Y W / (2**b - 1)) at b bit.

A file that does not state its range has full range if its pixel format is ``yuvj*`` or ``gray*``, else limited range.
Conversions that go through red, green and blue give another grey: swscale's to ``gray`` is this one for 8-bit clips
that state BT.601 or nothing, and for BT.709 it differs, by up to tens of levels in coloured places, since FFmpeg 8;
OpenCV's, from BGR, rounds and clips on the way. What a file stores is the same under every version of every library.

Formats without a luma plane (RGB, palettes, packed YUV) go through swscale's ``gray``.

Colour is one sample of Cb and Cr for each cell of 2 x 2 pixels, the sampling of most videos: that of the cell's upper
left pixel. Values are the stored ones, shifted and stretched like full-range luma, at 8 bits:

    Cb = round((stored - 128 s) 255 / (224 s)), limited range, s = 2**(bits - 8);
    Cb = round((stored - 2**(bits - 1)) 255 / (2**bits - 1)), full range.

The file states the matrix to red, green and blue; one that states none, or another than these, has that of BT.601, as
in FFmpeg.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from av.sidedata.sidedata import SideDataContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, ColorTrc

PixelRect = tuple[int, int, int, int]
"""(top, left, height, width) of a part of a picture, pixels."""


@dataclass(frozen=True, slots=True)
class Orientation:
    """One of the eight ways a picture can lie: transposed first, then mirrored.

    Attributes:
        transpose: rows become columns.
        flip_y, flip_x: the (transposed) picture is mirrored top to bottom, left to right.
    """

    transpose: bool = False
    flip_y: bool = False
    flip_x: bool = False

    @classmethod
    def of(cls, frame: VideoFrame, codec: str = "") -> Orientation:
        """Return the orientation in the display matrix of a frame of a codec; upright without one.

        A matrix that turns by another angle than a multiple of 90 degrees counts as the nearest one.
        """
        if codec == "png":  # PyAV frees the name of its colour profile, which FFmpeg frees too
            return cls.turned(frame.rotation)
        try:
            notes = cast(SideDataContainer, frame.side_data)  # PyAV's type hints describe something else
        except ValueError:  # it does not know Exif data; the angle is all that it tells then
            return cls.turned(frame.rotation)
        if "DISPLAYMATRIX" not in notes:
            return cls()
        # x' = a x + c y, y' = b x + d y (16.16 fixed point; libavutil/display.h). Only the signs matter here.
        a, b, _, c, d = struct.unpack_from("=5i", memoryview(notes["DISPLAYMATRIX"]))
        if abs(a) >= abs(b):
            return cls(False, flip_y=d < 0, flip_x=a < 0)
        return cls(True, flip_y=b < 0, flip_x=c < 0)

    @classmethod
    def turned(cls, degrees: int) -> Orientation:
        """Return the orientation of a display matrix that turns by an angle, counter-clockwise, and mirrors nothing."""
        turned = {0: cls(), 90: cls(True, flip_y=True), -90: cls(True, flip_x=True)}
        return turned.get(degrees, cls(flip_y=True, flip_x=True))

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Return (height, width) of the upright picture from the stored one's, or the reverse."""
        return (width, height) if self.transpose else (height, width)

    def stored_window(self, window: PixelRect, height: int, width: int) -> PixelRect:
        """Return the window of the stored picture that shows a window of the upright one of that height and width."""
        top, left, rows, columns = window
        if self.flip_y:
            top = height - top - rows
        if self.flip_x:
            left = width - left - columns
        return (left, top, columns, rows) if self.transpose else (top, left, rows, columns)

    def upright(self, frames: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn stored pictures [n, h, w] upright: [n, h, w] or [n, w, h], C-contiguous."""
        if self.transpose:
            frames = frames.transpose(0, 2, 1)
        if self.flip_y:
            frames = frames[:, ::-1]
        if self.flip_x:
            frames = frames[:, :, ::-1]
        return np.ascontiguousarray(frames)


_BYTE, _WIDE = np.dtype(np.uint8), np.dtype(np.uint16)
_LUMA_PLANE = re.compile(r"(yuvj?\d{3}p|yuva\d{3}p|gray|nv(12|16|21|24)$)((9|10|12|14|16)(le|be))?$")

TRANSFERS: dict[int, str] = {
    ColorTrc.LINEAR: "linear",
    ColorTrc.LOG: "log100",
    ColorTrc.LOG_SQRT: "log316",
    ColorTrc.SMPTE2084: "pq",
    ColorTrc.ARIB_STD_B67: "hlg",
}
"""Transfer characteristics that are not a display's gamma, by their code points (ITU-T H.273)."""
MIXED = "mixed"
"""Stands for the transfer of a clip whose frames state different ones."""
MOST_BITS = 12
"""Largest number of bits that are kept of a level; deeper luma is rounded."""


class Signal(NamedTuple):
    """What the grey levels of a clip mean.

    Attributes:
        bits: levels are 0 .. 2**bits - 1, 8 to MOST_BITS.
        transfer: one of TRANSFERS, as the video states it; "" for any other, which is SDR; or MIXED.
    """

    bits: int = 8
    transfer: str = ""

    @property
    def white(self) -> int:
        """Return the highest level."""
        return (1 << self.bits) - 1

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """dtype of the levels."""
        return _BYTE if self.bits == 8 else _WIDE

    def __str__(self) -> str:
        return f"{self.bits} bits, {self.transfer.upper() or 'SDR'}"


SDR = Signal()
"""8 bits, shown by a gamma: the signal of most videos."""


@dataclass(frozen=True, slots=True)
class LumaFormat:
    """How the luma of a frame is stored.

    Attributes:
        pixel_format: FFmpeg's name.
        color_range: as stated by the file, AVCOL_RANGE_*.
        bits: significant bits of a sample; 8 where the frame must first go through ``gray``.
        full_range: whether 0 and 2**bits - 1 are black and white.
        has_plane: whether plane 0 is the luma; otherwise the frame goes through ``gray``.
    """

    pixel_format: str
    color_range: int
    bits: int
    full_range: bool
    has_plane: bool

    @classmethod
    def of(cls, frame: VideoFrame) -> LumaFormat:
        """Return the luma format of a decoded frame."""
        name = frame.format.name
        if not _LUMA_PLANE.fullmatch(name) or frame.planes[0].line_size <= 0:  # negative: stored bottom-up
            return cls(name, int(frame.color_range), 8, full_range=True, has_plane=False)
        is_stated = frame.color_range != ColorRange.UNSPECIFIED
        full_range = frame.color_range == ColorRange.JPEG if is_stated else name.startswith(("yuvj", "gray"))
        return cls(name, int(frame.color_range), frame.format.components[0].bits, full_range, has_plane=True)

    def describes(self, frame: VideoFrame) -> bool:
        """Return whether that frame's luma is stored like this, whatever its format and range are called."""
        if frame.format.name == self.pixel_format and frame.color_range == self.color_range:
            return True
        other = LumaFormat.of(frame)
        are_planes = self.has_plane and other.has_plane
        return are_planes and (self.bits, self.full_range, self.sample) == (other.bits, other.full_range, other.sample)

    def __str__(self) -> str:
        return f"{self.pixel_format} ({self.bits} bits, {'full' if self.full_range else 'limited'} range)"

    @property
    def sample(self) -> np.dtype[np.unsignedinteger]:
        """dtype of one sample in the plane."""
        if self.bits == 8:
            return _BYTE
        return np.dtype(">u2" if self.pixel_format.endswith("be") else "<u2")


@cache
def range_table(bits: int, full_range: bool, kept: Signal = SDR) -> npt.NDArray[np.unsignedinteger]:
    """Return the full-range grey of every luma value, [2**bits] of the dtype of ``kept``."""
    values, white = np.arange(2**bits, dtype=np.int64), kept.white
    scale = 2 ** (bits - 8)
    black, span = (0, 2**bits - 1) if full_range else (16 * scale, 219 * scale)
    # Rounding half up in whole numbers: floor((2 white (Y - black) + span) / (2 span)).
    levels = np.clip((2 * white * (values - black) + span) // (2 * span), 0, white)
    table: npt.NDArray[np.unsignedinteger] = levels.astype(kept.dtype)
    table.flags.writeable = False
    return table


class BeyondBits(ValueError):
    """A picture has a sample that its pixel format cannot hold."""


def luma_plane(frame: VideoFrame, luma: LumaFormat) -> npt.NDArray[np.unsignedinteger]:
    """Return the samples of a frame's luma, [H, W] uint8 or uint16 as stored: the decoder's memory, read-only."""
    if not luma.has_plane:
        frame = frame.reformat(format="gray")
    plane = frame.planes[0]
    sample = luma.sample
    strides = plane.line_size, sample.itemsize
    return np.ndarray((frame.height, frame.width), sample, plane, strides=strides)  # type: ignore[arg-type]  # a buffer


def copy_luma(
    samples: npt.NDArray[np.unsignedinteger],
    luma: LumaFormat,
    window: PixelRect,
    out: npt.NDArray[np.unsignedinteger],
    kept: Signal = SDR,
) -> None:
    """Copy a window of :func:`luma_plane` to ``out`` [h, w].

    8-bit samples are copied as they are (:func:`stretch` maps a whole stack at once); deeper ones are mapped to the
    grey levels of ``kept``.

    Raises:
        BeyondBits: a sample is larger than its bits can hold.
    """
    top, left, height, width = window
    view = samples[top : top + height, left : left + width]
    if luma.bits == 8:
        out[...] = view
    else:
        table = range_table(luma.bits, luma.full_range, kept)
        try:
            np.take(table, view, out=out)
        except IndexError as error:  # raw video may hold any number
            raise BeyondBits(f"has a sample of {view.max()}, beyond its {luma.bits} bits") from error


def stretch(frames: npt.NDArray[Any], luma: LumaFormat) -> None:
    """Convert frames of :func:`copy_luma` to grey levels in place, unless they are grey levels already.

    Args:
        frames: [n, h, w], neighbours of a row side by side.
        luma: the format that they were copied from.
    """
    if luma.bits == 8 and not luma.full_range:
        # Imported lazily: listing or opening videos must not load numba.
        from v2v_server.video.levels import to_full_range

        to_full_range(frames)


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
