"""Draw boxes, masks and tracks over a panel."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import Canvas, Rgb
from v2v_pictures.colours import Image

_COLOURS: tuple[Rgb, ...] = (
    (0, 128, 70),
    (190, 110, 0),
    (120, 50, 170),
    (0, 130, 140),
    (120, 110, 0),
    (180, 0, 140),
)
"""Colours of the classes, in turn: none is the red or blue of events."""
_TINT = 0.45
_NO_OBJECT = (0, 255)
_TRAIL_FRAMES = 4
"""Frames before the shown one that the trail of a point goes through."""
_TEXT_PT = 12


def class_colour(category: int) -> Rgb:
    """Return the colour of a class."""
    return _COLOURS[category % len(_COLOURS)]


def tint(image: Image, mask: npt.NDArray[np.uint8]) -> Image:
    """Return a picture [H, W, 3] tinted by the classes of a mask [H, W]; classes 0 and 255 leave it as it is."""
    tinted = image.astype(np.float32)
    for category in np.unique(mask):
        if category not in _NO_OBJECT:
            place = mask == category
            tinted[place] += _TINT * (np.array(class_colour(int(category)), np.float32) - tinted[place])
    result: Image = np.rint(tinted).astype(np.uint8)
    return result


def labelled_panel(
    page: Canvas, camera: Camera, grid: int, x: int, y: int, image: Image, tile_px: int, *, with_text: bool = False
) -> None:
    """Draw a panel with the boxes, the mask and the tracks of one voxel grid's frame.

    Args:
        camera: has the labels; without any, this is only the panel.
        grid: number of the voxel grid.
        x, y, tile_px: place and side of the panel, px.
        image: [H, W, 3], as large as the camera's frames.
        with_text: write the class of each box, and draw the tracks.
    """
    if camera.masks is not None:
        image = tint(image, camera.masks[grid])
    page.panel(x, y, image, tile_px, tile_px)
    height, width = image.shape[:2]
    scale = min(tile_px / width, tile_px / height)
    left, top = x + (tile_px - width * scale) / 2, y + (tile_px - height * scale) / 2
    if camera.tracks is not None and with_text:
        recent = camera.tracks[max(0, grid - _TRAIL_FRAMES) : grid + 1] * (scale, scale, 1) + (left, top, 0)
        for number in np.flatnonzero(recent[-1, :, 2]):
            colour = class_colour(int(number))
            for before, after in pairwise(recent[:, number]):
                if before[2] and after[2]:
                    page.line(before[0], before[1], after[0], after[1], colour, 2)
            x0, y0, _ = recent[-1, number]
            page.box(x0 - 2, y0 - 2, x0 + 2, y0 + 2, colour)
    if camera.boxes is None:
        return
    for x0, y0, x1, y1, category, *_ in camera.boxes[grid]:
        if category < 0:
            continue
        colour = class_colour(int(category))
        right, bottom = left + x1 * scale - 1, top + y1 * scale - 1
        page.frame(left + x0 * scale, top + y0 * scale, right, bottom, colour, 2)
        if with_text:
            text = f"{int(category)}"
            size = canvas.text_width(text, _TEXT_PT) + 4
            page.box(left + x0 * scale, top + y0 * scale, left + x0 * scale + size, top + y0 * scale + 15, colour)
            page.text(left + x0 * scale + 2, top + y0 * scale + 1, text, size=_TEXT_PT, colour=canvas.PAPER)
