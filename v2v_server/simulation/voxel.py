"""THE definition of a bin: which step falls where, how long it lasts, when a change counts, what a dtype holds.

Steps. Step s (0 .. steps-1) is the change from frame s to frame s+1 of the clip. Bin b of voxel t sums the signed event
counts of the ``frames_per_bin`` consecutive steps that start at ``(t * bins + b) * frames_per_bin``; so voxel t spans
frames ``t * bins * frames_per_bin`` to ``(t + 1) * bins * frames_per_bin``, its ends included. With ``grids_per_frame``
n, each step has n grids, and its n x bins bins are equal parts of its time. With ``voxel_seconds``, a grid spans whole
steps, and its bins are equal parts of its time.

Time. Within a step the log intensity is linear in time, between the frames or between intermediate levels if there are
any. Noise, hot drift and leak of the step are spread evenly over it. So a step is a row of segments (:class:`Timeline`)
in which everything is linear and which lie in one bin, and the rule below holds for every segment. Where a step lies in
one bin it is one segment. In a segment of change D that starts at the residual r, event k (1, 2 ...) happens at the
share (k c - r) / D of its time for rising D, and (k c + r) / -D for falling D.

Counting. The threshold crossings of a segment are decided together, with d = (residual + hot drift) + (change of log
intensity + noise), in this order:

    count    = floor((|d| + tolerance) / c)        c = threshold_pos where d >= 0, else threshold_neg
    residual = d - sign(d) * c * count
    V(bin)  += sign(d) * count

``tolerance`` makes the paper's plain floor well defined in float32. Log intensities are known to half a unit in the
last place (2**-22 where |L| > 4), and every step rounds a residual of the size of c; without a tolerance, whether an
exact multiple of c has been reached is decided by these roundings. :func:`rounding_tolerance` has a part for each.
With it every exact ramp tried counts exactly: 1 to 100 thresholds of 0.05 to 2, over 5 to 200 steps, anywhere between
black and white; half of it misses 2 % of them. It moves an event by a step where a change misses its threshold by
less: against the plain floor in float64 up to 60 bins in a million at c = 0.05 on natural clips, up to 3 at c >= 1.

Dtypes. A sum is made in floating point (exact up to 2**24) and stored in int8 clipped to -127 .. 127, in int16 clipped
to -32767 .. 32767, or in float32 as it is. Clipped bins are counted, never wrapped.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

Doubles = npt.NDArray[np.float64]
Longs = npt.NDArray[np.int64]
LARGEST_COUNT = {"int8": 127.0, "int16": 32767.0, "float32": np.inf}
"""Largest magnitude of a bin that the dtype stores."""


class Moments(NamedTuple):
    """Ascending moments of a clip.

    Attributes:
        step: [n] int64, the step from frame to frame that each lies in.
        share: [n] float64, the part of the step's time that has passed then, 0 to below 1.
    """

    step: Longs
    share: Doubles


_SHORTEST_SHARE = 1e-6
"""Part of a step's time below which the end of a bin counts as that of the step."""
FINE_STEPS = 16
"""Parts of a grey level that levels between frames are known to."""


class Levels(NamedTuple):
    """Grey levels between frames, for instance along the motion.

    Attributes:
        at: their K moments, ascending, none at a frame (share 0) and none in a step that shows the same frame twice.
        grey: [K, H, W] uint16; beside frames of 8 bits, in 1/FINE_STEPS of a grey level, 0 .. 255 FINE_STEPS, and
            between two grey levels the natural logarithm of the intensity is linear; beside deeper frames, levels of
            their signal. Between two neighbouring levels, and between a level and a frame, it is linear in time.
    """

    at: Moments
    grey: npt.NDArray[np.uint16]


class Timeline(NamedTuple):
    """A clip's G segments, in order of time.

    Attributes:
        step: [G] int64, the step that holds the segment.
        start, share: [G] float64, the part of the step's time that has passed before it, and its own part, above 0.
        level: [G] int64, the known log intensity at or after its end: a position of the clip (1 .. steps), or -1 - k
            for intermediate level k.
        reached: [G] float64, its end between the known level before and that one, above 0; 1 is that level.
        bin: [G] int64, ascending from 0.
        place: [2, G] float64, where in its voxel grid it starts and how much of it it takes, in bins.
    """

    step: Longs
    start: Doubles
    share: Doubles
    level: Longs
    reached: Doubles
    bin: Longs
    place: Doubles


def bin_edges(steps: int, frames_per_bin: int, bins_per_step: int = 1) -> Moments:
    """Return the ends of equal bins, the clip's start included: of ``frames_per_bin`` steps, or of a part of a step."""
    parts = np.arange(0, steps * bins_per_step + 1, frames_per_bin)
    return Moments(parts // bins_per_step, parts % bins_per_step / bins_per_step)


def timed_edges(ends: Longs, bins: int, durations: Doubles) -> Moments:
    """Return the ends of bins that are equal parts of the time of their grid, the clip's start included.

    Args:
        ends: [grids + 1] positions of the clip between which the grids lie.
        bins: bins of a grid.
        durations: [steps] of each step.
    """
    since = np.concatenate(([0.0], np.cumsum(durations)))
    first, last = since[ends[:-1], None], since[ends[1:], None]
    inner = first + (last - first) * (np.arange(1, bins) / bins)
    step = np.searchsorted(since, inner, side="right") - 1
    share = (inner - since[step]) / durations[step]
    # A frame may lie at the end of a bin; rounding must not make a segment between them.
    is_next = share > 1.0 - _SHORTEST_SHARE
    step, share = step + is_next, np.where(is_next | (share < _SHORTEST_SHARE), 0.0, share)
    steps = np.column_stack([step, ends[1:]]).ravel()
    shares = np.column_stack([share, np.zeros(len(ends) - 1)]).ravel()
    return Moments(np.concatenate(([0], steps)), np.concatenate(([0.0], shares)))


def frame_times(durations: Doubles) -> Doubles:
    """Return the time of each frame since the clip's start, [steps + 1], in the unit of the durations, [steps]."""
    return np.concatenate(([0.0], np.cumsum(durations)))


def time_of(moments: Moments, durations: Doubles, since: Doubles | None = None) -> Doubles:
    """Return the time of each moment, [n], in the unit of the durations, [steps].

    ``since``: [steps + 1] time of each frame; None counts from the clip's start.
    """
    since = frame_times(durations) if since is None else since
    return np.asarray(since[moments.step] + moments.share * np.append(durations, 0.0)[moments.step])


def timeline(
    edges: Moments, bins: int, durations: Doubles, levels: Moments | None = None, others: Moments | None = None
) -> Timeline:
    """Divide a clip into segments at its frames, at the edges of its bins, at intermediate levels and other moments.

    Args:
        edges: [M + 1] ends of the bins, from the clip's start to its end.
        bins: bins of a voxel grid.
        durations: [steps] of each step, in any unit.
        levels: moments of intermediate levels.
        others: further moments.
    """
    steps = len(durations)
    frames, none = Moments(np.arange(steps + 1), np.zeros(steps + 1)), Moments(np.empty(0, np.int64), np.empty(0))
    parts = frames, edges, levels or none, others or none
    step, share = (np.concatenate([np.asarray(part[axis]) for part in parts]) for axis in (0, 1))
    kind = np.repeat(np.arange(4), [len(part.step) for part in parts])
    number = np.concatenate([np.arange(len(part.step)) for part in parts])
    order = np.lexsort((kind, share, step))
    step, share, kind, number = step[order], share[order], kind[order], number[order]
    first = np.r_[True, (np.diff(step) > 0) | (np.diff(share) > 0)]
    moment = np.cumsum(first) - 1  # of each entry
    step, share = step[first], share[first]
    is_known = np.zeros(len(step), np.bool_)
    is_known[moment[kind % 2 == 0]] = True
    level = np.zeros(len(step), np.int64)
    level[moment[kind == 2]] = -1 - number[kind == 2]
    level[moment[kind == 0]] = number[kind == 0]
    known = np.flatnonzero(is_known)
    piece = np.cumsum(is_known)[:-1] - 1
    before, after = known[piece], known[piece + 1]

    def passed(later: Longs, earlier: Longs) -> Doubles:
        length: Doubles = np.where(step[later] > step[earlier], 1.0, share[later]) - share[earlier]
        return length

    start = np.arange(len(step) - 1)
    length = passed(start + 1, start)
    bin_of = np.cumsum(np.bincount(moment[kind == 1], minlength=len(step)))[:-1] - 1
    lasts = durations[step[:-1]] * length
    since = np.r_[0.0, np.cumsum(lasts)]
    grid = bin_of // bins
    begin = np.searchsorted(grid, np.arange(grid[-1] + 2))
    total = since[begin[1:]] - since[begin[:-1]]
    place = np.stack([since[:-1] - since[begin[grid]], lasts]) * bins / total[grid]
    reached = np.where(after == start + 1, 1.0, passed(start + 1, before) / passed(after, before))
    return Timeline(step[:-1], share[:-1], length, level[after], reached, bin_of, place)


def rounding_tolerance(threshold_pos: float, threshold_neg: float) -> float:
    """Return by how much, in log units, a change may miss a threshold and still count as reaching it.

    With c the smaller threshold: 2**-21, or c * 2**-19 if that is more; never more than c / 16.
    """
    smaller = min(threshold_pos, threshold_neg)
    return min(max(2.0**-21, smaller * 2.0**-19), smaller * 2.0**-4)


def new_array(dtype: str, shape: tuple[int, ...], out: npt.NDArray[Any] | None = None) -> npt.NDArray[Any]:
    """Return an uninitialised array [*shape], or ``out`` if it is given.

    Raises:
        UsageError: ``out`` is not such an array.
    """
    if out is None:
        return np.empty(shape, np.dtype(dtype))
    if out.shape != shape or out.dtype.name != dtype or not out.flags.c_contiguous:
        raise UsageError(f"out {out.dtype}{list(out.shape)}: give {dtype}{list(shape)}, C-contiguous")
    return out


def step_seconds(seconds: Doubles, source_index: Longs, average_fps: float) -> tuple[Doubles, int]:
    """Return the durations of the steps of a clip.

    Args:
        seconds: [count] presentation time of each decoded frame; NaN if the file gives none.
        source_index: [steps + 1], which decoded frame each position shows (``SampleParams.source_index``).
        average_fps: frames per second of the video; used if two time stamps do not increase. A paused step lasts one
            average frame too.

    Returns:
        durations [steps] float64, all > 0; number of steps that are not paused and had to use the average.

    Raises:
        UsageError: fewer time stamps than frames, or an average rate that is not a positive finite number.
    """
    if not (np.isfinite(average_fps) and average_fps > 0):
        raise UsageError(f"average_fps = {average_fps}: noise per second needs the video's frame rate")
    if len(seconds) <= int(source_index[-1]):
        raise UsageError(f"{len(seconds)} time stamps for {int(source_index[-1]) + 1} frames: give one per frame")
    shown = np.asarray(seconds, np.float64)[source_index]
    with np.errstate(invalid="ignore"):
        elapsed = shown[1:] - shown[:-1]
    regular = np.isfinite(elapsed) & (elapsed > 0)
    paused = source_index[1:] == source_index[:-1]
    return np.where(regular, elapsed, 1.0 / average_fps), int(np.count_nonzero(~regular & ~paused))
