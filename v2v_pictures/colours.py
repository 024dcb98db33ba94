"""Event counts, grey pictures and flow as colour. Every function returns RGB.

Red and blue are told apart by all common kinds of colour blindness, and by a projector that shows little contrast.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""[h, w, 3] uint8, RGB."""

BRIGHTER = (202, 0, 32)
DARKER = (5, 93, 176)

_QUANTILE = 0.98
_PALEST = 0.35
"""Share of full colour that the smallest count has."""


def full_colour(counts: Iterable[npt.NDArray[np.generic]]) -> float:
    """Return the count that gets full colour: the 98th percentile of all non-zero counts, at least 1.

    A percentile keeps one hot pixel from making everything else pale. One scale for a page makes its panels comparable.

    Args:
        counts: arrays [...] of signed event counts, of any shapes.
    """
    there = [np.abs(each[each != 0], dtype=np.float32) for each in map(np.asarray, counts) if np.any(each)]
    return max(1.0, float(np.quantile(np.concatenate(there), _QUANTILE))) if there else 1.0


def draw_events(counts: npt.NDArray[np.generic], full: float) -> Image:
    """Draw signed counts as colour: white is none, red brighter, blue darker.

    Args:
        counts: [H, W], signed event counts.
        full: the count that gets full colour, see :func:`full_colour`.

    Returns:
        [H, W, 3] uint8. Any event stands out from the white, whatever the scale; the square root of the share spreads
        the small counts.
    """
    size = np.abs(counts, dtype=np.float32)
    root = np.sqrt(np.clip(size / full, 0.0, 1.0))
    share = np.where(size > 0, _PALEST + (1 - _PALEST) * root, 0)[..., None]
    brighter, darker = np.array(BRIGHTER, np.float32), np.array(DARKER, np.float32)
    colour = np.where((np.asarray(counts) > 0)[..., None], brighter, darker)
    return np.rint(255.0 + share * (colour - 255.0)).astype(np.uint8)


def draw_grey(picture: npt.NDArray[np.generic]) -> Image:
    """Draw [H, W] uint8, or floating point in 0 .. 1 (clipped), as RGB [H, W, 3]."""
    if picture.dtype != np.uint8:
        picture = np.rint(np.clip(picture.astype(np.float32), 0, 1) * 255).astype(np.uint8)
    return np.repeat(picture.astype(np.uint8)[..., None], 3, axis=-1)


_STEPS = (
    ("red", "yellow", 15), ("yellow", "green", 6), ("green", "cyan", 4),
    ("cyan", "blue", 11), ("blue", "magenta", 13), ("magenta", "red", 6),
)  # fmt: skip
_CORNERS = {
    "red": (255, 0, 0), "yellow": (255, 255, 0), "green": (0, 255, 0),
    "cyan": (0, 255, 255), "blue": (0, 0, 255), "magenta": (255, 0, 255),
}  # fmt: skip
"""More steps stand where the eye tells more hues apart."""
_WHEEL = np.concatenate(
    [np.linspace(_CORNERS[start], _CORNERS[end], steps, endpoint=False) for start, end, steps in _STEPS]
)
"""Hues of the directions, [N, 3] RGB."""
_BEYOND = 0.75
"""Flow longer than the largest is shown darker by this."""


def draw_flow(flow: npt.NDArray[np.generic], largest_px: float | None = None) -> Image:
    """Draw a flow field: white does not move, red moves right, yellow down, blue-cyan left, violet up.

    The colour wheel of the Middlebury pages (Baker et al., "A Database and Evaluation Methodology for Optical Flow",
    IJCV 2011).

    Args:
        flow: [2, H, W], (x, y), px.
        largest_px: the length that gets full colour; None: the field's own largest, at least 1 px.

    Returns:
        [H, W, 3] uint8.
    """
    x, y = flow.astype(np.float64)
    length = np.hypot(x, y)
    full = max(1.0, float(length.max(initial=0.0))) if largest_px is None else largest_px
    share = (length / full)[..., None]
    at = (np.arctan2(y, x) / (2 * math.pi) % 1.0) * len(_WHEEL)
    below = at.astype(int) % len(_WHEEL)
    part = (at - np.floor(at))[..., None]
    hue = (1 - part) * _WHEEL[below] + part * _WHEEL[(below + 1) % len(_WHEEL)]
    colour = np.where(share <= 1.0, 255.0 - share * (255.0 - hue), _BEYOND * hue)
    image: Image = np.rint(colour).astype(np.uint8)
    return image


def draw_wheel(radius_px: int) -> Image:
    """Draw the legend of flow: each pixel has the colour of the flow from the centre to it; outside it is white.

    Returns:
        [2 r + 1, 2 r + 1, 3] uint8.
    """
    axis = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    field = np.stack(np.meshgrid(axis, axis))
    image = draw_flow(field, float(radius_px))
    image[np.hypot(*field) > radius_px] = 255
    return image
