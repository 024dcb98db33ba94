"""The choice of a method for a pair of pictures by a cheap look at how much moves.

- Still: no block of 8 x 8 pixels changes its mean by more than 1.5 grey levels. A coder's noise averages out in a
  block, a moving edge does not. The flow is zero.
- Slow: 95 % of the picture moves less than half a pixel. Dense inverse search without refinement is then as good as
  with it, at half the time.
- Otherwise with refinement. Of the methods whose median error on pans and zooms is below a quarter of a pixel it is the
  cheapest that also holds on frames of little texture (docs/flow.md).

The look takes about a third of the time of the costliest choice: dense inverse search on the picture at a quarter of
its size.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.flow import dis
from v2v_server.flow.estimator import Picture, guarded
from v2v_server.system.opencv import cv2

STILL = "zero"
SLOW = "dis-ultrafast"
MOVING = "dis-fast"

_BLOCK_PX = 8
STILL_GREY_LEVELS = 1.5
_SHRINK = 4
SLOW_PX = 0.5
_MOST_OF_THE_PICTURE = 0.95


def choose(first: Picture, second: Picture) -> str:
    """The name of the method for a pair of [h, w] uint8 pictures."""
    change = cv2.subtract(first, second, dtype=cv2.CV_32F)
    if float(np.abs(_shrunk(change, _BLOCK_PX)).max()) <= STILL_GREY_LEVELS:
        return STILL
    look = guarded(dis.dis(dis.ULTRAFAST, 1), dis.SMALLEST_SIDE_PX)
    field = look(_shrunk(first, _SHRINK), _shrunk(second, _SHRINK))
    pace = np.quantile(np.hypot(field[..., 0], field[..., 1]), _MOST_OF_THE_PICTURE) * _SHRINK
    return SLOW if pace < SLOW_PX else MOVING


def _shrunk(picture: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    height, width = picture.shape
    size = (max(1, width // factor), max(1, height // factor))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
