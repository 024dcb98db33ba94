"""Compiled arithmetic on the levels of pictures: limited range to full range; red, green and blue.

    red = grey + 2 (1 - Kr) Cr,  blue = grey + 2 (1 - Kb) Cb,  green from grey = Kr red + Kg green + Kb blue

Grey and colour differences have the full range. A picture without colour has red = green = blue = grey, the levels that
are simulated.

The functions use nothing of other files: the compiler itself sees when this file changes. Kernels that use several
files lie in :mod:`v2v_server.simulation`, whose sources name the folder of the compiler's cache.
"""

# mypy: allow-untyped-defs
from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
import numpy.typing as npt

_BLACK, _WHITE = np.int32(16), np.int32(235)
# 2**16 (Y - 16) 255 / 219 + 2**15 in whole numbers: what is left above 16 bits is the rounded grey of every value.
_SLOPE, _INTERCEPT, _FRACTION_BITS = np.int32(76309), np.int32(16 * 76309 - 2**15), np.int32(16)


# It runs in vectors, at a third of a look-up's time. The signature holds for every layout, so that there is one
# variant; it is compiled, or loaded, as this is imported.
@numba.njit(numba.void(numba.uint8[:, :, :]), nogil=True, cache=True)
def to_full_range(frames):
    """Turn limited-range luma Y into ``range_table(8, False)[Y]``, in place.

    Args:
        frames: [n, h, w] uint8, neighbours of a row side by side.
    """
    for number in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            row = frames[number, y]
            for x in range(len(row)):
                luma = min(max(np.int32(row[x]), _BLACK), _WHITE)
                row[x] = np.uint8((luma * _SLOPE - _INTERCEPT) >> _FRACTION_BITS)


_MATRICES = {
    "BT.601": (0.299, 0.114), "BT.709": (0.2126, 0.0722), "SMPTE 240M": (0.212, 0.087), "BT.2020": (0.2627, 0.0593),
}  # fmt: skip
"""Kr and Kb (ITU-T H.273)."""

_BYTES, _WHOLE = numba.uint8[:, :, ::1], numba.int64[::1]
_CHROMA, _TABLES = numba.uint8[:, :, :, ::1], numba.types.Array(numba.int16, 2, "C", readonly=True)


@numba.njit(
    numba.void(_BYTES, _CHROMA, _WHOLE, _WHOLE, _WHOLE, _TABLES, numba.uint8[:, :, :, ::1]), nogil=True, cache=True
)
def add_colour(grey, chroma, places, rows, columns, differences, out):
    """Write red, green and blue of some pictures.

    Args:
        grey: [n, H, W] uint8, full range.
        chroma: [m, 2, h, w] uint8, Cb and Cr plus 128.
        places: [n], the ``chroma`` of each picture.
        rows, columns: [H], [W], the row and column of ``chroma`` of each pixel.
        differences: of :func:`differences_of`.
        out: [n, 3, H, W] uint8.
    """
    count, height, width = grey.shape
    red, green, blue = np.empty(width, np.int16), np.empty(width, np.int16), np.empty(width, np.int16)
    for number in range(count):
        cb, cr = chroma[places[number]]
        before = -1
        for y in range(height):
            if rows[y] != before:  # the rows of a cell have the same colour
                before = rows[y]
                for x in range(width):
                    b, r = cb[before, columns[x]], cr[before, columns[x]]
                    red[x] = differences[0, r]
                    green[x] = differences[1, b] + differences[2, r]
                    blue[x] = differences[3, b]
            for x in range(width):
                level = np.int16(grey[number, y, x])
                out[number, 0, y, x] = np.uint8(min(max(np.int16(level + red[x]), np.int16(0)), np.int16(255)))
                out[number, 1, y, x] = np.uint8(min(max(np.int16(level + green[x]), np.int16(0)), np.int16(255)))
                out[number, 2, y, x] = np.uint8(min(max(np.int16(level + blue[x]), np.int16(0)), np.int16(255)))


@lru_cache(maxsize=16)
def differences_of(matrix: str, contrast: float) -> npt.NDArray[np.int16]:
    """Return what Cr adds to red, Cb and Cr add to green, and Cb adds to blue: [4, 256], rounded half up.

    Args:
        matrix: see :class:`v2v_server.video.picture.Chroma`.
        contrast: factor of the colour differences, that of the grey levels.
    """
    (kr, kb), values = _MATRICES[matrix], contrast * np.arange(-128.0, 128.0)
    red, blue = 2 * (1 - kr) * values, 2 * (1 - kb) * values
    kg = 1 - kr - kb
    exact = red, -kb / kg * blue, -kr / kg * red, blue
    table: npt.NDArray[np.int16] = np.floor(np.stack(exact) + 0.5).astype(np.int16)
    table.flags.writeable = False
    return table
