"""Convert the events of a window to a voxel grid: discrete, as V2V evaluates, or interpolated, as earlier networks do.

:mod:`v2v_recordings.binning` has the law. Bins span the events, as in published code, not the time between the
pictures; ``span="window"`` divides the time of the window instead, as training divides the time between two frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_recordings import binning

Kind = Literal["discrete", "interpolated"]
Span = Literal["events", "window"]


@dataclass(frozen=True, eq=False)
class Events:
    """Hold the events of one window, sorted by time.

    Attributes:
        t: float64 [N], seconds.
        x, y: integers [N], pixels.
        p: float32 [N], +1 or -1.
    """

    t: npt.NDArray[np.float64]
    x: npt.NDArray[np.integer]
    y: npt.NDArray[np.integer]
    p: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class VoxelSettings:
    """Hold how windows become voxel grids.

    Attributes:
        kind: "discrete" or "interpolated".
        bins: number of bins of a grid, at least 1.
        span: "events" (published) or "window", see the module.
        truncate: truncate times to integer microseconds, as the published code does, instead of rounding. Binary
            seconds are often just below the intended microsecond, so truncation gives the previous one.

    Raises:
        UsageError: the kind or span is unknown, or ``bins`` is below 1.
    """

    kind: Kind = "discrete"
    bins: int = 5
    span: Span = "events"
    truncate: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind) or self.span not in get_args(Span):
            raise UsageError(
                f"voxels of kind {self.kind!r}, span {self.span!r}: give one of {', '.join(get_args(Kind))}, and one "
                f"of {', '.join(get_args(Span))}"
            )
        if type(self.bins) is not int or self.bins < 1:
            raise UsageError(f"voxels with {self.bins} bins: give at least 1")


def voxel_grid(
    events: Events, size: tuple[int, int], settings: VoxelSettings, window: tuple[float, float]
) -> npt.NDArray[np.float32]:
    """Convert the events of a window to a voxel grid.

    Args:
        size: height and width of the sensor.
        window: start and end in seconds; used only if ``settings.span`` is "window".

    Returns:
        float32 [bins, H, W]; zeros without events.

    Raises:
        UsageError: events lie outside the sensor.
    """
    height, width = size
    if not len(events):
        return np.zeros((settings.bins, height, width), np.float32)
    x, y = events.x.astype(np.int64), events.y.astype(np.int64)  # uint64 does not mix with signed numbers
    outside = (x < 0) | (x >= width) | (y < 0) | (y >= height)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        raise UsageError(
            f"{np.count_nonzero(outside)} of {len(events)} events lie outside the sensor of {width} x {height}, the "
            f"first at x = {events.x[first]}, y = {events.y[first]}"
        )
    tau, length = _times(events.t, settings, window)
    place = binning.positions(settings.kind, tau, length, spans_events=settings.span == "events")
    grid = binning.bin_events(settings.kind, place, y * width + x, events.p, settings.bins, height * width)
    return grid.astype(np.float32).reshape(-1, height, width)


def _times(
    t: npt.NDArray[np.float64], settings: VoxelSettings, window: tuple[float, float]
) -> tuple[npt.NDArray[np.float64], float]:
    """Return the time of each event since the beginning of its grid, and the grid's length, whole microseconds."""
    if settings.span == "window":
        # In integer microseconds as well: otherwise rounding decides on which side of an edge an event falls.
        start, end = window
        return np.rint((t - start) * 1e6), float(np.rint((end - start) * 1e6))
    microseconds = (t - t[0]) * 1e6
    tau = np.trunc(microseconds) if settings.truncate else np.rint(microseconds)
    return tau, float(tau[-1])
