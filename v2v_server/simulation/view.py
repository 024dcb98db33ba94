"""The view of a virtual camera: which part of the picture it sees, at which size and orientation.

Order: resize the whole usable picture, crop, flip, degrade the contrast. Because resizing comes before cropping, the
crop's border is interpolated from its true neighbours.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import resized_size
from v2v_server.system.compile_cache import cv2
from v2v_server.video.picture import SDR, Signal

FrameArray = npt.NDArray[Any]
"""Grey levels: uint8, or uint16 for a signal of more than 8 bits."""


class Window(NamedTuple):
    """A rectangle of the upright video picture; a window of ``trainer/evaluation`` is a time."""

    top_px: int
    left_px: int
    height_px: int
    width_px: int


def source_window(
    params: SampleParams,
    recipe: Recipe,
    picture: Window,
    margin_px: int | None = 0,
) -> Window:
    """Return the part of the video picture that :func:`apply_view` needs.

    Args:
        params, recipe: the draw and its recipe.
        picture: the usable part of the upright video picture.
        margin_px: margin around the crop; None: the whole picture.

    Returns:
        the crop and its margin at scale 1, otherwise the whole usable picture.
    """
    if params.scale != 1.0:
        return picture
    top, left, height, width = crop_region(params, recipe, picture.height_px, picture.width_px, margin_px)
    return Window(picture.top_px + top, picture.left_px + left, height, width)


def crop_region(
    params: SampleParams, recipe: Recipe, height_px: int, width_px: int, margin_px: int | None = 0
) -> Window:
    """Return the crop with its margin, as far as the picture reaches."""
    if margin_px is None:
        return Window(0, 0, height_px, width_px)
    top, left = max(0, params.crop_top_px - margin_px), max(0, params.crop_left_px - margin_px)
    bottom = min(height_px, params.crop_top_px + recipe.crop_height_px + margin_px)
    right = min(width_px, params.crop_left_px + recipe.crop_width_px + margin_px)
    return Window(top, left, bottom - top, right - left)


def crop_place(params: SampleParams, margin_px: int | None) -> tuple[int, int]:
    """Return row and column of the crop in the region that :func:`crop_region` returns for the margin."""
    if margin_px is None:
        return params.crop_top_px, params.crop_left_px
    return min(params.crop_top_px, margin_px), min(params.crop_left_px, margin_px)


def without_margin(
    frames: FrameArray, params: SampleParams, recipe: Recipe, margin_px: int | None, kept_px: int | None = 0
) -> FrameArray:
    """Return the part of frames of a :func:`source_window` that a smaller margin needs, as a view of them.

    Args:
        frames: [n, h, w], the window with ``margin_px``.
        params, recipe: the draw and its recipe.
        margin_px, kept_px: the margin that the frames have, and the one to keep.
    """
    if params.scale != 1.0 or margin_px == kept_px:
        return frames
    (top, left), (kept_top, kept_left) = crop_place(params, margin_px), crop_place(params, kept_px)
    below = 0 if kept_px is None else kept_px
    rows = slice(top - kept_top, top + recipe.crop_height_px + below)
    return frames[:, rows, left - kept_left : left + recipe.crop_width_px + below]


def resized(frame: FrameArray, size: tuple[int, int], scale: float) -> FrameArray:
    """Return a picture, [H, W], resized to (height, width); ``scale`` is the factor."""
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    whole: FrameArray = np.asarray(cv2.resize(frame, (size[1], size[0]), interpolation=method), frame.dtype)
    return whole


def apply_view(frames: FrameArray, params: SampleParams, recipe: Recipe, signal: Signal = SDR) -> FrameArray:
    """Return the frames as the virtual camera sees them.

    Args:
        frames: [n, h, w] of the signal's dtype, the window of :func:`source_window`.
        params, recipe: the draw and its recipe.
        signal: what the levels mean.

    Returns:
        [n, crop_height_px, crop_width_px] of that dtype, C-contiguous.

    Raises:
        UsageError: the frames do not hold the crop.
    """
    height, width = recipe.crop_height_px, recipe.crop_width_px
    top, left = params.crop_top_px, params.crop_left_px
    if frames.ndim != 3 or frames.dtype != signal.dtype:
        raise UsageError(f"frames {frames.dtype}{list(frames.shape)}: give {signal.dtype} [n, h, w]")
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
        seen = np.empty((len(frames), height, width), frames.dtype)
        for frame, target in zip(frames, seen, strict=True):
            target[:] = resized(frame, seen_size, params.scale)[top : top + height, left : left + width]
    if params.flip:
        seen = seen[:, :, ::-1]
    if params.contrast != 0.0:
        table = contrast_table(params.contrast, signal.white)
        seen = np.stack([table[frame] for frame in seen])  # one at a time: indices take 8 bytes a pixel
    return np.ascontiguousarray(seen)


def contrast_table(contrast: float, most: int = 255) -> npt.NDArray[Any]:
    """Return clip((F - most / 2) s + most / 2, 0, most) of every F from 0 to ``most``, rounded half up.

    Returns:
        [most + 1] uint8, or uint16 if ``most`` is above 255.
    """
    levels = [math.floor((level - most / 2) * contrast + (most + 1) / 2) for level in range(most + 1)]
    return np.array([min(max(level, 0), most) for level in levels], np.uint8 if most == 255 else np.uint16)
