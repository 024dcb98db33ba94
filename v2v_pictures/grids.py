"""A picture of voxel grids alone, as ``simulate`` returns them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_pictures import canvas
from v2v_pictures.canvas import GAP_PX, PAGE_MARGIN_PX, Canvas
from v2v_pictures.colours import Image, draw_events, full_colour
from v2v_pictures.sheet import MOST_BINS, SCALE_PX, bin_headings, draw_scale, events_heading

_HEADING_PX, _LABEL_PX, _SCALE_PX = 74, 140, 100
_MOST_GRIDS = 4


def draw_grids(voxels: npt.NDArray[Any], *, tile_px: int = 192) -> Image:
    """Draw a row of bins for each of up to four grids, evenly spaced over the clip.

    Args:
        voxels: [T, bins, H, W], signed event counts, T at least 1.
        tile_px: side of a panel.

    Returns:
        [height, width, 3] uint8 RGB.
    """
    grids, bins = len(voxels), min(voxels.shape[1], MOST_BINS)
    shown = np.unique(np.linspace(0, grids - 1, _MOST_GRIDS).round().astype(int))
    full = full_colour([voxels[grid] for grid in shown])
    step = tile_px + GAP_PX
    width = max(_LABEL_PX + bins * step, SCALE_PX) + 2 * PAGE_MARGIN_PX
    page = Canvas(width, PAGE_MARGIN_PX + _HEADING_PX + len(shown) * step + _SCALE_PX)
    left = [PAGE_MARGIN_PX + _LABEL_PX + number * step for number in range(bins)]
    events_heading(page, left[0], PAGE_MARGIN_PX)
    bin_headings(page, left, PAGE_MARGIN_PX + 32, tile_px)
    for row, grid in enumerate(shown):
        top = PAGE_MARGIN_PX + _HEADING_PX + row * step
        page.text(PAGE_MARGIN_PX, top + tile_px / 2, f"voxel grid {grid + 1}", anchor="lm")
        page.text(PAGE_MARGIN_PX, top + tile_px / 2 + 22, f"of {grids}", colour=canvas.SOFT, anchor="lm")
        for number, x in enumerate(left):
            page.panel(x, top, draw_events(voxels[grid, number], full), tile_px, tile_px)
    draw_scale(page, full, PAGE_MARGIN_PX, page.height_px - _SCALE_PX + 12)
    return page.image()
