"""How a stored picture must be turned and mirrored to stand upright: the display matrix of its container."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from av.sidedata.sidedata import SideDataContainer
from av.video.frame import VideoFrame

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
    def of(cls, frame: VideoFrame) -> Orientation:
        """Return the orientation in the frame's display matrix; upright without one.

        A matrix that turns by another angle than a multiple of 90 degrees counts as the nearest one.
        """
        try:
            notes = cast(SideDataContainer, frame.side_data)  # PyAV's type hints describe something else
        except ValueError:  # it does not know Exif data; the angle is all that it tells then
            turned = {0: cls(), 90: cls(True, flip_y=True), -90: cls(True, flip_x=True)}
            return turned.get(frame.rotation, cls(flip_y=True, flip_x=True))
        if "DISPLAYMATRIX" not in notes:
            return cls()
        # x' = a x + c y, y' = b x + d y (16.16 fixed point; libavutil/display.h). Only the signs matter here.
        a, b, _, c, d = struct.unpack_from("=5i", memoryview(notes["DISPLAYMATRIX"]))
        if abs(a) >= abs(b):
            return cls(False, flip_y=d < 0, flip_x=a < 0)
        return cls(True, flip_y=b < 0, flip_x=c < 0)

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
