"""Convert the pixels of a block to the stored differences and back, compiled.

A block is some frames of a rectangle of the picture. The first frame is stored as differences to the row above, every
other frame as differences to the frame before, all modulo 256, so every value is recovered exactly. Frames decoded from
lossy video mostly repeat the frame before, and differences of 0 compress to almost nothing.

Like :mod:`v2v_server.video.levels`, the module uses nothing of other files, and its signatures accept every layout.
"""

# mypy: allow-untyped-defs
from __future__ import annotations

import numba
import numpy as np


@numba.njit(numba.void(numba.uint8[:, :, :], numba.int64, numba.uint8[::1]), nogil=True, cache=True)
def to_differences(band, width, out):
    """Compute the differences of the blocks of a band, one block after the other.

    Args:
        band: [t, h, W] uint8, frames of a row of blocks.
        width: columns of a block; the last one may have fewer.
        out: [t h W] uint8, receives the blocks from left to right, each as [t, h, its width].
    """
    frames, height, columns = band.shape
    at = 0
    for left in range(0, columns, width):
        wide = min(width, columns - left)
        size = frames * height * wide
        part, block = band[:, :, left : left + wide], out[at : at + size].reshape(frames, height, wide)
        for x in range(wide):
            block[0, 0, x] = part[0, 0, x]
        for y in range(1, height):
            for x in range(wide):
                block[0, y, x] = np.uint8(part[0, y, x] - part[0, y - 1, x])
        for t in range(1, frames):
            for y in range(height):
                for x in range(wide):
                    block[t, y, x] = np.uint8(part[t, y, x] - part[t - 1, y, x])
        at += size


_READ_ONLY = numba.types.Array(numba.uint8, 1, "C", readonly=True)
_WHOLE = numba.int64


@numba.njit(
    numba.void(_READ_ONLY, _WHOLE, _WHOLE, _WHOLE, _WHOLE, _WHOLE, _WHOLE, numba.uint8[:, :, :]), nogil=True, cache=True
)
def from_differences(block, height, width, top, left, first, stride, out):
    """Restore frames ``first``, ``first + stride`` ... of a part of a block.

    Args:
        block: [t height width] uint8, the differences of a block; t is larger than the last requested frame.
        height, width: size of the block, pixels.
        top, left: position of the part in the block, pixels.
        first: the first requested frame.
        stride: distance between the frames.
        out: [n, h, w] uint8, receives the part.
    """
    count, rows, columns = out.shape
    frames = first + (count - 1) * stride + 1
    part = block[: frames * height * width].reshape(frames, height, width)[:, :, left : left + columns]
    above = np.zeros(columns, np.uint8)
    for y in range(top + rows):
        for x in range(columns):
            above[x] = np.uint8(above[x] + part[0, y, x])
        if y >= top:
            for x in range(columns):
                out[0, y - top, x] = above[x]
    for t in range(1, first + 1):
        for y in range(rows):
            for x in range(columns):
                out[0, y, x] = np.uint8(out[0, y, x] + part[t, top + y, x])
    for number in range(1, count):
        t = first + (number - 1) * stride + 1
        for y in range(rows):
            for x in range(columns):
                out[number, y, x] = np.uint8(out[number - 1, y, x] + part[t, top + y, x])
        for later in range(t + 1, first + number * stride + 1):
            for y in range(rows):
                for x in range(columns):
                    out[number, y, x] = np.uint8(out[number, y, x] + part[later, top + y, x])
