"""The view of a virtual camera: which part of the picture it sees, at which size and orientation.

Order: resize the whole usable picture, crop, flip, degrade the contrast. Because resizing comes before cropping, the
crop's border is interpolated from its true neighbours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import resized_size
from v2v_server.system.opencv import cv2

Frames = npt.NDArray[np.uint8]


class Window(NamedTuple):
    """A rectangle of the upright video picture."""

    top_px: int
    left_px: int
    height_px: int
    width_px: int


def source_window(
    params: SampleParams, recipe: Recipe, picture_top_px: int, picture_height_px: int, picture_width_px: int
) -> Window:
    """Return the part of the video picture that :func:`apply_view` needs.

    Args:
        params, recipe: the draw and its recipe.
        picture_top_px: first usable row of the upright video picture.
        picture_height_px, picture_width_px: size of the usable picture.

    Returns:
        the crop alone at scale 1, otherwise the whole usable picture.
    """
    if params.scale == 1.0:
        return Window(
            picture_top_px + params.crop_top_px, params.crop_left_px, recipe.crop_height_px, recipe.crop_width_px
        )
    return Window(picture_top_px, 0, picture_height_px, picture_width_px)


def apply_view(frames: Frames, params: SampleParams, recipe: Recipe) -> Frames:
    """Return the frames as the virtual camera sees them.

    Args:
        frames: [n, h, w] uint8, the window of :func:`source_window`.
        params, recipe: the draw and its recipe.

    Returns:
        [n, crop_height_px, crop_width_px] uint8, C-contiguous.

    Raises:
        UsageError: the frames do not hold the crop.
    """
    height, width = recipe.crop_height_px, recipe.crop_width_px
    top, left = params.crop_top_px, params.crop_left_px
    if frames.ndim != 3 or frames.dtype != np.uint8:
        raise UsageError(f"frames {frames.dtype}{list(frames.shape)}: give uint8 [n, h, w]")
    if params.scale == 1.0:
        seen_size, top, left = frames.shape[1:], 0, 0
    else:
        seen_size = resized_size(frames.shape[1], frames.shape[2], params.scale)
    if seen_size[0] < top + height or seen_size[1] < left + width:
        raise UsageError(
            f"frames of {frames.shape[2]}x{frames.shape[1]} pixels at scale {params.scale} do not hold a crop of "
            f"{width}x{height} at row {top}, column {left}: decode the window that source_window() names"
        )
    if params.scale == 1.0:
        seen = frames[:, :height, :width]
    else:
        seen = np.empty((len(frames), height, width), np.uint8)
        method = cv2.INTER_AREA if params.scale < 1.0 else cv2.INTER_LINEAR
        for frame, target in zip(frames, seen, strict=True):
            resized = cv2.resize(frame, (seen_size[1], seen_size[0]), interpolation=method)
            target[:] = resized[top : top + height, left : left + width]
    if params.flip:
        seen = seen[:, :, ::-1]
    if params.contrast != 0.0:
        seen = contrast_table(params.contrast)[seen]
    return np.ascontiguousarray(seen)


def contrast_table(contrast: float) -> Frames:
    """Return clip((F - 127.5) s + 127.5, 0, 255) of every grey level F, rounded half up: [256] uint8."""
    levels = [math.floor((level - 127.5) * contrast + 128.0) for level in range(256)]
    return np.array([min(max(level, 0), 255) for level in levels], np.uint8)
