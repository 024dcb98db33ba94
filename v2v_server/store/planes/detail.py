"""Levels of more than 8 bits in a store file: its luma has 8 bits, and the plane "detail" what they lack.

    level = round(grey W / 255) + detail,  W = 2**bits - 1

Grey and level are roundings of one sample of the video (``v2v_server.video.luma``): the detail of 12 bits is -9 to 9.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_server.store.format import Head
from v2v_server.store.reader import StoreFile
from v2v_server.video.collect import LastFrame
from v2v_server.video.luma import Signal
from v2v_server.video.orientation import Window

DETAIL = "detail"
"""Name of the plane."""


def detail_planes(signal: Signal) -> list[str]:
    """Return the names of the planes that levels of this signal need."""
    return [DETAIL] if signal.bits > 8 else []


def same_transfer(
    head: Head, frames: Iterable[tuple[LastFrame, npt.NDArray[Any]]]
) -> Iterator[tuple[LastFrame, npt.NDArray[Any]]]:
    """Yield decoded frames that a file with this head is to hold.

    Raises:
        VideoError: a frame states another transfer than the head.
    """
    for stream, picture in frames:
        if stream.signal.transfer != head.transfer:
            why = f"its transfer changes from {head.transfer or 'SDR'}: re-encode it with one transfer"
            raise VideoError(head.video, None, why)
        yield stream, picture


def grey_of(stream: LastFrame, picture: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return the last decoded picture in 8 bits."""
    return stream.grey_picture() if stream.signal.bits > 8 else picture


def detail_of(levels: npt.NDArray[np.uint16], grey: npt.NDArray[np.uint8], signal: Signal) -> npt.NDArray[np.int8]:
    """Return the plane's array of one frame, [1, h, w], from its levels and its grey, [h, w] each."""
    return (levels - _nearest(signal)[grey]).astype(np.int8)[None]


def levels_of(grey: npt.NDArray[np.uint8], detail: npt.NDArray[np.int8], signal: Signal) -> npt.NDArray[np.uint16]:
    """Return the levels of grey and detail of equal shape, within the signal's limits whatever a file holds."""
    levels: npt.NDArray[np.uint16] = np.clip(_nearest(signal)[grey] + detail, 0, signal.white).astype(np.uint16)
    return levels


def read_levels(
    stored: StoreFile, start: int, stride: int, window: Window, out: npt.NDArray[np.unsignedinteger], signal: Signal
) -> None:
    """Read frames start, start + stride ... of a window, see :meth:`v2v_server.store.reader.StoreFile.read`.

    Args:
        stored, start, stride, window: see there.
        out: [n, height, width] of the signal's dtype, receives the levels.
        signal: with more than 8 bits, the file has the plane.

    Raises:
        UsageError, VideoError: see there.
    """
    if signal.bits == 8:
        stored.read(start, stride, window, out)
        return
    grey = np.empty(out.shape, np.uint8)
    stored.read(start, stride, window, grey)
    top, left, height, width = window
    cells = top - stored.head.top, left, height, width
    detail = stored.plane(DETAIL, start, (len(out) - 1) * stride + 1, cells)[::stride, 0]
    out[...] = levels_of(grey, detail, signal)


def _nearest(signal: Signal) -> npt.NDArray[np.int16]:
    """Return the level nearest to each of 256 greys."""
    return ((2 * signal.white * np.arange(256) + 255) // 510).astype(np.int16)
