"""THE definition of a bin: which step falls where, when a change counts, what a dtype holds.

Steps. Step s (0 .. steps-1) is the change from frame s to frame s+1 of the clip. Bin b of voxel t sums the signed event
counts of the ``frames_per_bin`` consecutive steps that start at ``(t * bins + b) * frames_per_bin``; so voxel t spans
frames ``t * bins * frames_per_bin`` to ``(t + 1) * bins * frames_per_bin``, its ends included.

Counting. One threshold crossing is decided per step, with d = residual + change of log intensity + noise:

    count    = floor((|d| + tolerance) / c)        c = threshold_pos where d >= 0, else threshold_neg
    residual = d - sign(d) * c * count
    V(bin)  += sign(d) * count

``tolerance`` is the paper's rule made well defined: log intensities are known to float32 (2**-22 log units where
|L| > 4) and the threshold itself is a float32, so whether an exact multiple of c has been "reached" would otherwise
be decided by rounding. See :func:`rounding_tolerance`.

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
    """The change, log units, by which a threshold may be missed and still counts as reached.

    2**-20, or a sixteenth of the smaller threshold where that is less.
    """
    return min(2.0**-20, min(threshold_pos, threshold_neg) * 2.0**-4)


def voxel_array(voxels: int, bins: int, height: int, width: int, dtype: str) -> npt.NDArray[Any]:
    """An uninitialised voxel array [voxels, bins, height, width].

    Raises:
        UsageError: the dtype is not one of int8, int16, float32.
    """
    if dtype not in LARGEST_COUNT:
        raise UsageError(f"voxel dtype {dtype!r}: choose one of {', '.join(VOXEL_DTYPES)}")
    return np.empty((voxels, bins, height, width), np.dtype(dtype))
