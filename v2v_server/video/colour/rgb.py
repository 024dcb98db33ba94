"""Red, green and blue from full-range grey and colour differences.

    red = grey + 2 (1 - Kr) Cr,  blue = grey + 2 (1 - Kb) Cb,  green from grey = Kr red + Kg green + Kb blue

A picture without colour has red = green = blue = grey, the levels that are simulated.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from v2v_server.system.opencv import cv2

_MATRICES = {"BT.601": (0.299, 0.114), "BT.709": (0.2126, 0.0722), "BT.2020": (0.2627, 0.0593)}
"""Kr and Kb (ITU-T H.273)."""


def add_colour(
    grey: npt.NDArray[np.uint8], chroma: npt.NDArray[np.uint8], matrix: str, contrast: float, out: npt.NDArray[np.uint8]
) -> None:
    """Write red, green and blue of one picture.

    Args:
        grey: [H, W], full range.
        chroma: [2, H, W], Cb and Cr plus 128.
        matrix: see :class:`v2v_server.video.colour.chroma.Chroma`.
        contrast: factor of the colour differences, that of the grey levels.
        out: [3, H, W].
    """
    red, green_of_cb, green_of_cr, blue = _differences(matrix, contrast)
    cb, cr = chroma
    green = cv2.add(cv2.LUT(cb, green_of_cb), cv2.LUT(cr, green_of_cr))
    for channel, difference in enumerate((cv2.LUT(cr, red), green, cv2.LUT(cb, blue))):
        cv2.add(grey, difference, dst=out[channel], dtype=cv2.CV_8U)


@lru_cache(maxsize=16)
def _differences(matrix: str, contrast: float) -> tuple[npt.NDArray[np.int16], ...]:
    """Return what Cr adds to red, Cb and Cr add to green, and Cb adds to blue: [256] each, rounded half up."""
    (kr, kb), values = _MATRICES[matrix], contrast * np.arange(-128.0, 128.0)
    red, blue = 2 * (1 - kr) * values, 2 * (1 - kb) * values
    kg = 1 - kr - kb
    exact = red, -kb / kg * blue, -kr / kg * red, blue
    return tuple(np.floor(each + 0.5).astype(np.int16) for each in exact)
