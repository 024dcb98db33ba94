"""Arrays of a sample made of recorded events: the counterpart of the pixel kernel.

A grid holds the events with begin <= t < end. With u the position of an event in its grid and B bins,

    bin             floor(B u)
    bilinear        V[b] += p max(0, 1 - |(B - 1) u - b|)                           (Zhu et al. 2019)

    bin_span grid   u = tau / (end - begin), tau the time since begin
    bin_span events u = tau / (D + delta), tau the time since the first event, D that of the last; delta is 1 ns for
                    bins and 0.1 ns for bilinear ones: the released code of E2VID and V2V

All times are whole microseconds by then, rounded to even, as evaluation takes them (``trainer.evaluation.voxelise``).
Sums are float64, in the order of the events, and rounded once. Only operations that IEEE 754 rounds correctly are used,
so all hosts get the same bytes.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.recorded.blocks import PackedEvents
from v2v_server.simulation import noise
from v2v_server.simulation.pixel import hot_pixels, words
from v2v_server.video.picture import PixelRect

NOISE_RADIUS, NOISE_ANGLE = 1020, 1021
"""Purposes of the words of added noise (``noise.py``)."""
_DELTA_US = 1e-3, 1e-4
_BELOW_ONE = np.nextafter(1.0, 0.0)


class Grids(NamedTuple):
    """When the voxel grids of a sample begin and end, [G] int64 nanoseconds each; a paused one is empty."""

    begin_ns: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]


@numba.njit(nogil=True, cache=True)
def _microseconds(ns):
    """Return whole microseconds, rounded to even."""
    whole = ns // 1000
    rest = ns - 1000 * whole
    return whole + (rest > 500 or (rest == 500 and whole % 2 == 1))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _add_events(t_ns, packed, begin_ns, end_ns, spans_events, window, is_flipped, latest, counts, shared, ages):
    """Add the events of one grid.

    Args:
        t_ns, packed: [n] the events (:class:`PackedEvents`).
        begin_ns, end_ns: of the grid.
        spans_events: whether the bins span the events.
        window: (top, left, height, width) of the crop.
        latest: [2, pixels] int64, time of the last event of each polarity; is changed.
        counts: [2, bins, pixels] int32, zeros; receives the events.
        shared: [2, bins, pixels] float64, zeros; receives the lower and the upper shares, or nothing if empty.
        ages: [2, bins, pixels] float32, receives the age of the last event, seconds, or nothing if empty.
    """
    top, left, height, width = window
    bins, count, done = counts.shape[1], len(t_ns), 0
    origin, length = begin_ns, float(max(1, _microseconds(end_ns - begin_ns)))
    if spans_events:
        origin, length = t_ns[0], float(_microseconds(t_ns[-1] - t_ns[0]))
    step_ns = (end_ns - begin_ns) / bins
    if spans_events:
        step_ns = (t_ns[-1] - t_ns[0]) / bins
    for i in range(count):
        tau = float(_microseconds(t_ns[i] - origin))
        place = tau / (length + _DELTA_US[0]) if spans_events else min(tau / length, _BELOW_ONE)
        bin = int(bins * place)
        while len(ages) > 0 and done < bin:
            done += 1
            _store_ages(ages, done - 1, latest, origin + done * step_ns)
        polarity = packed[i] & np.uint32(1)
        x = np.int64(packed[i] >> np.uint32(1) & np.uint32(4095)) - left
        y = np.int64(packed[i] >> np.uint32(13)) - top
        if x < 0 or x >= width or y < 0 or y >= height:
            continue
        pixel = y * width + (width - 1 - x if is_flipped else x)
        counts[polarity, bin, pixel] += 1
        latest[polarity, pixel] = t_ns[i]
        if len(shared) > 0:
            if spans_events:
                place = tau / (length + _DELTA_US[1])
            position, sign = (bins - 1) * place, 1.0 if polarity else -1.0
            lower = int(position)
            share = position - lower
            shared[0, lower, pixel] += sign * (1.0 - share)
            if lower + 1 < bins:
                shared[1, lower + 1, pixel] += sign * share
    while len(ages) > 0 and done < bins:
        done += 1
        _store_ages(ages, done - 1, latest, origin + done * step_ns)


@numba.njit(nogil=True, cache=True)
def _store_ages(ages, bin, latest, end_ns):
    for polarity in range(2):
        for pixel in range(latest.shape[1]):
            last = latest[polarity, pixel]
            ages[polarity, bin, pixel] = np.inf if last == NEVER else max(end_ns - last, 0.0) * 1e-9


NEVER = np.iinfo(np.int64).min


def fill_arrays(
    events: PackedEvents, grids: Grids, recipe: Recipe, params: SampleParams, window: PixelRect,
    out: Mapping[str, npt.NDArray[Any]],
) -> dict[str, int]:  # fmt: skip
    """Fill the requested arrays of a sample, and return how many values of each had to be clipped.

    Args:
        events: those from the first grid's begin to the last one's end.
        recipe, params: of the sample.
        window: the crop in the picture of the sensor.
        out: arrays of :data:`v2v_protocol.sample.ARRAYS` made of events, by name, C-contiguous.
    """
    bins, (height, width), clipped = recipe.bins, recipe.crop_px, dict.fromkeys(out, 0)
    latest = np.full((2, height * width), NEVER)
    counts, none = np.empty((2, bins, height * width), np.int32), np.empty((0, bins, height * width))
    shared = np.empty(counts.shape) if "voxels_bilinear" in out else none
    ages = np.empty(counts.shape, np.float32) if "time_surface" in out else none.astype(np.float32)
    firsts, lasts = (np.searchsorted(events.t_ns, each, "left") for each in grids)
    for grid, (first, last) in enumerate(zip(firsts.tolist(), lasts.tolist(), strict=True)):
        counts[:], shared[:] = 0, 0
        some = events.part(first, last)
        _add_events(
            some.t_ns, some.packed, grids.begin_ns[grid], grids.end_ns[grid],
            recipe.bin_span == "events" and first < last, window, params.flip, latest, counts, shared, ages,
        )  # fmt: skip
        made = {"voxels": counts[1] - counts[0], "event_counts": counts, "time_surface": ages}
        if len(shared):
            made["voxels_bilinear"] = shared[0] + shared[1]
        for name, target in out.items():
            clipped[name] += _store(made[name].reshape(target.shape[1:]), target[grid])
    if params.added:
        for name in out.keys() & {"voxels", "voxels_bilinear"}:
            _add_noise(params, out[name].reshape(-1, height * width))
    return {name: count for name, count in clipped.items() if count}


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
