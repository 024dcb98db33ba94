"""The colour of a clip, Cb and Cr (:mod:`v2v_server.video.picture`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from v2v_server.store.planes.plane import Files, Plane
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, DecodedPicture
from v2v_server.video.picture import CHROMA_CELL_PX, Chroma, ChromaCut, Signal


class Colour(Plane):
    """The colour of clips whose cuts ask for it."""

    def is_wanted(self, request: ClipRequest, signal: Signal) -> bool:
        """Return whether a cut asks for colour."""
        return any(cut.chroma is not None for cut in request.cuts)

    def asked(self, cut: Cut) -> Cut:
        """Return the cut of whole pictures with its colour."""
        assert cut.window is not None
        return replace(cut, chroma=ChromaCut((), cut.window, (cut.window[0], cut.window[2])))

    def maker(self) -> Callable[[DecodedPicture], npt.NDArray[np.int8]]:
        """Return a function that returns the colour of a picture: Cb and Cr of its cells, [2, rows, columns]."""

        def colour(picture: DecodedPicture) -> npt.NDArray[np.int8]:
            assert picture.colour is not None
            return picture.colour

        return colour

    def read(self, files: Files, request: ClipRequest) -> list[Chroma | None]:
        """Return the colour of the frames that each cut names."""
        return [None if cut.chroma is None else _read(cut.chroma, files, request) for cut in request.cuts]

    def added(self, clip: DecodedClip, value: Chroma | None) -> DecodedClip:
        """Return the clip with this colour."""
        return replace(clip, chroma=value)


PLANE = Colour(
    version=1, dtype="i1", values=2, cell_px=CHROMA_CELL_PX, serves="frames_rgb",
    remedy="prepare it with v2v-prepare --planes chroma",
)  # fmt: skip


def _read(cut: ChromaCut, files: Files, request: ClipRequest) -> Chroma:
    parts, (top, left, rows, columns) = [], cut.cells
    for stored, held in files:
        frames = np.array([frame for frame in cut.frames if frame in held], np.int64)
        if len(frames):
            first = request.start + int(frames[0]) * request.stride
            wanted = (frames - frames[0]) * request.stride
            cells = (
                top - stored.head.top // CHROMA_CELL_PX,
                left,
                rows,
                columns,
            )  # cells begin at the file's own first row
            parts.append(stored.plane("chroma", first, int(wanted[-1]) + 1, cells, wanted))
    return Chroma(np.concatenate(parts), files[0][0].head.matrix)
