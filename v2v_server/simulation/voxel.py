"""THE definition of a bin: which step falls where, how long it lasts, when a change counts, what a dtype holds.

Steps. Step s (0 .. steps-1) is the change from frame s to frame s+1 of the clip. Bin b of voxel t sums the signed event
counts of the ``frames_per_bin`` consecutive steps that start at ``(t * bins + b) * frames_per_bin``; so voxel t spans
frames ``t * bins * frames_per_bin`` to ``(t + 1) * bins * frames_per_bin``, its ends included.

Counting. One threshold crossing is decided per step, with d = (residual + hot drift) + (change of log intensity +
noise), in this order:

    count    = floor((|d| + tolerance) / c)        c = threshold_pos where d >= 0, else threshold_neg
    residual = d - sign(d) * c * count
    V(bin)  += sign(d) * count

``tolerance`` makes the paper's plain floor well defined in float32. Log intensities are known to half a unit in the
last place (2**-22 where |L| > 4), and every step rounds a residual of the size of c; without a tolerance, whether an
exact multiple of c has been reached is decided by these roundings. :func:`rounding_tolerance` has a part for each.
With it every exact ramp tried counts exactly: 1 to 100 thresholds of 0.05 to 2, over 5 to 200 steps, anywhere between
black and white; half of it misses 2 % of them. It moves an event by a step where a change misses its threshold by
less: against the plain floor in float64 up to 60 bins in a million at c = 0.05 on natural clips, up to 3 at c >= 1.

Dtypes. A sum is made in floating point (exact up to 2**24) and stored in int8 clipped to -127 .. 127, in int16 clipped
to -32767 .. 32767, or in float32 as it is. Clipped bins are counted, never wrapped.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.spec import VOXEL_DTYPES

LARGEST_COUNT = {"int8": 127.0, "int16": 32767.0, "float32": np.inf}
"""Largest magnitude of a bin that the dtype stores."""


def rounding_tolerance(threshold_pos: float, threshold_neg: float) -> float:
    """Return by how much, in log units, a change may miss a threshold and still count as reaching it.

    With c the smaller threshold: 2**-21, or c * 2**-19 if that is more; never more than c / 16.
    """
    smaller = min(threshold_pos, threshold_neg)
    return min(max(2.0**-21, smaller * 2.0**-19), smaller * 2.0**-4)


def voxel_array(
    voxels: int, bins: int, height: int, width: int, dtype: str, out: npt.NDArray[Any] | None = None
) -> npt.NDArray[Any]:
    """Return an uninitialised voxel array [voxels, bins, height, width], or ``out`` if it is given.

    Raises:
        UsageError: the dtype is not one of int8, int16, float32, or ``out`` is not such an array.
    """
    if dtype not in LARGEST_COUNT:
        raise UsageError(f"voxel dtype {dtype!r}: choose one of {', '.join(VOXEL_DTYPES)}")
    shape = voxels, bins, height, width
    if out is None:
        return np.empty(shape, np.dtype(dtype))
    if out.shape != shape or out.dtype.name != dtype or not out.flags.c_contiguous:
        raise UsageError(f"out {out.dtype}{list(out.shape)}: give {dtype}{list(shape)}, C-contiguous")
    return out


def step_seconds(
    seconds: npt.NDArray[np.float64], source_index: npt.NDArray[np.int64], average_fps: float
) -> tuple[npt.NDArray[np.float64], int]:
    """Return the durations of the steps of a clip.

    Args:
        seconds: [count] presentation time of each decoded frame; NaN if the file gives none.
        source_index: [steps + 1], which decoded frame each position shows (``SampleParams.source_index``).
        average_fps: frames per second of the video; used if two time stamps do not increase. A paused step lasts one
            average frame too.

    Returns:
        durations [steps] float64, all > 0; number of steps that are not paused and had to use the average.

    Raises:
        UsageError: fewer time stamps than frames, or an average rate that is not a positive finite number.
    """
    if not (np.isfinite(average_fps) and average_fps > 0):
        raise UsageError(f"average_fps = {average_fps}: noise per second needs the video's frame rate")
    if len(seconds) <= int(source_index[-1]):
        raise UsageError(f"{len(seconds)} time stamps for {int(source_index[-1]) + 1} frames: give one per frame")
    shown = np.asarray(seconds, np.float64)[source_index]
    with np.errstate(invalid="ignore"):
        elapsed = shown[1:] - shown[:-1]
    regular = np.isfinite(elapsed) & (elapsed > 0)
    paused = source_index[1:] == source_index[:-1]
    return np.where(regular, elapsed, 1.0 / average_fps), int(np.count_nonzero(~regular & ~paused))
