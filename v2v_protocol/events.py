"""Convert voxel grids to events. A voxel grid has no times within a bin, so these times are invented.

The rule: a bin of duration ``bin_us`` with the signed count n gives ``|n|`` events of that sign at its pixel, spread
evenly: event k of 0 .. ``|n| - 1`` lies ``(2k + 1) / 2|n|`` of the way through the bin, rounded down to a microsecond.
So a single event lies in the middle of its bin, and :meth:`EventList.voxels` returns the original grids. Information
that the grid has lost is not restored: events of both signs that cancelled within a bin, and counts beyond its dtype.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

_LARGEST_SIDE_PX = 2**16
_LARGEST_TIME_US = 2**62


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EventList:
    """Events in order of time; those of the same microsecond in order of rows and columns.

    Attributes:
        x, y: uint16 [N], px; (0, 0) is the top left pixel.
        t: int64 [N], microseconds from the beginning of the first voxel grid. Invented within a bin (see the module).
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
        return f"EventList({len(self)} of {self.width_px}x{self.height_px} px, times within a bin invented)"

    def voxels(self, grids: int, bins: int, bin_us: float, dtype: str = "int16") -> npt.NDArray[Any]:
        """Accumulate the events in bins. With matching arguments this returns the voxel grids that they were made from.

        Args:
            grids, bins: T and bins of the result.
            bin_us: duration of a bin, microseconds.
            dtype: numpy dtype of the counts; counts wrap if it is too narrow.

        Returns:
            [grids, bins, H, W] signed event counts. Events after the last bin are left out.
        """
        edges = _edges(grids * bins, bin_us)
        place = np.searchsorted(edges, self.t, side="right") - 1
        inside = (place >= 0) & (place < grids * bins)
        pixel = (place[inside] * self.height_px + self.y[inside]) * self.width_px + self.x[inside]
        shape = grids, bins, self.height_px, self.width_px
        counts = np.bincount(pixel, np.where(self.p[inside], 1.0, -1.0), minlength=math.prod(shape))
        return counts.reshape(shape).astype(dtype)


def to_events(voxels: npt.NDArray[Any], bin_us: float) -> EventList:
    """Convert voxel grids to events. Their times within a bin are invented (see the module).

    Args:
        voxels: [T, bins, H, W] signed event counts; T consecutive grids.
        bin_us: duration of a bin, microseconds, 1 or more; need not be whole.

    Raises:
        UsageError: the array has another shape or fractional counts, or the duration is out of range.
    """
    voxels = np.asarray(voxels)
    if voxels.ndim != 4 or voxels.dtype.kind not in "if" or max(voxels.shape[2:]) > _LARGEST_SIDE_PX:
        raise UsageError(f"voxels {voxels.dtype}{list(voxels.shape)}: give signed counts [T, bins, H, W]")
    grids, bins, height, width = voxels.shape
    edges = _edges(grids * bins, bin_us)
    columns = [
        _bin_events(counts, int(edges[number]), int(edges[number + 1] - edges[number]))
        for number, counts in enumerate(voxels.reshape(-1, height, width))
    ]
    # An empty column first: no bins are no events.
    x, y, t, p = ([np.empty(0, np.int64), *(each[place] for each in columns)] for place in range(4))
    return EventList(
        np.concatenate(x).astype(np.uint16),
        np.concatenate(y).astype(np.uint16),
        np.concatenate(t).astype(np.int64),
        np.concatenate(p).astype(np.bool_),
        width,
        height,
    )


def _bin_events(counts: npt.NDArray[Any], start_us: int, span_us: int) -> tuple[npt.NDArray[Any], ...]:
    """Return (x, y, t, p) of one bin."""
    y, x = np.nonzero(counts)
    signed = counts[y, x]
    if not np.isfinite(signed).all() or (signed != np.trunc(signed)).any():
        raise UsageError("voxels: a count is not whole; give voxel grids as they are simulated, not normalised ones")
    number = np.abs(signed.astype(np.int64))
    pixel = np.repeat(np.arange(len(number)), number)
    k = np.arange(len(pixel)) - np.repeat(np.cumsum(number) - number, number)
    t = start_us + (2 * k + 1) * span_us // (2 * number[pixel])
    order = np.argsort(t, kind="stable")
    pixel = pixel[order]
    return x[pixel], y[pixel], t[order], signed[pixel] > 0


def _edges(count: int, bin_us: float) -> npt.NDArray[np.int64]:
    """Return [count + 1] starts of the bins and the end of the last, whole microseconds."""
    if not 1 <= bin_us * max(count, 1) < _LARGEST_TIME_US or bin_us < 1:
        raise UsageError(f"bin_us = {bin_us!r}: give the duration of a bin in microseconds, at least 1")
    edges: npt.NDArray[np.int64] = np.floor(np.arange(count + 1) * float(bin_us)).astype(np.int64)
    return edges
