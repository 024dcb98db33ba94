"""The colour of a clip, read beside its pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_server.store.reader import StoreFile
from v2v_server.video.collect import Cut, LastFrame
from v2v_server.video.colour.chroma import CELL_PX, DEFAULT_MATRIX, Chroma, ChromaCut
from v2v_server.video.decode import DecodedClip
from v2v_server.video.orientation import Window

CHROMA = "chroma"
"""Name of the plane."""


def chroma_planes(cuts: Sequence[Cut]) -> list[str]:
    """Return the names of the planes that the colour of cuts needs."""
    return [CHROMA] if any(cut.chroma is not None for cut in cuts) else []


def whole_chroma(planes: Collection[str], picture: Window) -> ChromaCut | None:
    """Return what to decode for the plane of a usable picture; None without the plane."""
    return ChromaCut((), picture, (picture[0], picture[2])) if CHROMA in planes else None


def matrix_of(stream: LastFrame) -> str:
    """Return the matrix of a decoded frame's colour; the default if none was collected."""
    return DEFAULT_MATRIX if stream.colour is None else stream.colour[1]


def chroma_of(stream: LastFrame) -> npt.NDArray[np.int8]:
    """Return the plane's array of the last decoded frame, [2, rows, columns]."""
    assert stream.colour is not None
    return stream.colour[0]


def with_chroma(
    clips: Sequence[DecodedClip], cuts: Sequence[Cut], files: Sequence[tuple[StoreFile, range]], start: int, stride: int
) -> tuple[DecodedClip, ...]:
    """Return the clips with the colour that their cuts ask for.

    Args:
        files: open store files that together hold the clip, and the frames of it that each one holds.
        start, stride: see :func:`v2v_server.video.decode.decode_cuts`.

    Raises:
        VideoError: a file lacks the plane, or it is damaged.
    """
    return tuple(
        clip if cut.chroma is None else replace(clip, chroma=_read(cut.chroma, files, start, stride))
        for clip, cut in zip(clips, cuts, strict=True)
    )


def _read(cut: ChromaCut, files: Sequence[tuple[StoreFile, range]], start: int, stride: int) -> Chroma:
    parts = []
    for stored, held in files:
        if CHROMA not in stored.planes:
            raise VideoError(stored.head.video, None, "lacks colour: prepare it with v2v-prepare --planes chroma")
        frames = np.array([frame for frame in cut.frames if frame in held], np.int64)
        if len(frames):
            first = start + int(frames[0]) * stride
            count = int(frames[-1] - frames[0]) * stride + 1
            parts.append(stored.plane(CHROMA, first, count, _cells_in(stored, cut), (frames - frames[0]) * stride))
    return Chroma(np.concatenate(parts), files[0][0].head.matrix)


def _cells_in(stored: StoreFile, cut: ChromaCut) -> Window:
    """Return the cells of a cut in the plane of a file, whose cells begin at its own first row."""
    top, left, rows, columns = cut.cells
    return top - stored.head.top // CELL_PX, left, rows, columns
