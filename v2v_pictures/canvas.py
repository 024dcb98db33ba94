"""A page to draw on: text, panels with a border, bars, arrows, hatching. Positions are px from the top left corner."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont

from v2v_pictures.colours import Image

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

    def panel(self, x: int, y: int, image: Image, width_px: int, height_px: int) -> tuple[float, float, float]:
        """Draw a picture with a thin border, scaled to fit the given size; shade what it does not cover.

        Returns:
            left and top of the picture on the page, px, and its scale.
        """
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
        return x + (width_px - width * scale) / 2, y + (height_px - height * scale) / 2, scale

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


def fitted(picture: Image, width_px: float, height_px: float) -> tuple[int, int]:
    """Return width and height of a picture, [H, W] or [H, W, 3], that is scaled to fit a size, at least 1 px."""
    height, width = picture.shape[:2]
    scale = min(width_px / width, height_px / height)
    return max(1, round(width * scale)), max(1, round(height * scale))
