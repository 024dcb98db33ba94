"""The motion of a clip, read beside its pixels or found from them.

:mod:`v2v_server.motion` is imported lazily: listing files must not load numba.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from v2v_server.store.planes.chroma import CHROMA, chroma_of
from v2v_server.store.planes.detail import DETAIL, detail_of, grey_of
from v2v_server.store.reader import StoreFile
from v2v_server.video.collect import Cut, DecodedFrame, LastFrame
from v2v_server.video.decode import DecodedClip
from v2v_server.video.orientation import Window

if TYPE_CHECKING:
    from v2v_server.motion import Cells, Vectors

MOTION = "motion"
"""Name of the plane."""


def _motion_maker() -> Callable[[npt.NDArray[np.uint8]], Vectors]:
    from v2v_server.motion import MotionOfPictures, Pyramid

    following = MotionOfPictures()
    return lambda picture: following.add(Pyramid.of(picture))


MADE_PLANES: dict[str, Callable[[], Callable[[npt.NDArray[np.uint8]], npt.NDArray[Any]]]] = {MOTION: _motion_maker}
"""By name of the plane: makes a function that gets one usable picture after the other, and returns its array."""
_PICTURES = 16
"""Whole pictures that are read at a time."""


class MotionWatch:
    """Finds the motion of cuts while they are decoded.

    Args:
        cuts: of one clip.
        picture: the usable picture, which the cells of the cuts belong to.
    """

    def __init__(self, cuts: Sequence[Cut], picture: Window) -> None:
        self._cuts, self._picture = cuts, picture
        self.watch = self._begin if wants_motion(cuts) else None

    def _begin(self) -> Callable[[DecodedFrame], None]:
        from v2v_server.motion import MotionOfCuts, Pyramid

        self._found = found = MotionOfCuts(self._cuts)
        first_row, first_column, height, width = self._picture

        def place(window: Window) -> Window:
            top, left, rows, columns = window
            return first_row + top, first_column + left, rows, columns

        def see(frame: DecodedFrame) -> None:
            found.add(Pyramid(height, width, lambda part: frame.part(place(part)), lambda part: frame.raw(place(part))))

        return see

    def added_to(self, clips: Sequence[DecodedClip]) -> tuple[DecodedClip, ...]:
        """Return the decoded clips with their motion."""
        return with_motion(clips, self._cuts, self._found.vectors if self.watch else [])


def wants_motion(cuts: Sequence[Cut]) -> bool:
    """Return whether a cut asks for motion."""
    return any(cut.cells is not None for cut in cuts)


def with_motion(
    clips: Sequence[DecodedClip], cuts: Sequence[Cut], vectors: Sequence[Vectors]
) -> tuple[DecodedClip, ...]:
    """Return clips with the motion of those cuts that ask for it, given in their order."""
    following = iter(vectors)
    return tuple(
        clip if cut.cells is None else replace(clip, motion=next(following))
        for clip, cut in zip(clips, cuts, strict=True)
    )


def without_still_margins(cuts: Sequence[Cut], vectors: Sequence[Vectors]) -> list[Cut]:
    """Return the cuts, those in whose cells nothing moves with their smaller window.

    Args:
        vectors: of those that ask for motion, in their order.
    """
    following = iter(vectors)
    return [
        cut if cut.cells is None or next(following).any() or cut.still is None else replace(cut, window=cut.still)
        for cut in cuts
    ]


def has_motion(stored: StoreFile, stride: int, picture: Window) -> bool:
    """Return whether a store file has the motion between such frames of such a usable picture.

    Raises:
        VideoError: its list of planes is damaged.
    """
    head = stored.head
    return stride == 1 and picture == (head.top, 0, head.rows, head.width_px) and MOTION in stored.planes


def read_motion(
    files: Sequence[tuple[StoreFile, range]], start: int, cuts: Sequence[Cut], stride: int, picture: Window
) -> list[Vectors]:
    """Return the motion of the cuts that ask for it, read where the files have it and otherwise found from the pixels.

    Args:
        files: open store files that together hold the clip, and the frames of it that each one holds.
        start, cuts, stride: see :func:`v2v_server.video.decode.decode_cuts`.
        picture: the usable picture.

    Raises:
        UsageError, VideoError: see :meth:`v2v_server.store.reader.StoreFile.plane`.
    """
    cuts = [cut for cut in cuts if cut.cells is not None]
    if not cuts:
        return []
    from v2v_server.motion import Cells, MotionOfCuts, Pyramid

    if not all(has_motion(stored, stride, picture) for stored, _ in files):
        found = MotionOfCuts(cuts)
        for stored, frames in files:
            for each in pictures_in(stored, frames, start, stride, picture):
                found.add(Pyramid.of(each))
        return found.vectors
    vectors = []
    for cut in cuts:
        assert cut.cells is not None
        cells = Cells(*cut.cells)
        parts = []
        for stored, held in files:
            if frames := range(held.start, min(held.stop, cut.count)):
                parts.append(stored.plane(MOTION, start + frames.start, len(frames), cells))
        of_cut = parts[0] if len(parts) == 1 else np.concatenate(parts)
        of_cut[0] = 0
        for (before, _), (after, frames) in pairwise(files):
            if frames.start < cut.count:  # the first frame of a file has no motion in it
                of_cut[frames.start] = _motion_across(before, after, start + frames.start, cells, picture)
        vectors.append(of_cut)
    return vectors


def pictures_in(
    stored: StoreFile, frames: range, start: int, stride: int, picture: Window
) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield frames of a clip that begins at ``start``, in the memory of a few."""
    for first in range(frames.start, frames.stop, _PICTURES):
        some = np.empty((min(_PICTURES, frames.stop - first), *picture[2:]), np.uint8)
        stored.read(start + first * stride, stride, picture, some)
        yield from some


def with_planes(
    pictures: Iterable[tuple[LastFrame, npt.NDArray[Any]]], planes: Sequence[str]
) -> Iterator[tuple[npt.NDArray[np.uint8], dict[str, npt.NDArray[Any]]]]:
    """Yield decoded pictures in 8 bits with their planes: those of :data:`MADE_PLANES`, which are made from them, and
    the detail of deeper ones, and the colour.
    """
    makers = {name: MADE_PLANES[name]() for name in planes if name in MADE_PLANES}
    for stream, picture in pictures:
        grey = grey_of(stream, picture)
        arrays = {name: make(grey) for name, make in makers.items()}
        if DETAIL in planes:
            arrays[DETAIL] = detail_of(picture, grey, stream.signal)
        if CHROMA in planes:
            arrays[CHROMA] = chroma_of(stream)
        yield grey, arrays


def _motion_across(before: StoreFile, after: StoreFile, at: int, cells: Cells, picture: Window) -> Vectors:
    """Return the motion to the first frame of a file, ``at``, from the last frame of the one before."""
    from v2v_server.motion import Pyramid, motion

    first, second = (
        Pyramid.of(next(pictures_in(stored, range(1), number, 1, picture)))
        for stored, number in ((before, at - 1), (after, at))
    )
    return motion(first, second, cells)
