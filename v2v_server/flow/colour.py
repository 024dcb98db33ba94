"""Flow as colour: direction is hue, length is saturation.

The colour wheel of the Middlebury pages (Baker et al., "A Database and Evaluation Methodology for Optical Flow", IJCV
2011).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""[h, w, 3] uint8, BGR."""

_STEPS = (
    ("red", "yellow", 15), ("yellow", "green", 6), ("green", "cyan", 4),
    ("cyan", "blue", 11), ("blue", "magenta", 13), ("magenta", "red", 6),
)  # fmt: skip
_CORNERS = {
    "red": (0, 0, 255), "yellow": (0, 255, 255), "green": (0, 255, 0),
    "cyan": (255, 255, 0), "blue": (255, 0, 0), "magenta": (255, 0, 255),
}  # fmt: skip
"""BGR. More steps stand where the eye tells more hues apart."""
_BEYOND = 0.75
"""Flow longer than the largest is shown darker by this."""


def _wheel() -> npt.NDArray[np.float64]:
    parts = [np.linspace(_CORNERS[start], _CORNERS[end], steps, endpoint=False) for start, end, steps in _STEPS]
    return np.concatenate(parts)


def draw_flow(flow: npt.NDArray[np.floating], largest_px: float | None = None) -> Image:
    """A field as a picture: white does not move, red moves right, yellow down, blue-cyan left, violet up.

    Args:
        flow: [2, H, W], (x, y), px.
        largest_px: the length that gets full colour; None: the field's own largest, at least 1 px.

    Returns:
        [H, W, 3] uint8, BGR.
    """
    x, y = flow.astype(np.float64)
    length = np.hypot(x, y)
    full = max(1.0, float(length.max(initial=0.0))) if largest_px is None else largest_px
    share = (length / full)[..., None]
    wheel = _wheel()
    at = (np.arctan2(y, x) / (2 * math.pi) % 1.0) * len(wheel)
    below = at.astype(int) % len(wheel)
    part = (at - np.floor(at))[..., None]
    hue = (1 - part) * wheel[below] + part * wheel[(below + 1) % len(wheel)]
    colour = np.where(share <= 1.0, 255.0 - share * (255.0 - hue), _BEYOND * hue)
    image: Image = np.rint(colour).astype(np.uint8)
    return image


def draw_wheel(radius_px: int = 64) -> Image:
    """The legend: each pixel has the colour of the flow that leads to it from the centre; outside it is white.

    Returns:
        [2 r + 1, 2 r + 1, 3] uint8, BGR.
    """
    axis = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    field = np.stack(np.meshgrid(axis, axis))
    image = draw_flow(field, float(radius_px))
    image[np.hypot(*field) > radius_px] = 255
    return image
