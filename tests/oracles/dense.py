"""Event cameras simulated one event and one pixel at a time: the reference of the voxel simulation.

Nothing here is shared with the kernel but the equations of the pixel model (``v2v_protocol.recipe``) and the rule of
``v2v_server/simulation/voxel.py`` about when a change counts.

:func:`dense_events` is the ordinary way: every frame of a high-rate clip, every event with its own time (the log
intensity is taken to be linear between frames, as in ESIM: Rebecq et al., CoRL 2018), binned afterwards. :func:`trace`
follows the model in the arithmetic of its arguments and gives away the residual, which the kernel keeps to itself.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

Levels = npt.NDArray[np.float64]


class Events(NamedTuple):
    """A stream of events, ordered by pixel, then by time.

    Attributes:
        pixel: [events] int32, row order.
        seconds: [events] float64.
        polarity: [events] int8, +1 or -1.
    """

    pixel: npt.NDArray[np.int32]
    seconds: npt.NDArray[np.float64]
    polarity: npt.NDArray[np.int8]


def dense_events(
    levels: Levels, seconds: Levels, start: Levels, threshold_pos: float, threshold_neg: float, tolerance: float = 0.0
) -> Events:
    """Return every event of a clip, float64, without noise.

    Args:
        levels: [n, pixels] log intensity.
        seconds: [n] time of each frame, increasing; or [n, pixels], a clock for each pixel.
        start: [pixels] residual before the first step, log units.
        threshold_pos, threshold_neg, tolerance: log units.
    """
    levels = np.ascontiguousarray(levels, np.float64)
    clock = np.ascontiguousarray(np.broadcast_to(seconds.reshape(len(levels), -1), levels.shape))
    none = Events(np.empty(0, np.int32), np.empty(0), np.empty(0, np.int8))
    count = _walk(levels, clock, start, threshold_pos, threshold_neg, tolerance, *none, False)
    events = Events(np.empty(count, np.int32), np.empty(count), np.empty(count, np.int8))
    _walk(levels, clock, start, threshold_pos, threshold_neg, tolerance, *events, True)
    return events


def bin_events(events: Events, edges: Levels, pixels: int) -> npt.NDArray[np.int64]:
    """Return signed counts [bins, pixels].

    Bin b holds edges[b] < seconds <= edges[b + 1]: an event at the time of a frame belongs to the step that ends there.
    """
    bins = len(edges) - 1
    place = np.searchsorted(edges, events.seconds, side="left") - 1
    inside = (place >= 0) & (place < bins)
    cell = place[inside] * pixels + events.pixel[inside]
    rising, falling = (np.bincount(cell[events.polarity[inside] == sign], minlength=bins * pixels) for sign in (1, -1))
    return (rising - falling).reshape(bins, pixels)


@numba.njit(cache=True)
def _walk(levels, clock, start, threshold_pos, threshold_neg, tolerance, pixel, seconds, polarity, write):
    """Count the events; with ``write`` also write them."""
    made = 0
    for p in range(levels.shape[1]):
        residual = start[p]
        for step in range(levels.shape[0] - 1):
            before = residual
            change = levels[step + 1, p] - levels[step, p]
            potential = before + change
            sign = 1 if potential >= 0.0 else -1
            threshold = threshold_pos if sign > 0 else threshold_neg
            fired = int(np.floor((abs(potential) + tolerance) / threshold))
            if write:
                begin, duration = clock[step, p], clock[step + 1, p] - clock[step, p]
                for k in range(1, fired + 1):
                    # A start on the threshold itself may fire without any change: at once.
                    share = (sign * k * threshold - before) / change if change != 0.0 else 0.0
                    pixel[made], polarity[made] = p, sign
                    seconds[made] = begin + min(max(share, 0.0), 1.0) * duration
                    made += 1
            else:
                made += fired
            residual = potential - sign * fired * threshold
    return made


class Trace(NamedTuple):
    """The result of :func:`trace`.

    Attributes:
        counts: [steps, pixels] signed events, in the arithmetic of the trace.
        residual_start, residual_end: [pixels], log units.
        residual_low, residual_high: extremes that any residual took after a step.
    """

    counts: npt.NDArray[Any]
    residual_start: npt.NDArray[Any]
    residual_end: npt.NDArray[Any]
    residual_low: float
    residual_high: float


def trace(
    levels: npt.NDArray[Any],
    noise: npt.NDArray[Any],
    hot: npt.NDArray[Any],
    start: npt.NDArray[Any],
    threshold_pos: float | np.floating[Any],
    threshold_neg: float | np.floating[Any],
    tolerance: float,
) -> Trace:
    """Run the pixel model, step by step, in the arithmetic (float32 or float64) of ``levels``.

    Args:
        levels: [steps + 1, pixels] log intensity.
        noise: [steps, pixels] noise of each step, log units; [0, 0] for none.
        hot: [pixels] drift of each step, log units.
        start: [pixels] residual before the first step, log units.
        threshold_pos, threshold_neg, tolerance: log units.
    """
    real = levels.dtype.type
    residual = start.astype(real)
    counts = np.zeros((len(levels) - 1, levels.shape[1]), real)
    low, high = _trace(
        levels, noise.astype(real), hot.astype(real), residual, real(threshold_pos), real(threshold_neg),
        real(tolerance), counts,
    )  # fmt: skip
    return Trace(counts, start.astype(real), residual, float(low), float(high))


@numba.njit(cache=True, error_model="numpy")
def _trace(levels, noise, hot, residual, threshold_pos, threshold_neg, tolerance, counts):
    low, high = residual[0], residual[0]
    for p in range(levels.shape[1]):
        for step in range(levels.shape[0] - 1):
            # The order of the kernel: drift to the residual, then change and noise together.
            drifted = residual[p] + hot[p]
            change = levels[step + 1, p] - levels[step, p]
            if len(noise):
                change += noise[step, p]
            potential = drifted + change
            rising = potential >= tolerance - tolerance
            threshold = threshold_pos if rising else threshold_neg
            events = np.floor((abs(potential) + tolerance) / threshold)
            signed = events if rising else -events
            residual[p] = potential - signed * threshold
            counts[step, p] = signed
            low, high = min(low, residual[p]), max(high, residual[p])
    return low, high
