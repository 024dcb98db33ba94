"""A camera's activity over its whole clip, as a strip: brighter events up, darker down, noise pale, pauses hatched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import Canvas, Rgb
from v2v_pictures.colours import BRIGHTER, DARKER

LABEL_PX, TICKS_PX = 22, 24
"""Above and below the strip."""
_HATCH_PX = 7
_PALE = 0.6
"""How much of the way to white the bars of noise are."""


def draw_strip(
    page: Canvas,
    camera: Camera,
    left: int,
    top: int,
    width: int,
    height: int,
    highest: float,
    picks: Sequence[int] = (),
    cursor: int | None = None,
) -> None:
    """Draw the strip, with LABEL_PX of text above it and TICKS_PX below it.

    Args:
        left, top, width, height: of the strip itself, px.
        highest: events a pixel and bin of a full bar, which reaches from the middle to the edge; above 0, written above
            the strip. Higher rates are cut there. One value for all strips of a page makes them comparable. A bar's
            length is the square root of its share, so that a quiet camera still shows when it fires.
        picks: voxel grids to point at.
        cursor: a bin to draw a line at, for films.
    """
    rates, middle = camera.rates, top + height / 2
    x = page.text(left, top - LABEL_PX, f"events over {camera.timing or 'the whole clip'}")
    page.text(x + 12, top - LABEL_PX, f"full bar: {highest:.2g} or more a pixel and bin", colour=canvas.SOFT)
    count = rates.shape[1]
    at = [left + width * number / count for number in range(count + 1)]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], camera.paused, [False]])))
    pauses = [(at[start], at[end]) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    for start, end in pauses:
        page.hatch(start, top, end, top + height)
    moving = np.where(camera.paused, 0.0, rates if camera.quiet is None else np.minimum(camera.quiet, rates))
    for bars, brighter, darker in ((rates, _pale(BRIGHTER), _pale(DARKER)), (moving, BRIGHTER, DARKER)):
        for number, (up, down) in enumerate(np.sqrt(np.minimum(bars / highest, 1.0)).T * (height / 2)):
            page.box(at[number], middle - up, at[number + 1], middle, brighter)
            page.box(at[number], middle, at[number + 1], middle + down, darker)
    for start, end in pauses:  # seen behind full bars too
        page.hatch(start, top, end, top + _HATCH_PX)
        page.hatch(start, top + height - _HATCH_PX, end, top + height)
    page.line(left, middle, left + width, middle, canvas.LINE)
    page.frame(left, top, left + width, top + height)
    for start, end in pauses:
        if end - start > canvas.text_width("paused") + 8:
            centre, half = (start + end) / 2, canvas.text_width("paused") / 2 + 4
            page.box(centre - half, middle - 10, centre + half, middle + 11, canvas.PAPER)
            page.text(centre, middle, "paused", anchor="mm")
    bins = camera.voxels.shape[1]
    for pick in picks:
        page.frame(at[pick * bins], top, at[(pick + 1) * bins], top + height, canvas.MARK, 2)
    if cursor is not None:
        page.line(at[cursor], top - 3, at[cursor], top + height + 3, canvas.MARK, 3)
        picks = [cursor // bins]
    _ticks(page, len(camera.voxels), left, width, top + height + 4, picks)


def _ticks(page: Canvas, grids: int, left: int, width: int, top: int, picks: Sequence[int]) -> None:
    """Write the number of each pick below it, and those of the first and last grid where they fit."""
    free_from, free_to = float(left), float(left + width)
    for place, pick in enumerate(picks):
        text = f"{pick + 1}" if len(picks) > 1 else f"voxel grid {pick + 1}"
        half = canvas.text_width(text) / 2
        centre = min(max(left + width * (pick + 0.5) / grids, left + half), left + width - half)
        if place == 0:
            free_to = centre - half - 12
        if place == 0 or centre - half > free_from:
            page.text(centre, top, text, colour=canvas.MARK, anchor="ma")
            free_from = centre + half + 12
    if left + canvas.text_width("voxel grid 1") < free_to or not picks:
        page.text(left, top, "voxel grid 1", colour=canvas.SOFT)
    if left + width - canvas.text_width(str(grids)) > free_from:
        page.text(left + width, top, str(grids), colour=canvas.SOFT, anchor="ra")


def _pale(colour: Rgb) -> Rgb:
    red, green, blue = (round(part + _PALE * (255 - part)) for part in colour)
    return red, green, blue
