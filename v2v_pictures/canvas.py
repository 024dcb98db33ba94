"""A page to draw on: text, panels with a border, bars, arrows, hatching; and event counts, grey pictures and flow as
colour.

Positions on a page are px from the top left corner. Red and blue are told apart by all common kinds of colour
blindness, and by a projector that shows little contrast.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache

import numpy as np
import numpy.typing as npt
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont

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
        counts: signed event counts, any shapes.
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
    image: Image = np.rint(255.0 + share * (colour - 255.0)).astype(np.uint8)
    return image


def draw_grey(picture: npt.NDArray[np.generic]) -> Image:
    """Draw [H, W] uint8, or floating point in 0 .. 1 (clipped), as RGB [H, W, 3]."""
    if picture.dtype != np.uint8:
        picture = np.rint(np.clip(picture.astype(np.float32), 0, 1) * 255).astype(np.uint8)
    image: Image = np.repeat(picture.astype(np.uint8)[..., None], 3, axis=-1)
    return image


_STEPS = (
    ("red", "yellow", 15), ("yellow", "green", 6), ("green", "cyan", 4),
    ("cyan", "blue", 11), ("blue", "magenta", 13), ("magenta", "red", 6),
)  # fmt: skip
_CORNERS = {
    "red": (255, 0, 0), "yellow": (255, 255, 0), "green": (0, 255, 0),
    "cyan": (0, 255, 255), "blue": (0, 0, 255), "magenta": (255, 0, 255),
}  # fmt: skip
"""More steps stand where the eye tells more hues apart."""
_BEYOND = 0.75
"""Flow longer than the largest is shown darker by this."""


def _wheel() -> npt.NDArray[np.float64]:
    parts = [np.linspace(_CORNERS[start], _CORNERS[end], steps, endpoint=False) for start, end, steps in _STEPS]
    return np.concatenate(parts)


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
    wheel = _wheel()
    at = (np.arctan2(y, x) / (2 * math.pi) % 1.0) * len(wheel)
    below = at.astype(int) % len(wheel)
    part = (at - np.floor(at))[..., None]
    hue = (1 - part) * wheel[below] + part * wheel[(below + 1) % len(wheel)]
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


Rgb = tuple[int, int, int]

PAPER: Rgb = (255, 255, 255)
INK: Rgb = (28, 30, 34)
SOFT: Rgb = (104, 108, 116)
LINE: Rgb = (186, 190, 198)
SHADE: Rgb = (241, 242, 245)
MARK: Rgb = (173, 96, 0)
"""Orange as dark as a projector needs: 4.7 times less light than paper."""
PAUSED_INK: Rgb = (196, 199, 207)

TITLE_PT, HEADING_PT, TEXT_PT = 26, 20, 16
PAGE_MARGIN_PX, GAP_PX = 28, 8


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)  # ships with Pillow: pages look the same on every host


class Canvas:
    """A white page."""

    def __init__(self, width_px: int, height_px: int) -> None:
        self.width_px, self.height_px = width_px, height_px
        self._page = Pictures.new("RGB", (width_px, height_px), PAPER)
        self._draw = ImageDraw.Draw(self._page)

    def text(
        self, x: float, y: float, text: str, *, size: int = TEXT_PT, colour: Rgb = INK, anchor: str = "la"
    ) -> float:
        """Write one line and return where it ends. ``anchor`` is Pillow's: "la" left top, "ma" middle top, "ra"."""
        self._draw.text((x, y), text, fill=colour, font=_font(size), anchor=anchor)
        return x + text_width(text, size)

    def title(self, x: float, y: float, text: str) -> None:
        """Write the page's title as large as fits, or only its end if no size fits."""
        width = self.width_px - 2 * x
        size = next((size for size in range(TITLE_PT, TEXT_PT, -1) if text_width(text, size) <= width), TEXT_PT)
        self.text(x, y, shortened(text, width, size), size=size)

    def panel(self, x: int, y: int, image: Image, width_px: int, height_px: int) -> None:
        """Draw a picture with a thin border, scaled to fit the given size; shade what it does not cover."""
        height, width = image.shape[:2]
        scale = min(width_px / width, height_px / height)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        whole = max(1, math.ceil(scale))
        # Enlarged by a whole factor first, so that every pixel gets the same area whatever the scale.
        enlarged = np.ascontiguousarray(image.repeat(whole, axis=0).repeat(whole, axis=1))
        scaled = Pictures.fromarray(enlarged).resize(size, Pictures.Resampling.BOX)
        self.box(x, y, x + width_px, y + height_px, SHADE)
        self._page.paste(scaled, (x + (width_px - size[0]) // 2, y + (height_px - size[1]) // 2))
        self._draw.rectangle((x - 1, y - 1, x + width_px, y + height_px), outline=LINE)

    def box(self, left: float, top: float, right: float, bottom: float, colour: Rgb) -> None:
        """Fill a rectangle, without its right column and bottom row; draw nothing below one whole pixel."""
        left, top, right, bottom = map(round, (left, top, right, bottom))
        if right > left and bottom > top:
            self._draw.rectangle((left, top, right - 1, bottom - 1), fill=colour)

    def frame(
        self, left: float, top: float, right: float, bottom: float, colour: Rgb = LINE, width_px: int = 1
    ) -> None:
        """Draw a rectangle's outline."""
        self._draw.rectangle(tuple(map(round, (left, top, right, bottom))), outline=colour, width=width_px)

    def line(self, x0: float, y0: float, x1: float, y1: float, colour: Rgb = LINE, width_px: int = 1) -> None:
        """Draw a straight line."""
        self._draw.line((x0, y0, x1, y1), fill=colour, width=width_px)

    def arrow(self, x0: float, y: float, x1: float, colour: Rgb = SOFT) -> None:
        """Draw a horizontal arrow to the right."""
        self._draw.line((x0, y, x1 - 8, y), fill=colour, width=2)
        self._draw.polygon(((x1, y), (x1 - 11, y - 5), (x1 - 11, y + 5)), fill=colour)

    def vector(self, x: float, y: float, along_x: float, along_y: float) -> None:
        """Draw an arrow from (x, y), dark with a light rim, so that it stands out from any colour."""
        length = math.hypot(along_x, along_y)
        tip = (x + along_x, y + along_y)
        back_x, back_y = along_x / length, along_y / length
        head = min(6.0, 0.6 * length)
        sides = [
            (tip[0] - head * (back_x + sign * 0.6 * back_y), tip[1] - head * (back_y - sign * 0.6 * back_x))
            for sign in (1, -1)
        ]
        for colour, width in ((PAPER, 4), (INK, 2)):
            self._draw.line((x, y, *tip), fill=colour, width=width)
            self._draw.line((*sides[0], *tip, *sides[1]), fill=colour, width=width)

    def hatch(self, left: float, top: float, right: float, bottom: float) -> None:
        """Draw the sign of a paused camera: slanted lines on a shade."""
        if right - left < 1:
            return
        self.box(left, top, right, bottom, SHADE)
        height = round(bottom - top)
        stripes = Pictures.new("RGB", (max(1, round(right - left)), height), SHADE)
        pen = ImageDraw.Draw(stripes)
        for start in range(-height, stripes.width, 7):
            pen.line((start, height, start + height, 0), fill=PAUSED_INK, width=2)
        self._page.paste(stripes, (round(left), round(top)))

    def image(self) -> Image:
        """Return the page: [height, width, 3] uint8 RGB."""
        return np.asarray(self._page, np.uint8).copy()


def text_width(text: str, size: int = TEXT_PT) -> float:
    """Return the width of a line of text, px."""
    return float(_font(size).getlength(text))


def shortened(text: str, width_px: float, size: int = TEXT_PT) -> str:
    """Return the text, or as much of its end as fits behind three dots."""
    if text_width(text, size) <= width_px:
        return text
    while text and text_width("..." + text, size) > width_px:
        text = text[1:]
    return "..." + text


def beginning(text: str, width_px: float, size: int = TEXT_PT) -> str:
    """Return the text, or as much of its beginning as fits before three dots."""
    if text_width(text, size) <= width_px:
        return text
    while text and text_width(text + "...", size) > width_px:
        text = text[:-1]
    return text + "..."


def label(page: Canvas, x: int, y: int, text: str, colour: Rgb = INK) -> None:
    """Write text on a ground of its own, so that the panel below does not hide it."""
    page.box(x, y, x + text_width(text) + 10, y + 24, PAPER)
    page.text(x + 5, y + 2, text, colour=colour)
