"""Motion along a video, from each picture to the next: whole pictures in, vectors of the wanted cells out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2v_server.motion.matching import Cells, Picture, Pyramid, Vectors, motion
from v2v_server.simulation.view import Frames
from v2v_server.video.collect import Cut


class MotionOfPictures:
    """The motion to each picture from the one before."""

    def __init__(self) -> None:
        self._last: Pyramid | None = None

    def add(self, picture: Picture, cells: Cells | None = None) -> Vectors:
        """Return the motion to the next picture; zero to the first.

        Args:
            picture: [h, w] uint8. It is not copied, so it may not change before the next one.
            cells: those whose motion is wanted; None: all.

        Returns:
            [2, rows, columns] of these cells.
        """
        before, self._last = self._last, Pyramid(np.ascontiguousarray(picture))
        return motion(before or self._last, self._last, cells)


class MotionOfCuts:
    """The motion in the cells of several cuts of one clip, from its usable pictures.

    Args:
        cuts: those with cells.

    Attributes:
        vectors: of each cut [count, 2, rows, columns], zero for the first frame; complete after its last picture.
    """

    def __init__(self, cuts: Sequence[Cut]) -> None:
        self._cuts = [(cut.count, Cells(*cut.cells)) for cut in cuts if cut.cells is not None]
        self.vectors = [np.zeros((count, 2, *cells[2:]), np.int16) for count, cells in self._cuts]
        self._motion, self._seen = MotionOfPictures(), 0

    def add(self, picture: Picture) -> None:
        """Look at the next picture, [h, w] uint8."""
        number, self._seen = self._seen, self._seen + 1
        current = [
            (cells, vectors) for (count, cells), vectors in zip(self._cuts, self.vectors, strict=True) if number < count
        ]
        top, left = (min(cells[axis] for cells, _ in current) for axis in (0, 1))
        bottom, right = (max(cells[axis] + cells[axis + 2] for cells, _ in current) for axis in (0, 1))
        found = self._motion.add(picture, Cells(top, left, bottom - top, right - left))
        for cells, vectors in current:
            down, across = cells.top - top, cells.left - left
            vectors[number] = found[:, down : down + cells.rows, across : across + cells.columns]


def motions(pictures: Frames) -> Vectors:
    """Return the motion of pictures [n, h, w]: [n, 2, rows, columns], zero for the first."""
    following = MotionOfPictures()
    return np.stack([following.add(picture) for picture in pictures])
