"""Arrays of a sample made of recorded events: the counterpart of the pixel kernel.

A grid holds the events with begin <= t < end. :mod:`v2v_recordings.binning` has the law of its bins, with times in
whole microseconds, rounded to even. Sums are rounded once, at the end.

    bin_span grid    bins are equal parts of the time of the grid
    bin_span events  of that from its first event to its last, on the whole sensor: the released code of E2VID and V2V
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_recordings.binning import bin_events, bins_of, positions
from v2v_recordings.items import EventChunk
from v2v_server.simulation import noise
from v2v_server.simulation.pixel import hot_pixels, words
from v2v_server.video.picture import PixelRect

NOISE_RADIUS, NOISE_ANGLE = 1020, 1021
"""Purposes of the words of added noise (``noise.py``)."""


class Grids(NamedTuple):
    """When the voxel grids of a sample begin and end, [G] int64 nanoseconds each; a paused one is empty."""

    begin_ns: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]


def fill_arrays(
    events: EventChunk, grids: Grids, recipe: Recipe, params: SampleParams, window: PixelRect,
    out: Mapping[str, npt.NDArray[Any]],
) -> dict[str, int]:  # fmt: skip
    """Fill the requested arrays of a sample, and return how many values of each had to be clipped.

    Args:
        events: those from the first grid's begin to the last one's end.
        recipe, params: of the sample.
        window: the crop in the picture of the sensor.
        out: arrays of :data:`v2v_protocol.sample.ARRAYS` made of events, by name, C-contiguous.
    """
    top, left, height, width = window
    # Unsigned: what is above or left of the crop wraps to large numbers.
    x, y = events.x - np.uint16(left), events.y - np.uint16(top)
    inside = np.flatnonzero((x < width) & (y < height))
    shown, column = events.take(inside), x[inside].astype(np.int64)
    pixel = y[inside] * np.int64(width) + (width - 1 - column if params.flip else column)
    bounds = (np.searchsorted(each.t_ns, edges, "left") for each in (events, shown) for edges in grids)
    latest = np.full((2, height * width), -np.inf)
    clipped = dict.fromkeys(out, 0)
    for grid, (first, last, start, end) in enumerate(zip(*map(np.ndarray.tolist, bounds), strict=True)):
        spans_events = recipe.bin_span == "events" and first < last
        begin_ns, end_ns = int(grids.begin_ns[grid]), int(grids.end_ns[grid])
        if spans_events:
            begin_ns, end_ns = int(events.t_ns[first]), int(events.t_ns[last - 1])
        seen = _Seen(shown.part(start, end), pixel[start:end], begin_ns, end_ns, spans_events, recipe.bins, latest)
        for name, target in out.items():
            clipped[name] += _store(_MAKERS[name](seen).reshape(target.shape[1:]), target[grid])
    if params.added:
        for name in out.keys() & {"voxels", "voxels_bilinear"}:
            _add_noise(params, out[name].reshape(-1, height * width))
    return {name: count for name, count in clipped.items() if count}


class _Seen(NamedTuple):
    """The events of a grid in the crop.

    Attributes:
        pixel: [n] places in the crop.
        begin_ns, end_ns: of the time that the bins divide.
        latest: [2, pixels] time of the last event of each polarity, ns; -inf before the first one.
    """

    events: EventChunk
    pixel: npt.NDArray[np.int64]
    begin_ns: int
    end_ns: int
    spans_events: bool
    bins: int
    latest: npt.NDArray[np.float64]

    def positions(self, kind: str) -> npt.NDArray[np.float64]:
        """Return where each event lies in the grid, [n], see :func:`v2v_recordings.binning.positions`."""
        tau_us = np.rint((self.events.t_ns - self.begin_ns) / 1000)
        length_us = float(np.rint((self.end_ns - self.begin_ns) / 1000))
        return positions(kind, tau_us, length_us, spans_events=self.spans_events)

    def sums(self, kind: str, polarity: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the sums of the bins, [bins, pixels]."""
        return bin_events(kind, self.positions(kind), self.pixel, polarity, self.bins, self.latest.shape[1])

    def voxels(self, kind: str = "discrete") -> npt.NDArray[np.float64]:
        """Return the voxel grid, [bins, pixels]."""
        return self.sums(kind, 2.0 * self.events.p - 1.0)

    def bilinear(self) -> npt.NDArray[np.float64]:
        """Return the interpolated grid, [bins, pixels]."""
        return self.voxels("interpolated")

    def counts(self) -> npt.NDArray[np.float64]:
        """Return the events of each polarity, [2, bins, pixels]."""
        return np.stack([self.sums("discrete", (self.events.p == polarity) * 1.0) for polarity in (False, True)])

    def ages(self) -> npt.NDArray[np.float64]:
        """Return the ages of the last events at the ends of the bins, [2, bins, pixels] seconds."""
        ends = np.searchsorted(bins_of(self.positions("discrete"), self.bins), np.arange(self.bins), "right")
        ages, bin_ns, done = (
            np.empty((2, self.bins, self.latest.shape[1])),
            (self.end_ns - self.begin_ns) / self.bins,
            0,
        )
        for number, end in enumerate(ends.tolist()):
            part = slice(done, end)
            # Of several events of a pixel the last one stays.
            self.latest[self.events.p[part].astype(np.intp), self.pixel[part]] = self.events.t_ns[part]
            ages[:, number] = np.maximum(self.begin_ns + (number + 1) * bin_ns - self.latest, 0.0) * 1e-9
            done = end
        return ages


_MAKERS = {
    "voxels": _Seen.voxels,
    "voxels_bilinear": _Seen.bilinear,
    "event_counts": _Seen.counts,
    "time_surface": _Seen.ages,
}


def _store(values: npt.NDArray[Any], target: npt.NDArray[Any]) -> int:
    """Store values as the dtype of the target, clipped to what it holds; return how many were clipped."""
    is_whole = target.dtype.kind == "i"
    most = float(np.iinfo(target.dtype).max if is_whole else np.finfo(target.dtype).max)
    beyond = int(np.count_nonzero((np.abs(values) > most) & np.isfinite(values)))
    target[...] = np.clip(values, -most, most) if beyond else values
    return beyond


def _add_noise(params: SampleParams, flat: npt.NDArray[Any]) -> None:
    """Add the drawn noise to every bin, [grids x bins, pixels] float, and to hot pixels the same in all."""
    added, size = params.added, flat.size
    if sigma := added["added_sigma"]:
        half = np.arange(-(-size // 2))
        pairs = noise.box_muller(*(words(params.noise_key, purpose, half) for purpose in (NOISE_RADIUS, NOISE_ANGLE)))
        flat += (np.float32(sigma) * np.concatenate(pairs)[:size]).reshape(flat.shape)
    count = int(added["added_hot_share"] * flat.shape[1] + 0.5)
    position, normals = hot_pixels(params.noise_key, count, flat.shape[1])
    flat[:, position] += np.float32(added["added_hot_sigma"]) * normals
