"""Events with times, and their sums in bins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

_LARGEST_TIME_US = 2**62


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EventList:
    """Events in order of time; those of the same microsecond in order of rows and columns.

    Attributes:
        x, y: uint16 [N], px; (0, 0) is the top left pixel.
        t: int64 [N], microseconds from the beginning of the first voxel grid.
        p: bool [N], True if the pixel got brighter.
        width_px, height_px: size of the sensor.
    """

    x: npt.NDArray[np.uint16]
    y: npt.NDArray[np.uint16]
    t: npt.NDArray[np.int64]
    p: npt.NDArray[np.bool_]
    width_px: int
    height_px: int

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"EventList({len(self)} of {self.width_px}x{self.height_px} px)"

    def voxels(self, grids: int, bins: int, bin_us: float, dtype: str = "int16") -> npt.NDArray[Any]:
        """Accumulate the events in bins. With matching arguments this returns the voxel grids of their simulation.

        Args:
            grids, bins: T and bins of the result.
            bin_us: duration of a bin, microseconds; need not be whole.
            dtype: numpy dtype of the counts; counts wrap if it is too narrow.

        Returns:
            [grids, bins, H, W] signed event counts. Events after the last bin are left out.

        Raises:
            UsageError: the bins are too short or too long.
        """
        check_duration(grids * bins * bin_us)
        edges = whole_edges(np.arange(grids * bins + 1) * float(bin_us))
        place = np.searchsorted(edges, self.t, side="right") - 1
        inside = (place >= 0) & (place < grids * bins)
        pixel = (place[inside] * self.height_px + self.y[inside]) * self.width_px + self.x[inside]
        shape = grids, bins, self.height_px, self.width_px
        counts = np.bincount(pixel, np.where(self.p[inside], 1.0, -1.0), minlength=math.prod(shape))
        return counts.reshape(shape).astype(dtype)


def check_duration(total_us: float) -> None:
    """Check the duration of a clip.

    Raises:
        UsageError: it is less than a microsecond, too long for int64, or not a number.
    """
    if not 1 <= total_us < _LARGEST_TIME_US:
        raise UsageError(
            f"events over {total_us!r} microseconds: give a clip of at least 1 and less than {_LARGEST_TIME_US} (2**62)"
        )


def whole_edges(edges_us: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.int64]:
    """Return the first whole microsecond at or after each moment, [edges]; roundings below 1e-6 do not count."""
    first: npt.NDArray[np.int64] = np.ceil(np.round(edges_us, 6)).astype(np.int64)
    return first
