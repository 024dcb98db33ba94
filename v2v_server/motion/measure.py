"""What moves in a clip, counted from its frames: how fast, whether it turns back, and whether blocks follow it.

A pixel counts where it changes by more than a coder's noise from one frame to the next. It is followed if the vector of
its cell leads to the same light in both frames, up to half a pixel. It is uncovered background if it is not followed,
lies where motion changes from cell to cell, and something that is followed lies on it in one of the frames. The others
are lost: too small or too fast for blocks, or their light changes.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.motion.lanes import CELL_PX
from v2v_server.motion.matching import UNITS_PER_PX, Vectors
from v2v_server.motion.plane import motions
from v2v_server.motion.pyramid import GreyPicture
from v2v_server.simulation.view import FrameArray
from v2v_server.system.compile_cache import cv2

_MOST_FRAMES = 33
"""Frames that are measured: a fraction of a second's work."""
_CHANGED_GREY = 8
"""Grey levels that a coder's noise seldom exceeds."""
_FINEST, _FASTEST_PX = 4, 64
"""Speeds are counted in steps of 1/_FINEST px a frame, up to the fastest."""
_NEAR_PX, _NEAR_CELLS = np.ones((3, 3), np.uint8), np.ones((5, 5), np.uint8)


class MeasuredMotion(NamedTuple):
    """Pixels of the steps from frame to frame, counted.

    Attributes:
        speeds: those that change and move, at each speed in 1/_FINEST px a frame; the last one counts faster ones.
        changed: those that change, and whose motion stays in the picture.
        lost, uncovered: of these, see the module's docstring.
        paired, turned: those that move in two following steps; of these, those that move back.
    """

    speeds: tuple[int, ...] = (0,) * (_FINEST * _FASTEST_PX + 1)
    changed: int = 0
    lost: int = 0
    uncovered: int = 0
    paired: int = 0
    turned: int = 0

    def px_per_frame(self, share: float) -> float:
        """Return the speed that a share of what moves does not exceed; 0 where nothing moves."""
        reached = np.cumsum(self.speeds)
        return float(np.searchsorted(reached, share * reached[-1])) / _FINEST


def together(found: Iterable[MeasuredMotion]) -> MeasuredMotion:
    """Return the sum over several clips."""
    speeds, *counts = zip(MeasuredMotion(), *found, strict=True)
    return MeasuredMotion(tuple(map(sum, zip(*speeds, strict=True))), *map(sum, counts))


def measure(pictures: FrameArray) -> MeasuredMotion:
    """Measure what moves in a clip.

    Args:
        pictures: [n, h, w] uint8, consecutive frames as a camera sees them; of more than _MOST_FRAMES those in the
            middle are used.
    """
    first = max(0, (len(pictures) - _MOST_FRAMES) // 2)
    pictures = pictures[first : first + _MOST_FRAMES]
    counts, speeds = np.zeros(5, np.int64), np.zeros(len(MeasuredMotion().speeds), np.int64)
    last = np.zeros((2, 1, 1), np.int64)
    for (before, after), vectors in zip(pairwise(pictures), motions(pictures)[1:], strict=True):
        changed, lost, uncovered, moved = _step(before, after, vectors)
        moves = moved.any(axis=0)
        places = np.rint(np.hypot(*moved[:, changed & moves]) * (_FINEST / UNITS_PER_PX)).astype(np.int64)
        speeds += np.bincount(np.minimum(places, len(speeds) - 1), minlength=len(speeds))
        along = (moved * last).sum(axis=0)
        found = np.array([np.count_nonzero(each) for each in (changed, lost, uncovered, along, along < 0)])
        # A thing shows at its front what it uncovers behind: beyond that, noise was followed by chance.
        excess = max(2 * found[2] + found[1] - found[0], 0)
        counts += found + np.array([0, excess, -excess, 0, 0])
        last = moved if moves.any() else last  # a repeated frame is no change of the motion
    return MeasuredMotion(tuple(speeds.tolist()), *counts.tolist())


def _step(
    before: GreyPicture, after: GreyPicture, vectors: Vectors
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Return which pixels are changed, lost and uncovered, [h, w] each, and the vectors of those that are followed.

    Pixels are those of the picture halfway. The vectors, [2, h, w] in 1/UNITS_PER_PX px, are zero for others.
    """
    moved = _by_pixel(vectors.astype(np.int64), before)
    ahead = np.rint(moved[::-1] / UNITS_PER_PX).astype(np.int64)
    back, limits = ahead >> 1, np.reshape(before.shape, (2, 1, 1)) - 1
    places = [np.indices(before.shape) + each for each in (-back, ahead - back)]
    inside = np.all([np.clip(place, 0, limits) == place for place in places], axis=(0, 1))
    ends = [tuple(np.clip(place, 0, limits)) for place in places]
    one, other = (
        [cv2.addWeighted(picture, 0.5, near, 0.5, 0)[end]
         for near in (cv2.erode(picture, _NEAR_PX), picture, cv2.dilate(picture, _NEAR_PX))]
        for picture, end in zip((before, after), ends, strict=True)
    )  # fmt: skip
    # Differences of uint8 saturate at 0.
    apart = [
        cv2.subtract(*each)
        for mine, its in ((one, other), (other, one))
        for each in ((mine[0], its[1]), (its[1], mine[2]))
    ]
    follows = np.max(apart, axis=0) <= _CHANGED_GREY
    changed = inside & (cv2.absdiff(before, after) > _CHANGED_GREY)
    covered = np.zeros(before.shape, np.uint8)
    for end in ends:
        covered[tuple(axis[follows & ahead.any(axis=0)] for axis in end)] = 1
    layers = np.ascontiguousarray(np.moveaxis(vectors, 0, -1))
    differ = cv2.dilate(layers, _NEAR_CELLS) - cv2.erode(layers, _NEAR_CELLS) > UNITS_PER_PX
    borders = _by_pixel(np.moveaxis(differ, -1, 0), before).any(axis=0)
    uncovered = changed & ~follows & borders & (cv2.dilate(covered, _NEAR_PX) > 0)
    return changed, changed & ~follows & ~uncovered, uncovered, moved * follows


def _by_pixel(cells: npt.NDArray[Any], picture: GreyPicture) -> npt.NDArray[Any]:
    """Return the values of cells [..., rows, columns] at the pixels of a picture, [..., h, w]."""
    height, width = picture.shape
    return cells.repeat(CELL_PX, axis=-2).repeat(CELL_PX, axis=-1)[..., :height, :width]
