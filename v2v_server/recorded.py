"""Arrays of a sample made of recorded events: the counterpart of the pixel kernel.

A grid holds the events with begin <= t < end. :mod:`v2v_recordings.binning` has the law of its bins, with times in
whole microseconds, rounded to even. Sums are rounded once, at the end.

    bin_span grid    bins are equal parts of the time of the grid
    bin_span events  of that from its first event to its last, on the whole sensor: the released code of E2VID and V2V
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_recordings.binning import NEVER, EventsOfCrop, bin_events, bins_of, positions
from v2v_server.simulation import noise
from v2v_server.simulation.pixel import hot_pixels, words

NOISE_RADIUS, NOISE_ANGLE = 1020, 1021
"""Purposes of the words of added noise (``noise.py``)."""
_AT_ONCE = 1 << 13
"""Pairs of normals that are made at once, within the processor's cache."""


def fill_arrays(
    events: EventsOfCrop, edges_ns: npt.NDArray[np.int64], recipe: Recipe, params: SampleParams,
    out: Mapping[str, npt.NDArray[Any]],
) -> dict[str, int]:  # fmt: skip
    """Fill the requested arrays of a sample, and return how many values of each had to be clipped.

    Args:
        events: of the grids.
        edges_ns: [grids + 1] where these begin and end; a paused one is empty.
        recipe, params: of the sample.
        out: arrays of :data:`v2v_protocol.sample.ARRAYS` made of events, by name, C-contiguous.
    """
    pixels, clipped = recipe.crop_height_px * recipe.crop_width_px, dict.fromkeys(out, 0)
    latest = np.full((2, pixels), -np.inf)
    parts = np.searchsorted(events.t_ns, edges_ns, "left").tolist()
    for grid, (times_ns, span_ns) in enumerate(zip(pairwise(edges_ns.tolist()), events.span_ns.tolist(), strict=True)):
        part = slice(parts[grid], parts[grid + 1])
        spans_events = recipe.bin_span == "events" and span_ns[0] != NEVER
        begin_ns, end_ns = span_ns if spans_events else times_ns
        seen = _Seen(
            events.t_ns[part], events.pixel[part], events.brighter[part], begin_ns, end_ns, spans_events, recipe.bins,
            latest,
        )  # fmt: skip
        for name, target in out.items():
            clipped[name] += _store(_MAKERS[name](seen).reshape(target.shape[1:]), target[grid])
    if params.added:
        for name in out.keys() & {"voxels", "voxels_bilinear"}:
            _add_noise(params, out[name].reshape(-1, pixels))
    return {name: count for name, count in clipped.items() if count}


class _Seen(NamedTuple):
    """The events of a grid in the crop.

    Attributes:
        t_ns, pixel, brighter: [n] of each event, see :class:`EventsOfCrop`.
        begin_ns, end_ns: of the time that the bins divide.
        spans_events: whether it is that from the first event to the last one, on the whole sensor.
        bins: of a grid.
        latest: [2, pixels] time of the last event of each polarity, ns; -inf before the first one.
    """

    t_ns: npt.NDArray[np.int64]
    pixel: npt.NDArray[np.int64]
    brighter: npt.NDArray[np.bool_]
    begin_ns: int
    end_ns: int
    spans_events: bool
    bins: int
    latest: npt.NDArray[np.float64]

    def positions(self, kind: str) -> npt.NDArray[np.float64]:
        """Return where each event lies in the grid, [n], see :func:`v2v_recordings.binning.positions`."""
        tau_us, length_us = np.rint((self.t_ns - self.begin_ns) / 1000), np.rint((self.end_ns - self.begin_ns) / 1000)
        return positions(kind, tau_us, float(length_us), spans_events=self.spans_events)

    def voxels(self, kind: str = "discrete") -> npt.NDArray[np.float64]:
        """Return the voxel grid, [bins, pixels]."""
        polarity = 2.0 * self.brighter - 1.0
        return bin_events(kind, self.positions(kind), self.pixel, polarity, self.bins, self.latest.shape[1])

    def counts(self) -> npt.NDArray[np.int64]:
        """Return the events of each polarity, [2, bins, pixels]."""
        cells = (self.brighter * self.bins + bins_of(self.positions("discrete"), self.bins)) * self.latest.shape[1]
        return np.bincount(cells + self.pixel, minlength=self.bins * self.latest.size)

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
            self.latest[self.brighter[part].astype(np.intp), self.pixel[part]] = self.t_ns[part]
            ages[:, number] = np.maximum(self.begin_ns + (number + 1) * bin_ns - self.latest, 0.0) * 1e-9
            done = end
        return ages


_MAKERS: Mapping[str, Callable[[_Seen], npt.NDArray[Any]]] = {
    "voxels": _Seen.voxels,
    "voxels_bilinear": partial(_Seen.voxels, kind="interpolated"),
    "event_counts": _Seen.counts,
    "time_surface": _Seen.ages,
}


def _store(values: npt.NDArray[Any], target: npt.NDArray[Any]) -> int:
    """Store values as the dtype of the target, clipped to what it holds; return how many were clipped."""
    limits = np.iinfo(target.dtype) if target.dtype.kind == "i" else np.finfo(target.dtype)
    most, beyond = float(limits.max), 0
    if not -most <= values.min() <= values.max() <= most:
        is_beyond = (np.abs(values) > most) & np.isfinite(values)
        values, beyond = np.where(is_beyond, np.clip(values, -most, most), values), int(np.count_nonzero(is_beyond))
    target[...] = values
    return beyond


def _add_noise(params: SampleParams, flat: npt.NDArray[Any]) -> None:
    """Add the drawn noise to every bin, [grids x bins, pixels] float, and to hot pixels the same in all."""
    added, values = params.added, flat.reshape(-1)
    half = -(-len(values) // 2)
    for first in range(0, half if added["added_sigma"] else 0, _AT_ONCE):
        at = np.arange(first, min(first + _AT_ONCE, half))
        pairs = noise.box_muller(*(words(params.noise_key, purpose, at) for purpose in (NOISE_RADIUS, NOISE_ANGLE)))
        for start, normals in zip((first, half + first), pairs, strict=True):
            part = values[start : start + len(at)]
            part += np.float32(added["added_sigma"]) * normals[: len(part)]
    count = int(added["added_hot_share"] * flat.shape[1] + 0.5)
    position, normals = hot_pixels(params.noise_key, count, flat.shape[1])
    flat[:, position] += np.float32(added["added_hot_sigma"]) * normals
