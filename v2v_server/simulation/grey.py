"""Convert frames of any usual kind to the grey levels that are simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

_WEIGHTS = (299, 587, 114)
"""Weights of red, green and blue in grey (ITU-R BT.601), thousandths."""


def grey_levels(frames: Any) -> npt.NDArray[np.uint8]:
    """Return the grey levels 0 .. 255 of a clip.

    Grey is 0.299 red + 0.587 green + 0.114 blue. Floating point means 0 for black and 1 for white; the result is
    rounded to the nearest of 256 levels (use ``simulate_log`` to avoid the rounding).

    Args:
        frames: a numpy array or a torch tensor in main memory; uint8, or floating point in 0 .. 1; [n, H, W], colour
            (RGB) as [n, H, W, 3] or [n, 3, H, W], one channel as [n, H, W, 1] or [n, 1, H, W]. If both ends could be
            channels, the last one is.

    Returns:
        uint8 [n, H, W]; grey uint8 is returned without a copy.

    Raises:
        UsageError: another type, shape or range.
    """
    try:
        given = np.asarray(frames)
    except (TypeError, RuntimeError) as error:  # raised by torch for a tensor on a GPU or one that requires gradients
        raise UsageError(f"frames: {error}") from error
    if given.ndim == 4 and given.shape[-1] not in (1, 3):
        given = np.moveaxis(given, 1, -1)
    fits = given.ndim == 3 or (given.ndim == 4 and given.shape[-1] in (1, 3))
    if not fits or (given.dtype != np.uint8 and given.dtype.kind != "f"):
        shape = list(np.shape(frames))
        raise UsageError(f"frames {given.dtype}{shape}: give uint8 or floating point [n, H, W], or colour [n, H, W, 3]")
    if given.ndim == 4 and given.shape[-1] == 1:
        given = given[..., 0]
    if given.ndim == 3 and given.dtype == np.uint8:
        return given
    grey = np.empty(given.shape[:3], np.uint8)
    for frame, out in zip(given, grey, strict=True):  # one at a time: the intermediate arrays are eight times as large
        out[:] = _of_frame(frame)
    return grey


def _of_frame(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    red, green, blue = _WEIGHTS
    if frame.dtype == np.uint8:
        wide = frame.astype(np.int32)
        return (red * wide[..., 0] + green * wide[..., 1] + blue * wide[..., 2] + 500) // 1000
    if not ((frame >= 0) & (frame <= 1)).all():
        raise UsageError("frames: a value is NaN or outside 0 .. 1; floating point means 0 for black and 1 for white")
    value = frame.astype(np.float64)
    if value.ndim == 3:
        value = (red * value[..., 0] + green * value[..., 1] + blue * value[..., 2]) / 1000
    return np.rint(value * 255)
