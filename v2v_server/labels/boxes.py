"""The boxes of one video.

Coordinates are px of the upright picture, continuous: pixel (row, column) covers column <= x < column + 1. Frames count
from 0 in presentation order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

NO_TRACK = -1
LARGEST_NUMBER = 2**24 - 1
"""Largest class and track: float32 holds all whole numbers up to here."""
_LARGEST_FRAME = 2**40
_LARGEST_PX = 1e6


class Box(NamedTuple):
    """One box of one frame.

    Attributes:
        frame: from 0.
        left, top, width, height: px.
        category: class, from 0.
        track: from 0, or NO_TRACK.
    """

    frame: int
    left: float
    top: float
    width: float
    height: float
    category: int
    track: int


@dataclass(frozen=True, slots=True, eq=False)
class BoxTable:
    """All boxes of a video, ordered by frame.

    Attributes:
        frames: [n] int64, ascending.
        corners: [n, 4] float64: x0, y0, x1, y1, px.
        numbers: [n, 2] int64: class and track.
        annotated: frames that have labels, with boxes or without; None: all frames.
    """

    frames: npt.NDArray[np.int64]
    corners: npt.NDArray[np.float64]
    numbers: npt.NDArray[np.int64]
    annotated: frozenset[int] | None = None

    @classmethod
    def of(cls, boxes: Sequence[Box], annotated: frozenset[int] | None = None) -> BoxTable:
        """Build the table from boxes that :func:`checked` has passed, in any order."""
        ordered = sorted(boxes, key=lambda box: box.frame)  # stable: boxes of a frame keep the file's order
        frames = np.array([box.frame for box in ordered], np.int64)
        places = np.array([box[1:5] for box in ordered], np.float64).reshape(-1, 4)
        numbers = np.array([box[5:] for box in ordered], np.int64).reshape(-1, 2)
        corners = np.concatenate([places[:, :2], places[:, :2] + places[:, 2:]], axis=1)
        return cls(frames, corners, numbers, annotated)

    def at(self, frame: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return corners and numbers of the boxes of one frame.

        Raises:
            ValueError: the frame has no labels.
        """
        if self.annotated is not None and frame not in self.annotated:
            raise ValueError(f"has no frame {frame}: add it, also if it shows no object")
        first, end = np.searchsorted(self.frames, (frame, frame + 1))
        return self.corners[first:end], self.numbers[first:end]


def checked(box: Box) -> Box:
    """Return the box.

    Raises:
        ValueError: one of its numbers is outside its limits.
    """
    if not 0 <= box.frame <= _LARGEST_FRAME:
        raise ValueError(f"frame {box.frame} of a box: give a whole number from 0")
    if not all(-_LARGEST_PX <= number <= _LARGEST_PX for number in box[1:5]):  # also NaN
        raise ValueError(f"box {list(box[1:5])}: coordinates are at most {_LARGEST_PX:g} px")
    if box.width < 0 or box.height < 0:
        raise ValueError(f"box {list(box[1:5])}: width and height are at least 0")
    if not 0 <= box.category <= LARGEST_NUMBER:
        raise ValueError(f"class {box.category}: give a whole number from 0 to {LARGEST_NUMBER}")
    if not NO_TRACK <= box.track <= LARGEST_NUMBER:
        raise ValueError(f"track {box.track}: give a whole number from 0 to {LARGEST_NUMBER}, or {NO_TRACK} for none")
    return box
