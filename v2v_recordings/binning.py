"""Sum the events of a voxel grid into its bins: one law for served recordings and for evaluation.

With u the position of an event in its grid, from 0 to just below 1, polarity p = +1 or -1, and B bins:

    discrete       V[floor(B u), y, x]  += p
    interpolated   V[b, y, x]           += p max(0, 1 - |(B - 1) u - b|)        (Zhu et al. 2019)

Published code takes u = tau / (D + delta), where tau is in integer microseconds after the first event of the grid and D
is tau of the last; delta is 0.001 us (discrete) or 0.0001 us (interpolated). So bins span the events. Bins that divide
the time of the grid have u = tau / its length.

Sums are float64, in the order of the events. Only operations that IEEE 754 rounds correctly are used, so all hosts get
the same bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

DELTA_US = {"discrete": 1e-3, "interpolated": 1e-4}


NEVER = np.iinfo(np.int64).min


class EventsOfCrop(NamedTuple):
    """The events of some grids in a crop.

    Attributes:
        t_ns: [n] int64, ascending.
        pixel: [n] int64, places in the crop, row by row.
        brighter: [n] bool, polarities.
        span_ns: [grids, 2] int64, times of the first and last event of each grid on the whole sensor; NEVER without.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.int64]
    brighter: npt.NDArray[np.bool_]
    span_ns: npt.NDArray[np.int64]


def bin_events(
    kind: str,
    position: npt.NDArray[np.float64],
    pixel: npt.NDArray[np.integer],
    polarity: npt.NDArray[np.floating],
    bins: int,
    pixels: int,
) -> npt.NDArray[np.float64]:
    """Return the sums of a voxel grid, [bins, pixels].

    Args:
        kind: "discrete" or "interpolated".
        position: [n] u, see :func:`positions`.
        pixel: [n], below ``pixels``.
        polarity: [n].
    """
    if kind == "discrete":
        return _sum(bins_of(position, bins), pixel, polarity, bins, pixels)
    place = (bins - 1) * position
    lower = place.astype(np.int64)
    upper_share = place - lower
    grid = _sum(lower, pixel, polarity * (1 - upper_share), bins, pixels)
    # One extra bin for the end of the window, where the share above the last bin is 0.
    return grid + _sum(lower + 1, pixel, polarity * upper_share, bins + 1, pixels)[:-1]


def positions(
    kind: str, tau_us: npt.NDArray[np.float64], length_us: float, *, spans_events: bool
) -> npt.NDArray[np.float64]:
    """Return u of each event, 0 <= u < 1.

    Args:
        tau_us: [n] time since the first event or since the grid's begin, whole microseconds.
        length_us: that of the last event, or of the grid's end.
        spans_events: whether these are the first and last event.
    """
    length_us = length_us + DELTA_US[kind] if spans_events else max(1.0, length_us)
    return np.clip(tau_us / length_us, 0.0, np.nextafter(1.0, 0.0))


def bins_of(position: npt.NDArray[np.float64], bins: int) -> npt.NDArray[np.int64]:
    """Return the bin of each event of a discrete grid, [n]."""
    return (bins * position).astype(np.int64)


def _sum(
    bins_of: npt.NDArray[np.int64],
    pixel: npt.NDArray[np.integer],
    weights: npt.NDArray[np.floating],
    bins: int,
    pixels: int,
) -> npt.NDArray[np.float64]:
    sums = np.bincount(bins_of * pixels + pixel, weights, minlength=bins * pixels).astype(np.float64, copy=False)
    return sums.reshape(bins, pixels)
