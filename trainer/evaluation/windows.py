"""How a recording is cut into windows: from picture to picture, by time, by number of events, or between flow fields.

A window from picture to picture holds the events with t_i <= t < t_(i+1); its voxel grid is to become the later one.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Sequence

from trainer.evaluation.readers import CLOCK_SLACK_SECONDS, EventWindow, Image, Recording
from v2v_protocol.errors import UsageError


def picture_windows(
    recording: Recording, cut: tuple[float, float] | None = None, *, pictures: int = 1, later: int = 0
) -> list[EventWindow]:
    """Windows from picture to picture.

    Args:
        cut: from which second on and before which, counted from the first picture of the recording; None takes
            all pictures.
        pictures: how many pictures on a window ends; those between are not looked at.
        later: by how many pictures the cut begins and ends later.

    Raises:
        UsageError: fewer than two pictures in the cut, or the recording ends before the cut does; ``pictures`` not
            above 0.
    """
    if pictures < 1:
        raise UsageError(f"windows of {pictures} pictures: give at least 1")
    if not recording.images:
        raise UsageError(f"{recording.path} has no pictures to compare with; --fps reconstructs without")
    found = _images_in(recording, cut, later)
    images = found[::pictures]
    if len(images) < 2:
        raise UsageError(
            f"{recording.path}: {len(found)} pictures{'' if cut is None else f' in the cut {cut}'}; "
            f"{pictures + 1} or more make a window"
        )
    return [
        EventWindow(one.event_index, max(one.event_index, other.event_index), one.time, other.time, other)
        for one, other in itertools.pairwise(images)
    ]


def _images_in(recording: Recording, cut: tuple[float, float] | None, later: int = 0) -> list[Image]:
    images = list(recording.images)
    if cut is not None and images:
        start, end = cut
        zero, last = images[0].time, images[-1].time - images[0].time
        # A recording that was cut before would be cut twice. One that begins at 0 cannot be mistaken.
        if start > 0 and last < end - CLOCK_SLACK_SECONDS:
            raise UsageError(
                f"{recording.path} lasts {last:.2f} s, and the cut is from {start:g} to {end:g} s: if it is already "
                "cut, give --cuts none"
            )
        since = [image.time - zero for image in images]
        images = images[bisect.bisect_left(since, start) + later : bisect.bisect_left(since, end) + later]
    return images


def flow_windows(
    recording: Recording, cut: tuple[float, float] | None = None, *, one_later: bool = False
) -> list[EventWindow]:
    """Windows between the times of consecutive flow fields; the target is the field of the window.

    Args:
        cut: from which second on and before which, counted from the first picture of the recording, else its
            first field.
        one_later: pair each window with the field at its end, as V2V's released code does, not that at its start.

    Raises:
        UsageError: fewer than two fields in the cut.
    """
    fields = recording.flow_fields()
    if cut is not None and fields:
        zero = recording.images[0].time if recording.images else fields[0].time
        fields = [each for each in fields if cut[0] <= each.time - zero < cut[1]]
    if len(fields) < 2:
        raise UsageError(
            f"{recording.path} has {len(fields)} flow fields{f' in the cut {cut}' if cut else ''}; two or more make a "
            "window. v2v-convert takes MVSEC's from *_gt.hdf5 beside *_data.hdf5"
        )
    made = []
    for one, other in itertools.pairwise(fields):
        start, stop = (bisect.bisect_left(recording.times, each.time) for each in (one, other))
        made.append(EventWindow(start, max(start, stop), one.time, other.time, other if one_later else one))
    return made


def regular_windows(recording: Recording, fps: float) -> list[EventWindow]:
    """Windows of equal length from the first event to the last; without targets.

    Raises:
        UsageError: ``fps`` not above 0, or the recording is shorter than one window.
    """
    if not fps > 0:
        raise UsageError(f"{fps:g} windows a second: give more than 0")
    first, last = recording.span
    count = int((last - first) * fps + 1e-9)
    if count < 1:
        raise UsageError(f"{recording.path} lasts {last - first:.3f} s, less than one window at {fps:g} a second")
    edges = [first + step / fps for step in range(count + 1)]
    indices = [bisect.bisect_left(recording.times, edge) for edge in edges]
    return [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)]


def windows_of_seconds(
    recording: Recording, seconds: float, cut: tuple[float, float] | None = None
) -> list[EventWindow]:
    """Windows of equal length in time, without regard to pictures.

    A picture is scored against the window whose end is nearest to it, at most half a window away.

    Args:
        seconds: of each.
        cut: as for :func:`picture_windows`; None takes all events.

    Raises:
        UsageError: ``seconds`` not above 0, or less than one window.
    """
    if not seconds > 0:
        raise UsageError(f"windows of {seconds:g} s: give more than 0")
    first, last, images = _scored_span(recording, cut)
    count = int((last - first) / seconds + 1e-9)
    if count < 1:
        raise UsageError(f"{recording.path}: {last - first:.3f} s are less than one window of {seconds:g} s")
    edges = [first + step * seconds for step in range(count + 1)]
    indices = [bisect.bisect_left(recording.times, edge) for edge in edges]
    return _with_targets(
        [EventWindow(indices[i], indices[i + 1], edges[i], edges[i + 1], None) for i in range(count)], images
    )


def windows_of_events(recording: Recording, events: int, cut: tuple[float, float] | None = None) -> list[EventWindow]:
    """Windows of as many events each, which are short where much moves; the rest at the end is left out.

    Args:
        events: of each.
        cut: as for :func:`picture_windows`; None takes all events.

    Raises:
        UsageError: ``events`` not above 0, or less than one window.
    """
    if events < 1:
        raise UsageError(f"windows of {events} events: give at least 1")
    first, last, images = _scored_span(recording, cut)
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


def _scored_span(recording: Recording, cut: tuple[float, float] | None) -> tuple[float, float, list[Image]]:
    first, last = recording.span
    images = _images_in(recording, cut)
    if cut is not None and recording.images:
        zero = recording.images[0].time
        first, last = max(first, zero + cut[0]), min(last, zero + cut[1])
    return first, last, images


def _with_targets(windows: Sequence[EventWindow], images: Sequence[Image]) -> list[EventWindow]:
    """Each picture is the target of the window whose end is nearest to it, if that is at most half a window away;
    of several for one window, the nearest."""
    ends = [window.end for window in windows]
    nearest: dict[int, tuple[float, Image]] = {}
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
