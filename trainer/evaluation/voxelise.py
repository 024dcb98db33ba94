"""Convert the events of a window to a voxel grid: discrete, as V2V evaluates, or interpolated, as earlier networks do.

With u the position of an event in its window, 0 at the first and just below 1 at the last, polarity p = +1 or -1, and B
bins:

    discrete       V[floor(B u), y, x]  += p
    interpolated   V[b, y, x]           += p max(0, 1 - |(B - 1) u - b|)        (Zhu et al. 2019)

Published code takes u = tau / (D + delta), where tau is in integer microseconds after the first event of the window and
D is tau of the last; delta is 0.001 us (discrete) or 0.0001 us (interpolated). So bins span the events, not the time
between the pictures. ``span="window"`` takes u = (t - start) / (end - start) instead: these are the bins of training,
which divide the time between two frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

Kind = Literal["discrete", "interpolated"]
Span = Literal["events", "window"]
DELTA_US = {"discrete": 1e-3, "interpolated": 1e-4}


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
    place = _place(events.t, settings, window)
    pixel = y * width + x
    if settings.kind == "discrete":
        grid = _sum(np.floor(settings.bins * place).astype(np.int64), pixel, events.p, settings.bins, size)
    else:
        position = (settings.bins - 1) * place
        lower = np.floor(position).astype(np.int64)
        upper_share = position - lower
        grid = _sum(lower, pixel, events.p * (1 - upper_share), settings.bins, size)
        # One extra bin for the end of the window, where the share above the last bin is 0.
        grid += _sum(lower + 1, pixel, events.p * upper_share, settings.bins + 1, size)[:-1]
    return grid.astype(np.float32)


def _place(t: npt.NDArray[np.float64], settings: VoxelSettings, window: tuple[float, float]) -> npt.NDArray[np.float64]:
    """Return u of each event, 0 <= u < 1."""
    if settings.span == "window":
        # In integer microseconds as well: otherwise rounding decides on which side of an edge an event falls.
        start, end = window
        tau, length = np.rint((t - start) * 1e6), max(1.0, np.rint((end - start) * 1e6))
        place: npt.NDArray[np.float64] = np.clip(tau / length, 0.0, np.nextafter(1.0, 0.0))
    else:
        microseconds = (t - t[0]) * 1e6
        tau = np.trunc(microseconds) if settings.truncate else np.rint(microseconds)
        place = tau / (tau[-1] + DELTA_US[settings.kind])
    return place


def _sum(
    bins_of: npt.NDArray[np.int64],
    pixel: npt.NDArray[np.int64],
    weights: npt.NDArray[np.floating],
    bins: int,
    size: tuple[int, int],
) -> npt.NDArray[np.float64]:
    pixels = size[0] * size[1]
    sums = np.bincount(bins_of * pixels + pixel, weights, minlength=bins * pixels).astype(np.float64, copy=False)
    return sums.reshape(bins, *size)
