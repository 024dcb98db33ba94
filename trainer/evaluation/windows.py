"""Divide a recording into windows: from picture to picture, by time, by number of events, or between flow fields.

A window from picture to picture holds the events with t_i <= t < t_(i+1). Its target is the later picture.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections.abc import Sequence

from trainer.evaluation.data_sets import TimeRange
from trainer.evaluation.readers import EventWindow, RecordedImage, Recording
from v2v_protocol.errors import UsageError
from v2v_recordings.event_columns import CLOCK_SLACK_SECONDS


def picture_windows(
    recording: Recording, time_range: TimeRange | None = None, *, pictures: int = 1, later: int = 0
) -> list[EventWindow]:
    """Return the windows from picture to picture.

    Args:
        time_range: (first, last) seconds from the first picture of the recording, the end excluded; None takes all
            pictures.
        pictures: number of pictures from one window's end to the next; those in between are ignored.
        later: number of pictures by which both ends of the time range are moved later.

    Raises:
        UsageError: fewer than two pictures in the time range, the recording ends before it does, or ``pictures`` is
            below 1.
    """
    if pictures < 1:
        raise UsageError(f"windows of {pictures} pictures: give at least 1")
    if not recording.images:
        raise UsageError(f"{recording.path} has no pictures to compare with; use --fps to reconstruct without them")
    found = _images_in(recording, time_range, later)
    images = found[::pictures]
    if len(images) < 2:
        within = "" if time_range is None else f" in the time range {time_range}"
        raise UsageError(
            f"{recording.path}: {len(found)} pictures{within}; a window needs at least {pictures + 1} of them"
        )
    return [
        EventWindow(one.event_index, max(one.event_index, other.event_index), one.time, other.time, other)
        for one, other in itertools.pairwise(images)
    ]


def _images_in(recording: Recording, time_range: TimeRange | None, later: int = 0) -> list[RecordedImage]:
    images = list(recording.images)
    if time_range is not None and images:
        start, end = time_range
        zero, last = images[0].time, images[-1].time - images[0].time
        # A file that holds only the time range would be trimmed twice. If the range starts at 0, that is harmless.
        if start > 0 and last < end - CLOCK_SLACK_SECONDS:
            raise UsageError(
                f"{recording.path} lasts {last:.2f} s, and the time range is from {start:g} to {end:g} s: if the file "
                "holds only that range, give --cuts none"
            )
        since = [image.time - zero for image in images]
        images = images[bisect.bisect_left(since, start) + later : bisect.bisect_left(since, end) + later]
    return images


def flow_windows(
    recording: Recording, time_range: TimeRange | None = None, *, one_later: bool = False
) -> list[EventWindow]:
    """Return the windows between the times of consecutive flow fields. The target is the field of the window.

    Args:
        time_range: (first, last) seconds, the end excluded, counted from the first picture of the recording, or from
            its first field if it has no pictures; None takes all fields.
        one_later: pair each window with the field at its end, as V2V's released code does, not the one at its start.

    Raises:
        UsageError: fewer than two fields in the time range.
    """
    fields = recording.flow_fields()
    if time_range is not None and fields:
        zero = recording.images[0].time if recording.images else fields[0].time
        fields = [each for each in fields if time_range[0] <= each.time - zero < time_range[1]]
    if len(fields) < 2:
        within = f" in the time range {time_range}" if time_range else ""
        raise UsageError(
            f"{recording.path} has {len(fields)} flow fields{within}; a window needs at least 2. v2v-convert reads "
            "MVSEC's from *_gt.hdf5 beside *_data.hdf5"
        )
    windows = []
    for one, other in itertools.pairwise(fields):
        start, stop = (bisect.bisect_left(recording.times, each.time) for each in (one, other))
        windows.append(EventWindow(start, max(start, stop), one.time, other.time, other if one_later else one))
    return windows


def regular_windows(recording: Recording, fps: float) -> list[EventWindow]:
    """Return windows of 1 / ``fps`` seconds from the first event to the last, without targets.

    Raises:
        UsageError: ``fps`` is not above 0, or the recording is shorter than one window.
    """
    if not 0 < fps < math.inf:
        raise UsageError(f"{fps:g} windows per second: give a number above 0")
    first, last = recording.span
    count = int((last - first) * fps + 1e-9)
    if count < 1:
        raise UsageError(f"{recording.path} lasts {last - first:.3f} s, less than one window at {fps:g} per second")
    edges = [first + step / fps for step in range(count + 1)]
    indices = [bisect.bisect_left(recording.times, edge) for edge in edges]
    return [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)]


def windows_of_seconds(recording: Recording, seconds: float, time_range: TimeRange | None = None) -> list[EventWindow]:
    """Return windows of ``seconds`` each, independent of the pictures' times.

    A picture is scored against the window whose end is nearest to it, at most half a window away.

    Args:
        seconds: length of each window.
        time_range: as for :func:`picture_windows`; None takes all events.

    Raises:
        UsageError: ``seconds`` is not above 0, or the recording is shorter than one window.
    """
    if not seconds > 0:
        raise UsageError(f"windows of {seconds:g} s: give more than 0")
    first, last, images = _scored_span(recording, time_range)
    count = int((last - first) / seconds + 1e-9)
    if count < 1:
        raise UsageError(f"{recording.path}: {last - first:.3f} s are less than one window of {seconds:g} s")
    edges = [first + step * seconds for step in range(count + 1)]
    indices = [bisect.bisect_left(recording.times, edge) for edge in edges]
    return _with_targets(
        [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)], images
    )


def windows_of_events(recording: Recording, events: int, time_range: TimeRange | None = None) -> list[EventWindow]:
    """Return windows of ``events`` events each. Fast motion makes them short; surplus events at the end are dropped.

    Args:
        events: number of events in each window.
        time_range: as for :func:`picture_windows`; None takes all events.

    Raises:
        UsageError: ``events`` is not above 0, or the recording has fewer events than one window.
    """
    if events < 1:
        raise UsageError(f"windows of {events} events: give at least 1")
    first, last, images = _scored_span(recording, time_range)
    begin, end = bisect.bisect_left(recording.times, first), bisect.bisect_right(recording.times, last)
    if end - begin < events:
        raise UsageError(f"{recording.path}: {end - begin} events are less than one window of {events}")
    starts = range(begin, end - events + 1, events)
    ends = [recording.times[min(start + events, len(recording) - 1)] for start in starts]
    begins = [first, *ends[:-1]]
    return _with_targets(
        [
            EventWindow(start, start + events, at, until, None)
            for start, at, until in zip(starts, begins, ends, strict=True)
        ],
        images,
    )


def _scored_span(recording: Recording, time_range: TimeRange | None) -> tuple[float, float, list[RecordedImage]]:
    first, last = recording.span
    images = _images_in(recording, time_range)
    if time_range is not None and recording.images:
        zero = recording.images[0].time
        first, last = max(first, zero + time_range[0]), min(last, zero + time_range[1])
    return first, last, images


def _with_targets(windows: Sequence[EventWindow], images: Sequence[RecordedImage]) -> list[EventWindow]:
    """Make each picture the target of the window whose end is nearest to it, at most half a window away.

    If several pictures have the same window, the nearest becomes its target.
    """
    ends = [window.end for window in windows]
    nearest: dict[int, tuple[float, RecordedImage]] = {}
    for image in images:
        after = bisect.bisect_left(ends, image.time)
        places = [place for place in (after - 1, after) if 0 <= place < len(ends)]
        place = min(places, key=lambda place: abs(ends[place] - image.time))
        away = abs(ends[place] - image.time)
        if 2 * away <= windows[place].end - windows[place].begin and away < nearest.get(place, (away + 1,))[0]:
            nearest[place] = away, image
    return [
        dataclasses.replace(window, target=nearest[place][1]) if place in nearest else window
        for place, window in enumerate(windows)
    ]
