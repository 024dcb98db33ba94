"""Motion along a video, from each picture to the next: whole pictures in, vectors of the wanted cells out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2v_server.motion.matching import Vectors, motion, motion_if_any
from v2v_server.motion.pyramid import Cells, Pyramid
from v2v_server.simulation.view import FrameArray
from v2v_server.video.decode import Cut


class MotionOfPictures:
    """The motion to each picture from the one before."""

    def __init__(self) -> None:
        self._last: Pyramid | None = None

    def add(self, picture: Pyramid) -> Vectors:
        """Return the motion to the next picture, which is read until another comes; zero to the first."""
        before, self._last = self._last, picture
        return motion(before or picture, picture)


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
        self._last: Pyramid | None = None
        self._seen = self._box_until = 0
        self._box = Cells(0, 0, 0, 0)

    def add(self, picture: Pyramid) -> None:
        """Look at the next picture."""
        number, self._seen = self._seen, self._seen + 1
        before, self._last = self._last, picture
        if before is None:
            return
        if number >= self._box_until:
            self._bound(number)
        found = motion_if_any(before, picture, self._box)
        if found is None:
            return
        for (count, cells), vectors in zip(self._cuts, self.vectors, strict=True):
            if number < count:
                down, across = cells.top - self._box.top, cells.left - self._box.left
                vectors[number] = found[:, down : down + cells.rows, across : across + cells.columns]

    def _bound(self, number: int) -> None:
        """Bound the cells of the cuts that have a picture of this number, until one of them has no more."""
        current = [(count, cells) for count, cells in self._cuts if number < count]
        top, left = (min(cells[axis] for _, cells in current) for axis in (0, 1))
        bottom, right = (max(cells[axis] + cells[axis + 2] for _, cells in current) for axis in (0, 1))
        self._box, self._box_until = Cells(top, left, bottom - top, right - left), min(count for count, _ in current)


def motions(pictures: FrameArray) -> Vectors:
    """Return the motion of pictures [n, h, w]: [n, 2, rows, columns], zero for the first."""
    following = MotionOfPictures()
    return np.stack([following.add(Pyramid.of(picture)) for picture in pictures])
