"""The motion of a clip, from each picture to the next: read beside its pixels, or found from them.

:mod:`v2v_server.motion` is imported lazily: listing files must not load numba.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from v2v_server.store.planes.plane import Files, Plane, Stored
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, DecodedFrame, DecodedPicture, Watch
from v2v_server.video.picture import SDR, PixelRect, Signal

if TYPE_CHECKING:
    from v2v_server.motion import Cells, MotionOfCuts, Vectors


class Motion(Plane):
    """The motion in the cells that cuts ask for."""

    def is_wanted(self, request: ClipRequest, signal: Signal) -> bool:
        """Return whether a cut asks for motion."""
        return any(cut.cells is not None for cut in request.cuts)

    def is_worth_storing(self, request: ClipRequest) -> bool:
        """Return whether a cut asks for the motion between neighbouring frames, which is stored."""
        return request.stride == 1 and self.is_wanted(request, SDR)

    def maker(self) -> Callable[[DecodedPicture], Vectors]:
        """Return a function that returns the motion to each picture."""
        from v2v_server.motion import Pyramid, motion

        last: Pyramid | None = None

        def found(picture: DecodedPicture) -> Vectors:
            nonlocal last
            before, last = last, Pyramid.of(picture.grey)
            return motion(before or last, last)

        return found

    def read(self, files: Files, request: ClipRequest) -> list[Vectors | None]:
        """Return the motion of each cut, read where the files have it and otherwise found from the pixels."""
        from v2v_server.motion import MotionOfCuts, Pyramid

        if all(self._is_stored(stored, request) for stored, _ in files):
            return [None if cut.cells is None else _read(files, request, cut) for cut in request.cuts]
        found = MotionOfCuts(request.cuts)
        for stored, frames in files:
            for picture in stored.pictures(_whole(request, frames)):
                found.add(Pyramid.of(picture.grey))
        return by_cut(request, found)

    def narrowed(self, cut: Cut, value: Vectors | None) -> Cut:
        """Return the cut with its smaller window if nothing moves in its cells."""
        return cut if value is None or value.any() or cut.still is None else replace(cut, window=cut.still)

    def added(self, clip: DecodedClip, value: Vectors | None) -> DecodedClip:
        """Return the clip with this motion."""
        return replace(clip, motion=value)

    def _is_stored(self, stored: Stored, request: ClipRequest) -> bool:
        head = stored.head
        is_usable = request.usable == (head.top, 0, head.rows, head.width_px)
        return request.stride == 1 and is_usable and "motion" in stored.planes


# Zero for the first frame of a file.
PLANE = Motion(version=1, dtype="<i2", values=2, cell_px=4, serves="substep_px")


def watch_motion(request: ClipRequest) -> tuple[Watch, list[MotionOfCuts]]:
    """Return what sees the frames of a request while they are decoded, and a list whose last item is their motion."""
    from v2v_server.motion import MotionOfCuts, Pyramid

    found: list[MotionOfCuts] = []
    first_row, first_column, height, width = request.usable

    def place(window: PixelRect) -> PixelRect:
        top, left, rows, columns = window
        return first_row + top, first_column + left, rows, columns

    def see(frame: DecodedFrame) -> None:
        found[-1].add(Pyramid(height, width, lambda part: frame.part(place(part))))

    def begin() -> Callable[[DecodedFrame], None]:
        found.append(MotionOfCuts(request.cuts))
        return see

    return begin, found


def by_cut(request: ClipRequest, found: MotionOfCuts) -> list[Vectors | None]:
    """Return the motion of each cut of a request; None for one without cells."""
    following = iter(found.vectors)
    return [None if cut.cells is None else next(following) for cut in request.cuts]


def _read(files: Files, request: ClipRequest, cut: Cut) -> Vectors:
    from v2v_server.motion import Cells

    assert cut.cells is not None
    cells, parts, start = Cells(*cut.cells), [], request.start
    for stored, held in files:
        if frames := range(held.start, min(held.stop, cut.count)):
            parts.append(stored.plane("motion", start + frames.start, len(frames), cells))
    vectors = parts[0] if len(parts) == 1 else np.concatenate(parts)
    vectors[0] = 0
    for (before, _), (after, frames) in pairwise(files):
        if frames.start < cut.count:  # the first frame of a file has no motion in it
            vectors[frames.start] = _motion_across(before, after, request, frames.start, cells)
    return vectors


def _whole(request: ClipRequest, frames: range) -> ClipRequest:
    """Return a request of some frames of a clip, whole usable pictures."""
    cut = Cut(len(frames), request.usable)
    return replace(request, start=request.start + frames.start * request.stride, cuts=(cut,))


def _motion_across(before: Stored, after: Stored, request: ClipRequest, number: int, cells: Cells) -> Vectors:
    """Return the motion to frame ``number`` of a clip, the first of a file, from the last of the file before."""
    from v2v_server.motion import Pyramid, motion

    first, second = (
        Pyramid.of(next(stored.pictures(_whole(request, range(at, at + 1)))).grey)
        for stored, at in ((before, number - 1), (after, number))
    )
    return motion(first, second, cells)
