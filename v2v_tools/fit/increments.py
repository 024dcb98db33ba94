"""Measure a recording pixel by pixel: changes of brightness beside events, still stretches, intervals.

An **increment** joins two frames of a pixel. Events give the level of the pixel between two events of one polarity:
linear in time, because the path from one to the next is short. So the number of events between two frames has
fractions, no residual of unknown size is left, and a regression on it is not biased by one.

During the refractory period r a change is lost. Where events of one polarity follow each other after an interval I, the
change lasted I and was seen for I - r: the second event counts I / (I - r).
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_tools.fit.recording import Recorded

Doubles = npt.NDArray[np.float64]
DARKEST_GREY, BRIGHTEST_GREY = 4, 251
"""Grey levels outside are clipped, or too coarse in log intensity."""
_LONGEST_SECONDS = 0.5
"""Longest increment: noise accumulates with time."""
STILL_SECONDS = 0.5
"""A recording that stands still as a whole for this long needs no other still time."""
_MOST_WEIGHT = 10.0
MOST_INCREMENTS = 1_500_000
"""Of a recording with more, every n-th pixel is measured."""


class Increments(NamedTuple):
    """Changes of M increments, [M] each.

    Attributes:
        pixel: index of the pixel.
        block: part of the time, 0 .. 3, of its first frame.
        seconds: duration.
        grey: [2, M] grey level at both ends; light, slope: its light, 0 .. 1, and the change of light with the level.
        on, off: events, with fractions.
        speed: [2, M] signed events a second at both ends.
    """

    pixel: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]
    seconds: Doubles
    grey: Doubles
    on: Doubles
    off: Doubles
    speed: Doubles
    light: Doubles
    slope: Doubles

    def take(self, which: npt.NDArray[Any]) -> Increments:
        """Return some of the increments, by a mask, [M], or by places, [n]."""
        return Increments(*(column[..., which] for column in self))  # type: ignore[arg-type]


class Still(NamedTuple):
    """Time in which the frames of a pixel show no change, by pixel and quarter of the recording: [P, 4] each.

    Attributes:
        seconds: duration.
        light: sum of light x seconds, light 0 (black) .. 1 (white).
        on, off: events.
    """

    seconds: Doubles
    light: Doubles
    on: Doubles
    off: Doubles


def increments_of(recording: Recorded, refractory_seconds: float, longest_us: float) -> Increments:
    """Return the increments of all pixels.

    Args:
        refractory_seconds: refractory period.
        longest_us: longest interval of the two events around a frame.
    """
    most = min(len(recording.t_us), recording.frames.size)
    stride = 1 + most // MOST_INCREMENTS
    table = np.empty((9, min(most, MOST_INCREMENTS)))
    count = _walk_frames(
        recording.first, recording.t_us, recording.p, recording.frames, recording.frame_us, stride, longest_us,
        1e6 * refractory_seconds, 1e6 * _LONGEST_SECONDS, table,
    )  # fmt: skip
    pixel, begin, end, grey_1, grey_2, on, off, speed_1, speed_2 = table[:, :count]
    quarter, grey, light_of = _quarter(recording, begin), np.stack([grey_1, grey_2]), recording.known_light.of
    return Increments(
        pixel.astype(np.int64), quarter, (end - begin) * 1e-6, grey, on, off, np.stack([speed_1, speed_2]),
        light_of(grey), light_of(grey + 0.5) - light_of(grey - 0.5),
    )  # fmt: skip


def still_time(recording: Recorded, light: Doubles, settle_seconds: float = 0.1) -> Still:
    """Return the time in which a pixel sees no change, and its events in it.

    Args:
        light: [256] light of each grey level.
        settle_seconds: time after a change that does not count.
    """
    shape = len(recording.pixels), 4
    still = Still(*(np.zeros(shape) for _ in Still._fields))
    if len(recording.frames) < 4:
        return still
    tolerance, usable = _still_steps(recording)
    quarter = _quarter(recording, recording.frame_us)
    _walk_still(
        recording.first, recording.t_us, recording.p, recording.frames, recording.frame_us, light, tolerance, usable,
        1e6 * settle_seconds, quarter, *still,
    )  # fmt: skip
    return still


def _still_steps(recording: Recorded) -> tuple[float, npt.NDArray[np.bool_]]:
    """Return the largest change of grey level that is noise of the frames, and which steps between frames may count.

    Where the whole picture stands still for long enough, only that time counts: elsewhere changes below a grey level
    may go on.
    """
    some = recording.frames[:, :: max(1, recording.frames.shape[1] // 4096)].astype(np.int16)
    differences = np.abs(np.diff(some, axis=0))
    tolerance = 1.0 + 2.0 * float(np.median(differences, axis=1).min())
    still = (differences > tolerance).mean(axis=1) < 0.05
    enough = still.sum() * np.median(np.diff(recording.frame_us)) >= 1e6 * STILL_SECONDS
    return tolerance, np.append(still if enough else np.ones(len(still), bool), False)


def intervals_us(recording: Recorded) -> Doubles:
    """Return the intervals between events of a pixel, and whether both are brighter or both darker: [2, M] float64."""
    if len(recording.t_us) < 2:
        return np.empty((2, 0))
    pixel = np.repeat(np.arange(len(recording.pixels)), np.diff(recording.first))
    same = np.diff(pixel) == 0
    gap = np.diff(recording.t_us)[same].astype(np.float64)
    return np.stack([gap, (recording.p[1:] == recording.p[:-1])[same]])


def _quarter(recording: Recorded, t_us: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    passed = (t_us - recording.begin_us) / max(1e6 * recording.seconds, 1.0)
    return np.clip((4 * passed).astype(np.int64), 0, 3)


@numba.njit(cache=True)
def _walk_frames(first, t, p, frames, frame_us, stride, longest_us, refractory_us, longest_increment_us, out):
    made, count = 0, len(frame_us)
    for i in range(0, len(first) - 1, stride):
        has, on, off, frame = False, 0.0, 0.0, 0
        begin, grey_1, speed_1 = 0.0, 0.0, 0.0
        if first[i + 1] - first[i] < 2:
            continue
        while frame < count and frame_us[frame] < t[first[i]]:
            frame += 1
        for e in range(first[i], first[i + 1] - 1):
            gap = t[e + 1] - t[e]
            counts = p[e] == p[e + 1] and gap > 1.02 * refractory_us
            weight = min(gap / (gap - refractory_us), _MOST_WEIGHT) if counts else 1.0
            while frame < count and frame_us[frame] < t[e + 1]:
                grey = float(frames[frame, i])
                if counts and gap <= longest_us and DARKEST_GREY <= grey <= BRIGHTEST_GREY:
                    part = weight * (frame_us[frame] - t[e]) / gap
                    speed = (1.0 if p[e] else -1.0) * weight / (gap * 1e-6)
                    end = float(frame_us[frame])
                    if has and end - begin <= longest_increment_us and made < out.shape[1]:
                        out[0, made], out[1, made], out[2, made] = i, begin, end
                        out[3, made], out[4, made] = grey_1, grey
                        out[5, made], out[6, made] = on + (part if p[e] else 0.0), off + (0.0 if p[e] else part)
                        out[7, made], out[8, made] = speed_1, speed
                        made += 1
                    has, begin, grey_1, speed_1 = True, end, grey, speed
                    on, off = (-part, 0.0) if p[e] else (0.0, -part)
                frame += 1
            if p[e + 1]:
                on += weight
            else:
                off += weight
    return made


@numba.njit(cache=True)
def _walk_still(first, t, p, frames, frame_us, light, tolerance, usable, settle_us, quarter, seconds, lit, on, off):
    count = len(frame_us)
    for i in range(len(first) - 1):
        begin, event = 0, first[i]
        low = high = float(frames[0, i])
        for frame in range(1, count + 1):
            grey = float(frames[frame, i]) if frame < count else -1e9
            if usable[frame - 1] and max(high, grey) - min(low, grey) <= tolerance:
                low, high = min(low, grey), max(high, grey)
                continue
            # The last step of a run is left out: a change may begin before the frame that shows it.
            last = frame - 2 if frame < count else frame - 1
            run = begin
            while run < last and frame_us[run] < frame_us[begin] + settle_us:
                run += 1
            for k in range(run, last):
                q = quarter[k]
                length = (frame_us[k + 1] - frame_us[k]) * 1e-6
                seconds[i, q] += length
                lit[i, q] += length * light[int(low)]
                while event < first[i + 1] and t[event] < frame_us[k]:
                    event += 1
                while event < first[i + 1] and t[event] < frame_us[k + 1]:
                    if p[event]:
                        on[i, q] += 1
                    else:
                        off[i, q] += 1
                    event += 1
            begin, low, high = frame, grey, grey
