"""Read the pixels of a video: decode them, or read the store file that was made from it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError, VideoError
from v2v_server.store.format import is_store_file
from v2v_server.store.planes.chroma import with_chroma
from v2v_server.store.planes.detail import DETAIL, detail_planes, read_levels
from v2v_server.store.planes.motion import MotionWatch, read_motion, with_motion, without_still_margins
from v2v_server.store.planes.plane import PLANES
from v2v_server.store.reader import StoreFile
from v2v_server.video.collect import Cut
from v2v_server.video.decode import DecodedClip, decode_cuts, stream_luma
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MOST_BITS, SDR, Signal
from v2v_server.video.orientation import Window
from v2v_server.video.probe import VideoFacts, probe

STORE_FORMAT = "v2v store"
"""Name of the store file format, which only a lossless corpus can serve."""


def clips_of(
    path: str | os.PathLike[str],
    fingerprint: str,
    index: FrameIndex,
    start: int,
    cuts: Sequence[Cut],
    stride: int,
    rows: tuple[int, int] | None = None,
    most_bits: int | None = None,
) -> tuple[DecodedClip, ...]:
    """Return several cuts of the frames from ``start`` on, see :func:`v2v_server.video.decode.decode_cuts`.

    Args:
        path: a video, or a store file.
        fingerprint: of the video, or of the source of the store file.
        rows: (first, one after the last) usable row, which the cells of a cut count from; None: all rows.
        most_bits: see :func:`v2v_server.video.decode.decode_cuts`.

    Raises:
        UsageError, VideoError: see :func:`v2v_server.video.decode.decode_cuts`; also if the file is, or was made from,
            another video, or a store file lacks the detail of deeper levels or the colour.
    """
    top, bottom = rows or (0, index.height_px)
    picture = top, 0, bottom - top, index.width_px
    if not is_store_file(path):
        check_fingerprint(path, fingerprint)
        motion = MotionWatch(cuts, picture)
        return motion.added_to(
            decode_cuts(path, index, start, cuts, stride=stride, most_bits=most_bits, watch=motion.watch)
        )
    with StoreFile(path, fingerprint) as stored:
        bits = min(most_bits or SDR.bits, stored.head.bits)
        signal = SDR if most_bits is None else Signal(bits, stored.head.transfer)
        if not stored.planes.issuperset(detail_planes(signal)):
            why = f"the store file lacks the plane {DETAIL} of its {bits} bits: re-create it with v2v-prepare"
            raise VideoError(os.fspath(path), None, why)
        files = [(stored, range(max(cut.count for cut in cuts)))]
        vectors = read_motion(files, start, cuts, stride, picture)
        cuts = without_still_margins(cuts, vectors)
        clips = tuple(stored_clip(stored, index, start, cut, stride, signal) for cut in cuts)
        return with_motion(with_chroma(clips, cuts, files, start, stride), cuts, vectors)


def stored_clip(
    stored: StoreFile, index: FrameIndex, start: int, cut: Cut, stride: int, signal: Signal = SDR
) -> DecodedClip:
    """Read one cut from an open store file that holds all of it."""
    head = stored.head
    window = cut.window or (head.top, 0, head.rows, head.width_px)
    frames = np.empty((cut.count, *window[2:]), signal.dtype)
    read_levels(stored, start, stride, window, frames, signal)
    seconds = index.seconds(start, (cut.count - 1) * stride + 1)[::stride]
    return DecodedClip(frames, seconds, head.codec, head.bit_exact, "store", signal=signal)


def signal_of(path: str | os.PathLike[str], index: FrameIndex) -> Signal:
    """Return what the levels of a video mean, by its first frame, or those of the source of a store file.

    Raises:
        VideoError: see :func:`clips_of`.
    """
    if not is_store_file(path):
        return decode_cuts(path, index, index.first, [Cut(1, (0, 0, 1, 1))], most_bits=MOST_BITS)[0].signal
    with StoreFile(path) as stored:
        return stored.head.signal


def check_file(path: str | os.PathLike[str], fingerprint: str) -> None:
    """Check that a file is the catalogued video, or was made from it.

    Raises:
        VideoError: it is another one, or cannot be read.
    """
    if is_store_file(path):
        StoreFile(path, fingerprint).__exit__(None, None, None)
    else:
        check_fingerprint(path, fingerprint)


def pictures_of(path: str | os.PathLike[str], index: FrameIndex, window: Window) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield all frames of a video, see :func:`v2v_server.video.decode.stream_luma`."""
    if not is_store_file(path):
        yield from stream_luma(path, index, 0, len(index), window)
        return
    with StoreFile(path) as stored:
        yield from stored_pictures(stored, window)


def stored_pictures(stored: StoreFile, window: Window) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield all frames that an open store file holds."""
    head = stored.head
    for number in range(head.groups):
        frames = np.empty((head.group_frames(number), *window[2:]), np.uint8)
        stored.read(head.first + number * head.group, 1, window, frames)
        yield from frames


def stored_arrays(stored: StoreFile, name: str) -> Iterator[npt.NDArray[Any]]:
    """Yield the arrays of a plane, one for each frame that an open store file holds."""
    head = stored.head
    _, rows, columns = PLANES[name].shape(head.rows, head.width_px)
    for number in range(head.groups):
        start, count = head.first + number * head.group, head.group_frames(number)
        for array in stored.plane(name, start, count, (0, 0, rows, columns)):
            yield np.ascontiguousarray(array)


def facts_of(path: str | os.PathLike[str]) -> VideoFacts:
    """Probe a file, see :func:`v2v_server.video.probe.probe`. A store file reports the facts of its source.

    Raises:
        VideoError: see :func:`v2v_server.video.probe.probe`.
    """
    if not is_store_file(path):
        return probe(path)
    with StoreFile(path) as stored:
        head = stored.head
    try:
        index = FrameIndex.from_bytes(head.index)
    except ProtocolError as error:
        raise VideoError(os.fspath(path), None, f"its index is damaged: {error}") from error
    if (len(index), index.height_px, index.width_px) != (head.frames, head.height_px, head.width_px):
        raise VideoError(os.fspath(path), None, f"its index has {index}, and its head {head.frames} frames")
    return VideoFacts(
        frames=head.frames,
        height_px=head.height_px,
        width_px=head.width_px,
        codec=STORE_FORMAT,
        pixel_format="gray",
        frames_per_second=head.frames_per_second or math.nan,
        rotation_degrees=0,
        full_range=True,
        interlaced=False,
        index=index,
    )
