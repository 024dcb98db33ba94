"""Measure a recording pixel by pixel: changes of brightness beside events, still stretches, intervals.

An **increment** joins two frames of a pixel. Events give the level of the pixel between two events of one polarity:
linear in time, because the path from one to the next is short. So the number of events between two frames has
fractions, no residual of unknown size is left, and a regression on it is not biased by one.

During the refractory period r a change is lost. Where events of one polarity follow each other after an interval I, the
change lasted I and was seen for I - r: the second event counts I / (I - r).
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
import numpy.typing as npt

from v2v_tools.fit.recording import Recorded

Doubles = npt.NDArray[np.float64]
DARKEST_GREY, BRIGHTEST_GREY = 4, 251
"""Grey levels outside are clipped, or too coarse in log intensity."""
_LONGEST_SECONDS = 0.5
"""Longest increment: noise accumulates with time."""
_SETTLE_SECONDS, _AROUND_PX = 0.1, 5
"""Time before a still step in which a pixel sees no change either; side of the square of its neighbours."""
_MOST_WEIGHT = 10.0
MOST_INCREMENTS = 1_500_000
"""Of a recording with more, every n-th pixel is measured."""


class Increments(NamedTuple):
    """Changes of M increments, [M] each.

    Attributes:
        pixel: index of the pixel.
        block: part of the time, 0 .. 3, of its first frame.
        seconds: duration.
        light, slope: [2, M] light at both ends, 0 .. 1, and its change with the grey level.
        on, off: events, with fractions.
        speed: [2, M] signed events a second at both ends.
    """

    pixel: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]
    seconds: Doubles
    on: Doubles
    off: Doubles
    speed: Doubles
    light: Doubles
    slope: Doubles

    def take(self, which: npt.NDArray[Any] | slice) -> Increments:
        """Return some of the increments, by a mask, [M], or a slice."""
        return Increments(*(column[..., which] for column in self))  # type: ignore[arg-type]


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
        pixel.astype(np.int64), quarter, (end - begin) * 1e-6, on, off, np.stack([speed_1, speed_2]),
        light_of(grey), light_of(grey + 0.5) - light_of(grey - 0.5),
    )  # fmt: skip


def is_still(recording: Recorded) -> npt.NDArray[np.bool_]:
    """Return in which steps between frames a pixel sees no motion: [n - 1, P].

    Its grey level stays within the noise of the frames from shortly before the step to the frame after it. And the
    pixels around it fire no more than pixels at rest do: noise of pixels is independent, while motion too slow or too
    dark for a grey level, and a low-pass that still settles, reach neighbours too.
    """
    frames = recording.frames
    differences = np.abs(np.diff(frames[:, :: max(1, frames.shape[1] // 4096)].astype(np.int16), axis=0))
    tolerance = 1.0 + 2.0 * float(np.median(differences, axis=1).min())
    before = math.ceil(1e6 * _SETTLE_SECONDS / np.median(np.diff(recording.frame_us)))
    window, anchor = np.ones((before + 3, 1), np.uint8), (0, before)
    spread = cv2.dilate(frames, window, anchor=anchor) - cv2.erode(frames, window, anchor=anchor)
    still = spread[:-1] <= tolerance
    still[:before] = False
    around = _events_around(recording)
    # Half of the still time is the quietest half; its limit is reached by noise alone.
    limit = np.median(around[still]) if still.any() else 0.0
    return still & (around <= limit)


def _events_around(recording: Recorded) -> npt.NDArray[np.float32]:
    """Return the events of the pixels around each pixel, per step and its neighbours in time: [n - 1, P]."""
    around = np.empty((len(recording.frames) - 1, len(recording.pixels)), np.float32)
    step, owner, _ = events_of_steps(recording)
    counts = np.bincount(step * around.shape[1] + owner, minlength=around.size).reshape(around.shape)
    picture = np.zeros((recording.height_px, recording.width_px), np.float32)
    for number in range(len(around)):
        own = counts[max(number - 1, 0) : number + 2].sum(axis=0)
        picture.reshape(-1)[recording.pixels] = own
        near = cv2.boxFilter(picture, -1, (_AROUND_PX,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        around[number] = near.ravel()[recording.pixels] - own
    return around


def events_of_steps(
    recording: Recorded,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return step between frames, pixel and polarity of the events from the first to the last frame: [M]."""
    owner = np.repeat(np.arange(len(recording.pixels)), np.diff(recording.first))
    step = np.searchsorted(recording.frame_us, recording.t_us, side="right") - 1
    inside = (step >= 0) & (step < len(recording.frames) - 1)
    return step[inside], owner[inside], recording.p[inside]


def still_time(recording: Recorded, still: npt.NDArray[np.bool_]) -> Doubles:
    """Return what a pixel shows while it sees no motion, in each quarter of the recording: [4, P, 4] float64.

    Rows: seconds; light x seconds, light 0 (black) .. 1 (white); brighter events; darker events.

    Args:
        still: see :func:`is_still`.
    """
    quarter, pixels = _quarter(recording, recording.frame_us[:-1]), len(recording.pixels)
    seconds = (np.diff(recording.frame_us)[:, None] * np.float32(1e-6) * still).astype(np.float32)
    lit = seconds * recording.known_light.of(np.arange(256.0)).astype(np.float32)[recording.frames[:-1]]
    times = [[part[quarter == q].sum(axis=0, dtype=np.float64) for q in range(4)] for part in (seconds, lit)]
    step, owner, p = events_of_steps(recording)
    here = still[step, owner]
    place = ((4 * (1 - p[here]) + quarter[step[here]]) * pixels) + owner[here]
    events = np.bincount(place, minlength=8 * pixels).reshape(2, 4, pixels)
    return np.concatenate([np.array(times), events]).transpose(0, 2, 1)


def intervals_us(recording: Recorded) -> Doubles:
    """Return the intervals between events of a pixel, and whether both are brighter or both darker: [2, M] float64."""
    pixel = np.repeat(np.arange(len(recording.pixels)), np.diff(recording.first))
    same = np.diff(pixel) == 0
    return np.stack([np.diff(recording.t_us), recording.p[1:] == recording.p[:-1]]).astype(np.float64)[:, same]


def _quarter(recording: Recorded, t_us: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    begin_us, end_us = recording.frame_us[[0, -1]]
    passed = (t_us - begin_us) / max(end_us - begin_us, 1)
    return np.asarray(np.clip((4 * passed).astype(np.int64), 0, 3))


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
