"""Predict the events that are lost between the frames of a clip, and those that sub-steps restore, from its frames.

Events are lost where the light of a pixel rises and falls again within a step. The levels along the motion show how
often it does: the events of the frames alone are compared with those of the frames and the levels, in bins of a frame.
The true errors, without and with sub-steps, are linear in these *apparent* errors (``FITS``). Only motion in px a frame
counts; the frame rate has no influence beyond it.

A prediction holds where the motion can be followed. As a check, each frame is predicted along the motion from its two
neighbours. Where that is hardly better than their mean, as with vibration and flicker, sub-steps restore little. Motion
blur hides losses from the prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.motion.clip import levels_between
from v2v_server.motion.matching import UNITS_PER_PX, Vectors, motion, without_slow
from v2v_server.motion.plane import motions
from v2v_server.motion.pyramid import Pyramid
from v2v_server.motion.warping import between
from v2v_server.simulation.intensity import fine_table, log_table
from v2v_server.simulation.view import FrameArray
from v2v_server.simulation.voxel import FINE_STEPS

SUBSTEP_PX, THRESHOLD = 1.0, 0.2
"""``substep_px`` and contrast threshold that predictions are for."""
_MOST_FRAMES = 33
"""Frames that a prediction is made from: a fraction of a second's work."""
_SHORTEST = math.ceil(SUBSTEP_PX * UNITS_PER_PX / 2)
_GAMMA, _LOG_EPS = 2.2, 1e-3
_LEAST_EXPLAINED = 0.25
_SLIGHT_LOSS = 0.05


class PredictedErrors(NamedTuple):
    """Shares of the events: lost, of signed bins that are wrong, of bins of both polarities that are wrong."""

    lost: float
    signed: float
    split: float


class Fit(NamedTuple):
    """A true error as a function of the apparent one: start + slope x apparent."""

    start: float
    slope: float


FITS = {
    "linear": (Fit(0.026, 1.088), Fit(0.085, 0.411), Fit(0.094, 0.922)),
    "divided": (Fit(0.020, 0.220), Fit(0.088, -0.279), Fit(0.104, 0.130)),
}
"""By setting, in the order of PredictedErrors: moving photographs, as printed by ``python -m bench substeps``."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a clip's frames say of the motion between them. Predictions of several clips can be added.

    Attributes:
        speeds_px: motion of each cell and step that moves, px a frame.
        linear, divided: events of the frames alone, and with the levels along the motion.
        net: sum of the magnitudes of the latter's signed bins.
        signed_apart, split_apart: sums of the differences between both, signed and of both polarities.
        along_apart, mean_apart: sums of the differences, in grey levels, between a frame and what its neighbours
            predict, along the motion and as their mean.
    """

    speeds_px: tuple[float, ...] = ()
    linear: float = 0.0
    divided: float = 0.0
    net: float = 0.0
    signed_apart: float = 0.0
    split_apart: float = 0.0
    along_apart: float = 0.0
    mean_apart: float = 0.0

    def __add__(self, other: Prediction) -> Prediction:
        return Prediction(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(Prediction)))

    @property
    def px_per_frame(self) -> float:
        """Return the median motion of what moves; 0 where nothing does."""
        return float(np.median(self.speeds_px)) if self.speeds_px else 0.0

    @property
    def explained(self) -> float:
        """Return the share of the change beyond the mean of both neighbours that the motion explains: 0 .. 1."""
        return max(0.0, 1.0 - self.along_apart / self.mean_apart) if self.mean_apart else 0.0

    @property
    def apparent(self) -> PredictedErrors:
        """Return the errors of the frames alone if the levels along the motion were true."""
        events, net = max(self.divided, 1.0), max(self.net, 1.0)
        return PredictedErrors(
            1.0 - self.linear / events if self.divided else 0.0, self.signed_apart / net, self.split_apart / events
        )

    @property
    def is_slow(self) -> bool:
        """Return whether sub-steps change so little that no loss is predicted."""
        return self.apparent.lost < _SLIGHT_LOSS

    @property
    def can_be_followed(self) -> bool:
        """Return whether the motion explains the change of the picture, so that the predicted errors hold."""
        return self.explained >= _LEAST_EXPLAINED

    def errors(self, setting: str) -> PredictedErrors:
        """Return the predicted errors in bins of a frame.

        Args:
            setting: "linear", without sub-steps, or "divided", with sub-steps of SUBSTEP_PX.
        """
        found = zip(FITS[setting], self.apparent, strict=True)
        return PredictedErrors(*(min(max(fit.start + fit.slope * share, 0.0), 1.0) for fit, share in found))


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
    if levels is None:
        events = float(np.abs(alone).sum())
        return Prediction((), events, events, events)
    along = _signed_counts(np.insert(fine, levels.at.step + 1, levels.grey, axis=0))
    first = np.arange(count - 1) + np.searchsorted(levels.at.step, np.arange(count - 1))
    # Without the dtype NumPy makes a copy in int64.
    rising = np.add.reduceat(np.maximum(along, 0), first, dtype=np.int16)
    falling = -np.add.reduceat(np.minimum(along, 0), first, dtype=np.int16)
    apart = [np.abs(np.maximum(sign * alone, 0) - true).sum() for sign, true in ((1, rising), (-1, falling))]
    moving = _moving(without_slow(vectors, _SHORTEST))
    guesses = [_guess(pictures[at - 1 : at + 2]) for at in range(1, count - 1)]
    return Prediction(
        tuple(moving.tolist()),
        float(np.abs(alone).sum()),
        float(rising.sum() + falling.sum()),
        float(np.abs(rising - falling).sum()),
        float(np.abs(alone - rising + falling).sum()),
        float(sum(apart)),
        *(float(sum(guess)) for guess in (zip(*guesses, strict=True) if guesses else ((), ()))),
    )


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


def _moving(vectors: Vectors) -> npt.NDArray[np.float64]:
    """Return the lengths, px, of the vectors that are not zero."""
    lengths: npt.NDArray[np.float64] = np.hypot(vectors[:, 0], vectors[:, 1], dtype=np.float64) / UNITS_PER_PX
    return lengths[lengths > 0.0]


def _guess(three: FrameArray) -> tuple[float, float]:
    """Return how far the middle of three pictures is from what the others predict: along the motion, and as a mean."""
    first, middle, last = three.astype(np.float64)
    if np.array_equal(first, middle) or np.array_equal(middle, last):  # a repeated frame is not halfway
        return 0.0, 0.0
    guess = np.empty((1, *middle.shape), np.uint16)
    before, after = (Pyramid.of(picture) for picture in (three[0], three[2]))
    between(before.levels[0], after.levels[0], motion(before, after), _SHORTEST, 0, 0, guess)
    return float(np.abs(guess[0] / FINE_STEPS - middle).sum()), float(np.abs((first + last) / 2 - middle).sum())
