"""Events of a window -> voxel grid: discrete, as V2V evaluates, or interpolated, as networks before it were trained.

With u the place of an event in its window, 0 at the first and just below 1 at the last, polarity p = +1 or -1, B bins:

    discrete       V[floor(B u), y, x]  += p
    interpolated   V[b, y, x]           += p max(0, 1 - |(B - 1) u - b|)        (Zhu et al. 2019)

Published code takes u = tau / (D + delta) with tau in whole microseconds after the first event of the window and D
that of the last; delta is 0.001 us (discrete) or 0.0001 us (interpolated). So bins span the events, not the time
between the pictures. ``span="window"`` takes u = (t - start) / (end - start) instead: bins as in training, where they
divide the time between two frames.
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
    """Events of one window, in order of time.

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
    """How windows become voxel grids.

    Attributes:
        kind: "discrete" or "interpolated".
        bins: of a grid.
        span: "events" (published) or "window", see the module.
        truncate: cut times to whole microseconds, as the published code does, instead of rounding. Seconds in binary
            are often just below the microsecond that they mean, which then counts as the one before.

    Raises:
        UsageError: another kind or span, or no bins.
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
    """
    Args:
        events: of the window.
        size: height and width of the sensor.
        settings: the kind of voxels.
        window: start and end in seconds; looked at where ``settings.span`` is "window".

    Returns:
        float32 [bins, H, W]; zeros without events.

    Raises:
        UsageError: events outside the sensor.
    """
    height, width = size
    if not len(events):
        return np.zeros((settings.bins, height, width), np.float32)
    outside = (events.x < 0) | (events.x >= width) | (events.y < 0) | (events.y >= height)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        raise UsageError(
            f"{np.count_nonzero(outside)} of {len(events)} events lie outside the sensor of {width} x {height}, the "
            f"first at x = {events.x[first]}, y = {events.y[first]}"
        )
    place = _place(events.t, settings, window)
    pixel = events.y.astype(np.int64) * width + events.x
    if settings.kind == "discrete":
        grid = _sum(np.floor(settings.bins * place).astype(np.int64), pixel, events.p, settings.bins, size)
    else:
        position = (settings.bins - 1) * place
        lower = np.floor(position).astype(np.int64)
        upper_share = position - lower
        grid = _sum(lower, pixel, events.p * (1 - upper_share), settings.bins, size)
        # One bin more: at the very end of the window the share above the last bin is 0.
        grid += _sum(lower + 1, pixel, events.p * upper_share, settings.bins + 1, size)[:-1]
    return grid.astype(np.float32)


def _place(t: npt.NDArray[np.float64], settings: VoxelSettings, window: tuple[float, float]) -> npt.NDArray[np.float64]:
    """u of each event, 0 <= u < 1."""
    if settings.span == "window":
        # In whole microseconds as well: an event on an edge would otherwise fall on either side of it by rounding.
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
