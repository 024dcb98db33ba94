"""Levels of more than 8 bits in a store file: its luma has 8 bits, and this plane what they lack.

    level = round(grey W / 255) + detail,  W = 2**bits - 1

Grey and level are roundings of one sample (``v2v_server.video.picture``): the detail of 12 bits is -9 to 9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from v2v_server.store.planes.plane import Files, Plane
from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture
from v2v_server.video.picture import SDR, Signal


class Detail(Plane):
    """The detail of deeper luma."""

    def is_wanted(self, request: ClipRequest, signal: Signal) -> bool:
        """Return whether the levels have more than 8 bits."""
        return signal.bits > SDR.bits

    def is_part_of(self, signal: Signal) -> bool:
        """Return whether the levels have more than 8 bits."""
        return signal.bits > SDR.bits

    def maker(self) -> Callable[[DecodedPicture], npt.NDArray[np.int8]]:
        """Return a function that returns the detail of a picture, [1, h, w], from its levels and greys."""
        return lambda picture: detail_of(picture.luma, picture.grey, picture.signal)

    def read(self, files: Files, request: ClipRequest) -> list[npt.NDArray[np.int8]]:
        """Return [count, h, w] of each cut's window."""
        found = []
        for cut in request.cuts:
            top, left, height, width = request.window(cut)
            detail = np.empty((cut.count, height, width), np.int8)
            for stored, held in files:
                if frames := range(held.start, min(held.stop, cut.count)):
                    cells = top - stored.head.top, left, height, width
                    first, count = request.start + frames.start * request.stride, (len(frames) - 1) * request.stride + 1
                    part = stored.plane("detail", first, count, cells)
                    detail[frames.start : frames.stop] = part[:: request.stride, 0]
            found.append(detail)
        return found

    def added(self, clip: DecodedClip, value: npt.NDArray[np.int8]) -> DecodedClip:
        """Return the clip with the levels of its greys and this detail, [n, h, w]."""
        return replace(clip, frames=levels_of(clip.frames, value, clip.signal))


PLANE = Detail(version=1, dtype="i1", values=1, cell_px=1, remedy="re-create it with v2v-prepare")


def detail_of(levels: npt.NDArray[np.uint16], grey: npt.NDArray[np.uint8], signal: Signal) -> npt.NDArray[np.int8]:
    """Return the plane's array of one frame, [1, h, w], from its levels and its grey, [h, w] each."""
    return (levels - _nearest(signal)[grey]).astype(np.int8)[None]


def levels_of(grey: npt.NDArray[np.uint8], detail: npt.NDArray[np.int8], signal: Signal) -> npt.NDArray[np.uint16]:
    """Return the levels of grey and detail, [n, h, w] both, within the signal's limits whatever a file holds."""
    levels: npt.NDArray[np.uint16] = np.clip(_nearest(signal)[grey] + detail, 0, signal.white).astype(np.uint16)
    return levels


def _nearest(signal: Signal) -> npt.NDArray[np.int16]:
    """Return the level nearest to each of 256 greys."""
    return ((2 * signal.white * np.arange(256) + 255) // 510).astype(np.int16)
