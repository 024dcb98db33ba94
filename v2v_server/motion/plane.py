"""Motion along a video, from each picture to the next: whole pictures in, vectors of the wanted cells out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from v2v_server.motion.matching import Vectors, motion
from v2v_server.motion.pyramid import Cells, Pyramid
from v2v_server.simulation.view import FrameArray
from v2v_server.video.decode import Cut


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
        self._seen = 0

    def add(self, picture: Pyramid) -> None:
        """Look at the next picture."""
        number, self._seen = self._seen, self._seen + 1
        before, self._last = self._last, picture
        current = [(vectors, cells) for (count, cells), vectors in zip(self._cuts, self.vectors, strict=True)
                   if number < count]  # fmt: skip
        if before is None or not current:
            return
        top, left = (min(cells[axis] for _, cells in current) for axis in (0, 1))
        bottom, right = (max(cells[axis] + cells[axis + 2] for _, cells in current) for axis in (0, 1))
        found = motion(before, picture, Cells(top, left, bottom - top, right - left))
        for vectors, (first_row, first_column, rows, columns) in current:
            down, across = first_row - top, first_column - left
            vectors[number] = found[:, down : down + rows, across : across + columns]


def motions(pictures: FrameArray) -> Vectors:
    """Return the motion of pictures [n, h, w]: [n, 2, rows, columns], zero for the first."""
    following = (Pyramid.of(pictures[max(at, 0)]) for at in range(-1, len(pictures)))
    return np.stack([motion(before, after) for before, after in pairwise(following)])
