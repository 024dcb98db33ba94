"""Flow estimators by name, and the choice among them.

All of them are zero or dense inverse search (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016)
by OpenCV: patches are matched from coarse to fine down to a finest scale, whose field is then enlarged. Scale 2 is a
quarter of the picture's size; scale 1 takes two to three times as long and resolves motion that scale 2 blurs.

``auto`` chooses for each pair of pictures by a quick estimate of the motion:

- Still: no block of 8 x 8 pixels changes its mean by more than 1.5 grey levels. A coder's noise averages out in a
  block, a moving edge does not. The flow is zero.
- Slow: 95 % of the picture moves less than half a pixel. Dense inverse search without refinement is then as accurate as
  with it, in half the time.
- Otherwise with refinement. Of the methods whose median error on pans and zooms is below a quarter of a pixel it is the
  cheapest that also works on frames with little texture (docs/flow.md).

The quick estimate takes about a third of the time of the costliest choice: dense inverse search on the picture at a
quarter of its size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_server.system.compile_cache import cv2

GreyPicture = npt.NDArray[np.uint8]
"""[h, w] uint8, C-contiguous."""
Field = npt.NDArray[np.float32]
"""[h, w, 2] float32, (x, y), px."""
Estimator = Callable[[GreyPicture, GreyPicture], Field]
"""estimate(A, B): the field on the grid of A that leads to B. The result does not depend on earlier calls. It holds
buffers, so each thread needs its own."""

DIS_ULTRAFAST, DIS_FAST, DIS_MEDIUM = range(3)
"""OpenCV's numbers, DISOPTICAL_FLOW_PRESET_*; using its names would import it."""
_SMALLEST_SIDE_PX = 64
"""OpenCV refuses pictures below 12 pixels, and reads outside its buffers on some larger ones: 16x300, 24x600."""

AUTO, STILL_METHOD, SLOW_METHOD, MOVING_METHOD = "auto", "zero", "dis-ultrafast", "dis-fast"
_BLOCK_PX = 8
STILL_GREY_LEVELS = 1.5
_SHRINK = 4
SLOW_PX = 0.5
_MOST_OF_THE_PICTURE = 0.95


def zero() -> Estimator:
    """Return an estimator that always gives zero flow."""
    return lambda first, second: np.zeros((*first.shape, 2), np.float32)


def dis(preset: int, finest_scale: int, refinements: int | None = None) -> Estimator:
    """Return a guarded estimator: dense inverse search with a preset's number of iterations and patch stride.

    Args:
        preset: DIS_ULTRAFAST, DIS_FAST or DIS_MEDIUM.
        finest_scale: the pyramid level that matching ends at; 0 is the full picture.
        refinements: iterations of the variational refinement; None: the preset's, 5 (ultrafast: 0).
    """
    search = cv2.DISOpticalFlow.create(preset)
    if refinements is not None:
        search.setVariationalRefinementIterations(refinements)

    def estimate(first: GreyPicture, second: GreyPicture) -> Field:
        # A small picture makes OpenCV lower the finest scale, also for the pictures that follow.
        search.setFinestScale(finest_scale)
        field: Field = search.calc(first, second, None)  # type: ignore[call-overload]
        return field

    return guarded(estimate, _SMALLEST_SIDE_PX)


METHODS: Mapping[str, Callable[[], Estimator]] = MappingProxyType(
    {
        STILL_METHOD: zero,
        SLOW_METHOD: partial(dis, DIS_ULTRAFAST, 2),
        MOVING_METHOD: partial(dis, DIS_FAST, 2),
        "dis-fast-lean": partial(dis, DIS_FAST, 2, 3),
        "dis-fast-1": partial(dis, DIS_FAST, 1),
    }
)
"""Constructors of the estimators. "lean" refines three times, not five; "1" is the finest scale."""


def estimator(name: str) -> Estimator:
    """Return a new estimator of that method.

    Raises:
        UsageError: there is no such method; the message lists them.
    """
    if name not in METHODS:
        raise UsageError(f"flow method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[name]()


def choose(first: GreyPicture, second: GreyPicture) -> str:
    """Return the method that "auto" uses for a pair of [h, w] uint8 pictures."""
    change = cv2.subtract(first, second, dtype=cv2.CV_32F)
    if float(np.abs(_shrunk(change, _BLOCK_PX)).max()) <= STILL_GREY_LEVELS:
        return STILL_METHOD
    field = dis(DIS_ULTRAFAST, 1)(_shrunk(first, _SHRINK), _shrunk(second, _SHRINK))
    pace = np.quantile(np.hypot(field[..., 0], field[..., 1]), _MOST_OF_THE_PICTURE) * _SHRINK
    return SLOW_METHOD if pace < SLOW_PX else MOVING_METHOD


def _shrunk(picture: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    height, width = picture.shape
    size = (max(1, width // factor), max(1, height // factor))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def guarded(estimate: Estimator, smallest_side_px: int) -> Estimator:
    """Return a safe form of an estimator.

    Equal pictures have exactly zero flow, whatever the method returns. A picture with a side below ``smallest_side_px``
    is enlarged by repeating its border: methods fail on smaller ones, some with a segmentation fault.
    """

    def safe(first: GreyPicture, second: GreyPicture) -> Field:
        height, width = first.shape
        if np.array_equal(first, second):
            return np.zeros((height, width, 2), np.float32)
        below, right = max(0, smallest_side_px - height), max(0, smallest_side_px - width)
        if below or right:
            first, second = (
                cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE).astype(np.uint8, copy=False)
                for picture in (first, second)
            )
        return estimate(first, second)[:height, :width]

    return safe


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit OpenCV to one thread: a server worker uses one core, and dividing a picture among threads must not change a
    result.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
