"""The luma of a range of frames, decoded."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, decode_cuts, stream_pictures
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.picture import PixelRect


def decode_luma(
    path: str | os.PathLike[str], index: FrameIndex, start: int, count: int, window: PixelRect | None = None
) -> DecodedClip:
    """Decode frames start .. start + count - 1 of a video, or a window of them."""
    return decode_cuts(path, ClipRequest(index, start, (Cut(count, window),)))[0]


def stream_luma(
    path: str | os.PathLike[str], index: FrameIndex, start: int, count: int, window: PixelRect | None = None
) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield the frames of :func:`decode_luma` one by one, in the memory of one."""
    for picture in stream_pictures(path, ClipRequest(index, start, (Cut(count, window),))):
        yield picture.grey
