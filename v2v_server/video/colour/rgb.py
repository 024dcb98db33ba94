"""Red, green and blue from full-range grey and colour differences.

    red = grey + 2 (1 - Kr) Cr,  blue = grey + 2 (1 - Kb) Cb,  green from grey = Kr red + Kg green + Kb blue

A picture without colour has red = green = blue = grey, the levels that are simulated.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

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
    red, green, blue = _differences(matrix, contrast)
    both = chroma[0].astype(np.uint16) << 8 | chroma[1]
    for channel, difference in enumerate((red[chroma[1]], green[both], blue[chroma[0]])):
        np.clip(difference + grey, 0, 255, out=out[channel], casting="unsafe")


@lru_cache(maxsize=16)
def _differences(matrix: str, contrast: float) -> tuple[npt.NDArray[np.int16], ...]:
    """Return what is added to grey: [256] by Cr, [65536] by Cb and Cr, [256] by Cb, rounded half up."""
    (kr, kb), values = _MATRICES[matrix], contrast * np.arange(-128.0, 128.0)
    red, blue = 2 * (1 - kr) * values, 2 * (1 - kb) * values
    green = -(kb * blue[:, None] + kr * red) / (1 - kr - kb)
    return tuple(np.floor(each.ravel() + 0.5).astype(np.int16) for each in (red, green, blue))
