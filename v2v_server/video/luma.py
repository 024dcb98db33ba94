"""Which grey is meant: the luma Y that the file stores, stretched to the full range 0 .. W.

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
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, ColorTrc

from v2v_server.video.orientation import PixelRect

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
        from v2v_server.video.full_range import to_full_range

        to_full_range(frames)
