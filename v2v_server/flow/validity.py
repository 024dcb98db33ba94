"""Where flow can be believed: the forward-backward check."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_server.flow.estimator import Field
from v2v_server.system.opencv import cv2

_SHARE = 0.01
_FLOOR_PX2 = 0.5


def consistent(field: Field, opposite: Field) -> npt.NDArray[np.bool_]:
    """Where following a field and then its opposite leads back to the start:

        |f(x) + g(x + f(x))|^2 < 0.01 (|f(x)|^2 + |g(x + f(x))|^2) + 0.5

    (Sundaram, Brox and Keutzer, "Dense Point Trajectories by GPU-Accelerated Large Displacement Optical Flow", ECCV
    2010, equation 5). It fails where a pixel is hidden in the other picture; one that leaves the picture is invalid
    too.

    Args:
        field: f, [h, w, 2] float32, px.
        opposite: g, on the grid of the other picture.

    Returns:
        [h, w] bool.
    """
    height, width = field.shape[:2]
    x = field[..., 0] + np.arange(width, dtype=np.float32)
    y = field[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    back = cv2.remap(opposite, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    gap = ((field + back) ** 2).sum(axis=-1)
    length = (field**2).sum(axis=-1) + (back**2).sum(axis=-1)
    agree: npt.NDArray[np.bool_] = inside & (gap < _SHARE * length + _FLOOR_PX2)
    return agree
