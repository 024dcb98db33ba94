"""Boxes and masks as a virtual camera sees them: cropped, resized and mirrored like the pictures.

:mod:`v2v_server.simulation.view` defines the view of pictures. cv2 resizes by the ratio of the whole sizes, with pixel
centres at half coordinates, so a continuous coordinate x becomes x width' / width.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import resized_size
from v2v_server.simulation.view import Window

LEAST_SHARE = 0.1
"""Smallest share of a box in the crop with which the box stays."""
LEAST_SIDE_PX = 2.0
"""Smallest width and height in the crop with which a box stays, px."""


def view_boxes(
    corners: npt.NDArray[np.float64], picture: Window, params: SampleParams, recipe: Recipe
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return boxes in the crop, clipped to it, and the share of each box's area that lies in it.

    Args:
        corners: [n, 4], x0, y0, x1, y1 in the upright picture, px.
        picture: its usable part.
        params, recipe: the draw and its recipe.

    Returns:
        [n, 4] corners in the crop, and [n] shares; 0 for a box without area.
    """
    height, width = resized_size(picture.height_px, picture.width_px, params.scale)
    scale = np.array([width / picture.width_px, height / picture.height_px])
    shift = np.array([params.crop_left_px, params.crop_top_px])
    points = (corners.reshape(-1, 2, 2) - (picture.left_px, picture.top_px)) * scale - shift
    if params.flip:
        points[:, :, 0] = recipe.crop_width_px - points[:, ::-1, 0]
    clipped = np.clip(points, 0.0, (recipe.crop_width_px, recipe.crop_height_px))
    whole, seen = (np.prod(each[:, 1] - each[:, 0], axis=1) for each in (points, clipped))
    share = np.divide(seen, whole, out=np.zeros_like(seen), where=whole > 0)
    return clipped.reshape(-1, 4), np.minimum(share, 1.0)


def kept_boxes(corners: npt.NDArray[np.float64], share: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the numbers of the boxes that stay, largest area in the crop first; equal ones keep their order.

    Args:
        corners, share: [n, 4] and [n], as :func:`view_boxes` returns them.
    """
    sides = corners[:, 2:] - corners[:, :2]
    stays = (share >= LEAST_SHARE) & (sides >= LEAST_SIDE_PX).all(axis=1)
    (kept,) = np.nonzero(stays)
    order = np.argsort(-np.prod(sides[kept], axis=1), kind="stable")
    return np.asarray(kept[order], np.int64)


def view_mask(mask: npt.NDArray[Any], picture: Window, params: SampleParams, recipe: Recipe) -> npt.NDArray[Any]:
    """Return a map of the upright picture as the camera sees it: the value at each pixel's centre.

    Args:
        mask: [height, width] of the whole upright picture.
        picture: its usable part.
        params, recipe: the draw and its recipe.

    Returns:
        [crop_height_px, crop_width_px].
    """
    height, width = resized_size(picture.height_px, picture.width_px, params.scale)
    rows = _nearest(params.crop_top_px, recipe.crop_height_px, height, picture.height_px) + picture.top_px
    columns = _nearest(params.crop_left_px, recipe.crop_width_px, width, picture.width_px) + picture.left_px
    return mask[np.ix_(rows, columns[::-1] if params.flip else columns)]


def _nearest(first: int, count: int, resized: int, size: int) -> npt.NDArray[np.int64]:
    """Return which of ``size`` pixels lies at the centre of each of ``count`` pixels of the resized picture."""
    # floor((place + 1/2) size / resized) in whole numbers.
    places: npt.NDArray[np.int64] = (2 * np.arange(first, first + count, dtype=np.int64) + 1) * size // (2 * resized)
    return places
