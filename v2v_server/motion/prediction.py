"""Predict the share of the events that is lost between the frames of a clip, without and with sub-steps.

Events are lost where the light of a pixel rises and falls again within a step. The events of the frames alone, in bins
of a frame, are compared with those of the frames and the levels along the motion. The true events are estimated as
those of the latter times exp(sum of weight x feature), with weights fitted to rendered scenes (``_WEIGHTS``):

- gain: what the levels add, as a share of their events;
- smear: the picture is smoother along the motion than across it, as motion blur makes it, and blur hides losses;
- unsteady: the motion changes from step to step, as a shake does, whose turns lie between the frames; both weighted by
  the share of the events that lie where something moves;
- flicker: steps brighten and darken as a whole in turns;
- uncovered: something moves over a still picture. The levels move what lies beside it too, and make false events.

Only motion in px a frame counts; the frame rate has no influence beyond it.
"""

from __future__ import annotations

import math
import operator
from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.motion.clip import levels_between
from v2v_server.motion.lanes import CELL_PX
from v2v_server.motion.matching import UNITS_PER_PX
from v2v_server.motion.plane import motions
from v2v_server.simulation.intensity import fine_table, log_table
from v2v_server.simulation.view import FrameArray
from v2v_server.simulation.voxel import FINE_STEPS
from v2v_server.system.compile_cache import cv2

SUBSTEP_PX, THRESHOLD = 1.0, 0.2
"""``substep_px`` and contrast threshold that predictions are for."""
_MOST_FRAMES = 33
"""Frames that a prediction is made from: a fraction of a second's work."""
_GAMMA, _LOG_EPS = 2.2, 1e-3
_WEIGHTS = (
    (-0.03, (0.0, 0.16, 0.2, 0.05, -1.6)),
    (0.0, (0.26, 0.28, 0.44, 0.17, -0.2)),
    (0.1, (0.7, 0.32, 1.4, 0.25, 0.4)),
)
"""Constant and weights of Features, for the low end, the estimate and the high end: ``python -m bench loss``."""
_SHARP, _SMEARED, _STEADY = 0.2, 0.5, 0.35
"""Smear that sharp clips reach too, smear above which all counts alike; unsteadiness that steady clips reach too."""
_SLIGHT_LOSS, _UNSTEADY, _FLICKERS, _UNCOVERS = 0.05, 0.25, 0.55, 0.12
_STILL_GREY, _TEXTURE_GREY = 3.0, 8.0
"""Mean change, at most, and range of grey levels, at least, of a cell that rests and would show a motion."""


class PredictedLoss(NamedTuple):
    """A predicted share of the events, and the interval that held for nine of ten scenes of other kinds."""

    low: float
    likely: float
    high: float


class Features(NamedTuple):
    """What a loss depends on, see the module's docstring."""

    gain: float
    smear: float
    unsteady: float
    flicker: float
    uncovered: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a clip's frames say of the motion between them. Predictions of several clips can be added.

    Attributes:
        linear, divided: events of the frames alone, and with the levels along the motion.
        moving, beside: of the latter, those in cells that move, and in those of them beside a still texture.
        travelled: sum over the events in cells that move of the logarithm of their speed, px a frame.
        paired, unsteady: events in cells that move in one of two following steps; their sum weighted by the change of
            the motion, 0 (none) to 1 (it turns back, or stops).
        flicker: sum of the magnitudes of the signed events of steps, less that of their sum.
        along, across, along_twice, across_twice: sums of squared first and second derivatives of moving pictures.
    """

    linear: float = 0.0
    divided: float = 0.0
    moving: float = 0.0
    beside: float = 0.0
    travelled: float = 0.0
    paired: float = 0.0
    unsteady: float = 0.0
    flicker: float = 0.0
    along: float = 0.0
    across: float = 0.0
    along_twice: float = 0.0
    across_twice: float = 0.0

    def __add__(self, other: Prediction) -> Prediction:
        return Prediction(*map(sum, zip(astuple(self), astuple(other), strict=True)))

    @property
    def px_per_frame(self) -> float:
        """Return the geometric mean of the motion of what moves; 0 where nothing does."""
        return math.exp(self.travelled / self.moving) if self.moving else 0.0

    @property
    def features(self) -> Features:
        """Return what the loss depends on."""
        ways = self.along * self.across_twice, self.across * self.along_twice
        smear = math.log(ways[0]) - math.log(ways[1]) if min(ways) > 0.0 else 0.0
        moves = self.moving / max(self.divided, 1.0)  # few cells of a still clip "move", by noise
        return Features(
            max(1.0 - self.linear / self.divided, 0.0) if self.divided else 0.0,
            moves * min(max(smear - _SHARP, 0.0) / (_SMEARED - _SHARP), 1.0) * math.log1p(self.px_per_frame),
            moves * max(self.unsteady / max(self.paired, 1.0) - _STEADY, 0.0),
            self.flicker / max(self.linear, 1.0),
            self.beside / max(self.divided, 1.0),
        )

    @property
    def is_slow(self) -> bool:
        """Return whether sub-steps change so little, and nothing else shows, that no loss is predicted."""
        return self.features.gain < _SLIGHT_LOSS and self.loss().likely < 2.0 * _SLIGHT_LOSS

    @property
    def can_be_followed(self) -> bool:
        """Return whether the motion is steady enough, and the light, that sub-steps help."""
        return self.features.unsteady < _UNSTEADY and self.features.flicker < _FLICKERS

    @property
    def uncovers(self) -> bool:
        """Return whether something moves over a still picture, where sub-steps make false events."""
        return self.features.uncovered > _UNCOVERS

    def loss(self, *, divided: bool = False) -> PredictedLoss:
        """Return the predicted loss in bins of a frame.

        Args:
            divided: with sub-steps of SUBSTEP_PX.
        """
        kept = self.linear / self.divided if self.divided and not divided else 1.0
        hidden = [sum(map(operator.mul, weights, self.features)) + start for start, weights in _WEIGHTS]
        return PredictedLoss(*(min(max(1.0 - kept * math.exp(-each), 0.0), 1.0) for each in hidden))


def predict(pictures: FrameArray) -> Prediction:
    """Predict the loss of a clip.

    Memory: about 6 bytes a pixel for each frame and each level between frames, at most 16 a frame.

    Args:
        pictures: [n, h, w] uint8, n >= 2 consecutive frames as a camera sees them; of more than _MOST_FRAMES those in
            the middle are used.
    """
    first_used = max(0, (len(pictures) - _MOST_FRAMES) // 2)
    pictures = pictures[first_used : first_used + _MOST_FRAMES]
    count, height, width = pictures.shape
    vectors = motions(pictures)
    levels = levels_between(pictures, (0, 0, height, width), np.arange(count), SUBSTEP_PX, vectors)
    fine = pictures.astype(np.uint16) * np.uint16(FINE_STEPS)
    alone = _signed_counts(fine)
    net = alone.sum(axis=(1, 2), dtype=np.int64)
    linear, flicker = float(np.abs(alone).sum()), float(np.abs(net).sum() - abs(net.sum()))
    if levels is None:
        return Prediction(linear, linear, flicker=flicker)
    along = np.abs(_signed_counts(np.insert(fine, levels.at.step + 1, levels.grey, axis=0)))
    first = np.arange(count - 1) + np.searchsorted(levels.at.step, np.arange(count - 1))
    # Without the dtype NumPy makes a copy in int64.
    events = _by_cell(np.add, np.add.reduceat(along, first, dtype=np.int16))
    moved = vectors[1:] / UNITS_PER_PX
    moved *= np.hypot(moved[:, :1], moved[:, 1:]) >= SUBSTEP_PX / 2
    speed = np.hypot(moved[:, 0], moved[:, 1])
    moves = speed > 0.0
    changed = _by_cell(np.add, cv2.absdiff(pictures[1:], pictures[:-1])) / CELL_PX**2
    ranges = _by_cell(np.maximum, pictures[1:]) - _by_cell(np.minimum, pictures[1:])
    rests = ~moves & (changed < _STILL_GREY) & (ranges > _TEXTURE_GREY)
    beside = np.stack([cv2.dilate(each, np.ones((3, 3), np.uint8)) for each in rests.astype(np.uint8)]) > 0
    kept = moves.any(axis=(1, 2))  # a repeated frame is no change of the motion
    turned = np.hypot(*np.moveaxis(np.diff(moved[kept], axis=0), 1, 0))
    both, weight = (each[kept][1:] + each[kept][:-1] for each in (speed, events))
    weight = weight * (both > 0.0)
    return Prediction(
        linear,
        float(events.sum()),
        float(events[moves].sum()),
        float(events[moves & beside].sum()),
        float((events[moves] * np.log(speed[moves])).sum()),
        float(weight.sum()),
        float((weight * turned / np.maximum(both, 1e-9)).sum()),
        flicker,
        *np.sum([_sharpness(*each) for each in zip(pictures, moved, strict=False)], axis=0).tolist(),
    )


def _by_cell(of: np.ufunc, values: npt.NDArray[np.generic]) -> npt.NDArray[np.float64]:
    """Return the values of the pixels of each cell, [n, rows, columns], brought together by a function."""
    rows, columns = (np.arange(0, side, CELL_PX) for side in values.shape[1:])
    together: npt.NDArray[np.float64] = of.reduceat(of.reduceat(values, rows, axis=1), columns, axis=2, dtype=float)
    return together


def _sharpness(picture: npt.NDArray[np.uint8], moved: npt.NDArray[np.float64]) -> list[float]:
    """Return the sums of squared first derivatives along and across the motion [2, rows, columns], and of second ones.

    Only where something moves.
    """
    height, width = picture.shape
    x, y = (np.kron(each, np.ones((CELL_PX, CELL_PX)))[:height, :width] for each in moved)
    speed = np.hypot(x, y)
    x, y = (np.divide(each, speed, out=np.zeros_like(speed), where=speed > 0.0) for each in (x, y))
    right, down = (cv2.Sobel(picture, cv2.CV_32F, *axes, ksize=1) / 2 for axes in ((1, 0), (0, 1)))
    right2, down2 = (cv2.Sobel(picture, cv2.CV_32F, *axes, ksize=1) for axes in ((2, 0), (0, 2)))
    mixed = cv2.Sobel(right, cv2.CV_32F, 0, 1, ksize=1) / 2
    ways = ((x, y), (-y, x))
    found = [a * right + b * down for a, b in ways]
    found += [a * a * right2 + 2 * a * b * mixed + b * b * down2 for a, b in ways]
    return [float(np.square(each).sum()) for each in found]


def _signed_counts(fine: npt.NDArray[np.uint16]) -> npt.NDArray[np.int16]:
    """Return the events between grey levels in 1/FINE_STEPS: [n - 1, h, w], signed.

    In NumPy, since the kernel that would do it takes longer to compile than all of these clips take.
    """
    table = fine_table(log_table(_GAMMA, _LOG_EPS))
    counts = np.empty((len(fine) - 1, *fine.shape[1:]), np.int16)
    residual = np.zeros(fine.shape[1:], np.float32)
    for (before, after), fired in zip(pairwise(fine), counts, strict=True):
        residual += table[after] - table[before]
        fired[...] = np.trunc(residual / THRESHOLD)
        residual -= fired * np.float32(THRESHOLD)
    return counts
