"""Convert frames of any usual kind to the grey levels that are simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_server.video.luma import MOST_BITS, SDR, TRANSFERS, Signal

_WEIGHTS = (299, 587, 114)
"""Weights of red, green and blue in grey (ITU-R BT.601), thousandths."""


def grey_levels(frames: Any, signal: Signal = SDR) -> npt.NDArray[Any]:
    """Return the grey levels of a clip: 0 .. 255, apart from a signal of more than 8 bits.

    Grey is 0.299 red + 0.587 green + 0.114 blue. Floating point means 0 for black and 1 for white; the result is
    rounded to the nearest of 256 levels (use ``simulate_log`` to avoid the rounding).

    Args:
        frames: a numpy array or a torch tensor in main memory; uint8, or floating point in 0 .. 1; [n, H, W], colour
            (RGB) as [n, H, W, 3] or [n, 3, H, W], one channel as [n, H, W, 1] or [n, 1, H, W]. If both ends could be
            channels, the last one is.
        signal: what the levels mean. With more than 8 bits, frames are uint16 [n, H, W] and returned as they are.

    Returns:
        uint8 [n, H, W]; grey uint8 is returned without a copy.

    Raises:
        UsageError: another type, shape or range, or an unknown signal.
    """
    if signal.transfer not in ("", *TRANSFERS.values()):
        raise UsageError(f"transfer {signal.transfer!r}: choose one of {', '.join(TRANSFERS.values())}, or ''")
    if signal.bits not in range(8, MOST_BITS + 1):
        raise UsageError(f"bits = {signal.bits!r}: give a whole number from 8 to {MOST_BITS}")
    try:
        given = np.asarray(frames)
    except (TypeError, RuntimeError) as error:  # raised by torch for a tensor on a GPU or one that requires gradients
        raise UsageError(f"frames: {error}") from error
    if signal.bits > 8:
        if given.ndim != 3 or given.dtype != np.uint16 or given.max(initial=0) > signal.white:
            raise UsageError(
                f"frames {given.dtype}{list(given.shape)}, levels up to {given.max(initial=0)}: with bits = "
                f"{signal.bits}, give uint16 [n, H, W] of levels up to {signal.white}"
            )
        return given
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
