"""Decoding a range of frames to luma, exactly.

The one rule: every frame delivered is the frame that was asked for. In a seekable file frames are known by their time
stamps, and each one is compared with the index; in any other file they are counted from the beginning.

A seek is believed only if decoding really began at the keyframe that the index names and the decoder itself calls it
one. Anything else (a container that marks frames as keyframes that are none, a demuxer that lands elsewhere, H.264 with
gradual refresh) falls back to decoding every frame from the beginning, which also has the last word on damaged files.

Some encoders name their version in the file's first packet only, and FFmpeg's decoders allow for the faults of that
version: 4:4:4 H.264 of x264 before build 151 comes out wrong otherwise. So they see the first packet before a seek.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import UsageError, VideoError
from v2v_server.video.h264 import is_unreferenced, length_bytes
from v2v_server.video.index import NO_TIMESTAMP, FrameIndex
from v2v_server.video.luma import LumaFormat, copy_luma, range_table
from v2v_server.video.orientation import Orientation, Window
from v2v_server.video.source import opened, packets, reason
from v2v_server.video.tiles import Part, parts

BIT_EXACT_CODECS = frozenset({"h264", "hevc", "vp8", "vp9", "av1", "ffv1", "huffyuv", "ffvhuff", "png", "utvideo"})
"""Codecs whose standard fixes every bit of the decoded picture, or that are lossless, so that all hosts agree. Not so
MPEG-1, 2, 4 and MJPEG: their standards leave the precision of the inverse transform open."""

_VERSIONED_CODECS = frozenset({"h264", "mpeg4"})


@dataclass(frozen=True, slots=True)
class DecodedClip:
    """A range of frames.

    Attributes:
        frames: [count, h, w] uint8, C-contiguous: full-range luma (see :mod:`v2v_server.video.luma`).
        seconds: [count] float64, presentation times; NaN where unknown.
        codec: FFmpeg's name of the format.
        bit_exact: whether every host decodes these very bytes.
    """

    frames: npt.NDArray[np.uint8]
    seconds: npt.NDArray[np.float64]
    codec: str
    bit_exact: bool


@dataclass(frozen=True, slots=True)
class Cut:
    """What one sample takes of a clip.

    Attributes:
        count: number of frames, at least 1; with a stride, of those that are taken.
        window: (top, left, height, width) in the upright picture, pixels; None takes all of it.
    """

    count: int
    window: Window | None = None


@dataclass(frozen=True, slots=True)
class _Task:
    """Which frames of a file are to be decoded.

    Attributes:
        path, index, start, stride, loop_filter: see :func:`decode_cuts`; the index is that of the track.
        track: of the file.
    """

    path: str
    index: FrameIndex
    start: int
    stride: int
    loop_filter: str
    track: int = 0


class _SeekFailed(Exception):
    """Decoding did not begin at the keyframe that the index names."""


def decode_luma(
    path: str | os.PathLike[str], index: FrameIndex, start: int, count: int, window: Window | None = None
) -> DecodedClip:
    """Frames start .. start + count - 1 of a video, or a window of them: :func:`decode_cuts` for a single cut."""
    return decode_cuts(path, index, start, [Cut(count, window)])[0]


def decode_cuts(
    path: str | os.PathLike[str],
    index: FrameIndex,
    start: int,
    cuts: Sequence[Cut],
    *,
    stride: int = 1,
    loop_filter: str = "exact",
) -> tuple[DecodedClip, ...]:
    """Several cuts of the frames from ``start`` on, from one pass of the decoder (one a tile, where there are tiles).

    Memory: the cuts themselves (frames x height x width bytes each) and what the decoder holds.

    Args:
        path: the file.
        index: its index, or a slice of it that holds the range.
        start: ordinal of the first frame, presentation order.
        cuts: at least one.
        stride: takes frames start, start + stride ...
        loop_filter: one of ``v2v_protocol.spec.LOOP_FILTERS``.

    Raises:
        UsageError: a range outside the index, or a window outside the picture.
        VideoError: a frame of the longest cut is missing or damaged, the file is shorter than its index, or the
            picture's size or format is not the same all along. Its ``frame`` is the ordinal of the first frame that
            could not be had.
    """
    for cut in cuts:
        index.position(start, (cut.count - 1) * stride + 1)
    checked = [Cut(cut.count, _checked(cut.window, index)) for cut in cuts]
    decode = _decode_tiles if index.tiles else _decode_track
    taken, codec = decode(_Task(os.fspath(path), index, start, stride, loop_filter), checked)
    return tuple(
        DecodedClip(
            grey, index.seconds(start, (cut.count - 1) * stride + 1)[::stride], codec, codec in BIT_EXACT_CODECS
        )
        for grey, cut in zip(taken, checked, strict=True)
    )


def _checked(window: Window | None, index: FrameIndex) -> Window:
    if window is None:
        return 0, 0, index.height_px, index.width_px
    top, left, height, width = window
    inside = top >= 0 and left >= 0 and top + height <= index.height_px and left + width <= index.width_px
    if not inside or height < 1 or width < 1:
        raise UsageError(
            f"window (top {top}, left {left}, {width}x{height} px) does not lie inside a picture of "
            f"{index.width_px}x{index.height_px} px"
        )
    return window


def _window(cut: Cut) -> Window:
    """Of a cut that was checked."""
    assert cut.window is not None
    return cut.window


def _decode_tiles(task: _Task, cuts: Sequence[Cut]) -> tuple[list[npt.NDArray[np.uint8]], str]:
    """The cuts of a picture in tiles: each tile that one of them touches is decoded, by itself, and no other."""
    whole = [np.empty((cut.count, *_window(cut)[2:]), np.uint8) for cut in cuts]
    needed: dict[int, list[tuple[int, Part]]] = {}
    for number, cut in enumerate(cuts):
        for part in parts(_window(cut), task.index.tiles):
            needed.setdefault(part.track, []).append((number, part))
    codec = ""
    for track, wanted in needed.items():
        tile = replace(task, index=task.index.of_tile(track), track=track)
        into = [whole[number][:, :, part.left : part.left + part.window[3]] for number, part in wanted]
        taken, codec = _decode_track(tile, [Cut(cuts[number].count, part.window) for number, part in wanted], into)
        for place, frames in zip(into, taken, strict=True):
            if frames is not place:
                place[...] = frames
    return whole, codec


def _decode_track(
    task: _Task, cuts: Sequence[Cut], into: Sequence[npt.NDArray[np.uint8]] = ()
) -> tuple[list[npt.NDArray[np.uint8]], str]:
    """The cuts of the pictures of one track, [count, h, w] uint8 each, and the codec's name.

    Args:
        into: arrays for the cuts, which are used where the stored picture stands upright.
    """
    stack = _Stack(task, cuts, into)
    try:
        done = _decode_quickly(stack)
    except (_SeekFailed, VideoError):
        done = False
        stack = _Stack(task, cuts, into)
    if not done:
        _decode_plainly(stack)
    return list(stack.grey()), stack.codec


def _decode_quickly(stack: _Stack) -> bool:
    """Decode from the last keyframe at or before the range, leaving out what nothing refers to; False when there is
    nothing to be saved.

    Raises:
        _SeekFailed, VideoError: it did not work out; decoding plainly has the last word.
    """
    task, index = stack.task, stack.task.index
    if not index.seekable or task.start == 0:
        return False
    which = int(np.searchsorted(index.keyframes, task.start, side="right")) - 1
    keyframe = int(index.keyframes[which]) if which >= 0 else 0
    begin = int(index.pts[index.position(task.start, 1)])
    with opened(task.path, task.loop_filter, task.track) as (container, stream):
        codec = stream.codec_context.codec.canonical_name
        prefix = length_bytes(stream.codec_context.extradata) if codec == "h264" else 0
        stack.sparse = prefix > 0
        try:
            if keyframe == 0:
                source = packets(container, stream)
            else:
                if codec in _VERSIONED_CODECS:
                    _show_first_packet(container, stream)
                pts, dts = int(index.pts[keyframe - index.first]), int(index.keyframe_dts[which])
                source = _packets_from(container, stream, pts, dts)
            frames = _decoded(stream, _needed(source, begin, prefix) if prefix else source)
            _fill(stack, _from_keyframe(frames, pts) if keyframe else frames)
        except av.FFmpegError as error:
            raise _SeekFailed from error
        stack.close(codec)
    return True


def _decode_plainly(stack: _Stack) -> None:
    """Decode every frame from the beginning of the file."""
    task = stack.task
    with opened(task.path, task.loop_filter, task.track) as (container, stream):
        try:
            _fill(stack, _decoded(stream, packets(container, stream)))
        except av.FFmpegError as error:
            stack.refuse(f"does not decode: {reason(error)}")
        stack.close(stream.codec_context.codec.canonical_name)


def _fill(stack: _Stack, frames: Iterator[VideoFrame]) -> None:
    for frame in frames:
        if stack.take(frame):
            return


def _decoded(stream: VideoStream, source: Iterator[Packet[VideoStream]]) -> Iterator[VideoFrame]:
    for packet in source:
        yield from stream.decode(packet)
    yield from stream.decode(None)


def _needed(source: Iterator[Packet[VideoStream]], begin: int, prefix: int) -> Iterator[Packet[VideoStream]]:
    """H.264 packets without those that present before the time stamp ``begin`` and that nothing refers to."""
    for packet in source:
        if packet.pts is None or packet.pts >= begin or not is_unreferenced(memoryview(packet), prefix):
            yield packet


def _from_keyframe(frames: Iterator[VideoFrame], pts: int) -> Iterator[VideoFrame]:
    """The same frames, once it is certain that the first is the keyframe of that pts.

    Raises:
        _SeekFailed: it is not.
    """
    verified = False
    for frame in frames:
        if frame.pts is not None and frame.pts < pts:
            continue  # a leading picture of an open GOP: it needs what came before
        if not verified and (frame.pts != pts or not frame.key_frame):
            raise _SeekFailed
        verified = True
        yield frame
    if not verified:
        raise _SeekFailed


def _show_first_packet(container: InputContainer, stream: VideoStream) -> None:
    for packet in packets(container, stream):
        try:
            stream.decode(packet)
        except av.FFmpegError:
            return  # a damaged beginning tells the decoder nothing, and need not spoil what lies behind the keyframe
        return


def _packets_from(container: InputContainer, stream: VideoStream, pts: int, dts: int) -> Iterator[Packet[VideoStream]]:
    """The packets from the keyframe of that pts on.

    Demuxers differ in whether they seek by pts or by dts, and where they land: everything in front of the keyframe is
    passed over, and a landing behind it is tried again with the other time stamp.

    Raises:
        _SeekFailed: the keyframe was not met.
    """
    for target in (pts, dts):
        if target == NO_TIMESTAMP:
            continue
        container.seek(target, stream=stream)
        found = False
        for packet in packets(container, stream):
            if not found:
                found = packet.pts == pts and packet.is_keyframe
                if not found and packet.pts is not None and packet.pts > pts:
                    break
            if found:
                yield packet
        if found:
            return
    raise _SeekFailed


class _Stack:
    """Collects the asked frames of one pass, and refuses what is not exactly that."""

    def __init__(self, task: _Task, cuts: Sequence[Cut], into: Sequence[npt.NDArray[np.uint8]]) -> None:
        self.task = task
        self.index = index = task.index
        self.codec = ""
        self.sparse = False  # whether frames before the range are left out on purpose
        self._cuts = cuts
        self._into = into
        self._stride = stride = task.stride
        first, most = task.start - index.first, max(cut.count for cut in cuts)
        self._expected = index.pts[first : first + (most - 1) * stride + 1 : stride].tolist()
        self._seen = 0  # frames delivered by the decoder, for files where they must be counted
        self._taken = 0
        self._cursor = 0  # where the next frame is expected in the index
        self._damaged = False
        self._parts: list[tuple[Window, npt.NDArray[np.uint8]]] = []  # stored window and frames of each cut

    def take(self, frame: VideoFrame) -> bool:
        """Look at the next frame that the decoder delivers; True once the last asked one is in."""
        ordinal, self._seen = self._seen, self._seen + 1
        # A damaged or lost frame spoils what refers to it, until decoding starts afresh.
        lost = not self.sparse and self._after_a_gap(frame)
        self._damaged = frame.is_corrupt or ((self._damaged or lost) and not frame.key_frame)
        if not self._is_next(frame, ordinal):
            return False
        if self._damaged:
            self.refuse("is damaged, or refers to a damaged or lost frame")
        self._copy(frame)
        self._taken += 1
        return self._taken == len(self._expected)

    def _after_a_gap(self, frame: VideoFrame) -> bool:
        """Whether the decoder has left out a frame that the index lists in front of this one."""
        pts, at = self.index.pts, self._cursor
        if not self.index.seekable or frame.pts is None or frame.pts < pts[0]:
            return False
        found = at if at < len(pts) and pts[at] == frame.pts else int(np.searchsorted(pts, frame.pts))
        self._cursor = found + 1
        return found > at

    def _is_next(self, frame: VideoFrame, ordinal: int) -> bool:
        if not self.index.seekable:
            return ordinal >= self.task.start and (ordinal - self.task.start) % self._stride == 0
        if frame.pts is None:
            self.refuse("the decoder delivers a frame without a time stamp")
        expected = self._expected[self._taken]
        if frame.pts == expected:
            return True
        if frame.pts > expected:
            self.refuse(f"is missing: the decoder delivers time stamp {frame.pts} where {expected} should come")
        if self._taken and not self._is_passed_over(frame.pts):
            self.refuse(
                f"the decoder delivers time stamp {frame.pts}, which the index does not have, before {expected}"
            )
        return False

    def _is_passed_over(self, pts: int) -> bool:
        """Whether a frame that presents before the next one to take is one that the stride leaves out."""
        return self._stride > 1 and bool(np.any(self.index.pts == pts))

    def _copy(self, frame: VideoFrame) -> None:
        if not self._parts:
            self._luma, self._orientation = LumaFormat.of(frame), Orientation.of(frame)
            self._size = self._orientation.size(self.index.height_px, self.index.width_px)
            self._parts = [self._part(number, cut) for number, cut in enumerate(self._cuts)]
        if (frame.height, frame.width) != self._size:
            height, width = self._orientation.size(frame.height, frame.width)
            self.refuse(
                f"the picture is {width}x{height} px here and {self.index.width_px}x{self.index.height_px} px at first"
            )
        if not self._luma.describes(frame):
            self.refuse(f"the picture format changes from {self._luma} to {LumaFormat.of(frame)}")
        for stored, raw in self._parts:
            if self._taken < len(raw):
                copy_luma(frame, self._luma, stored, raw[self._taken])

    def _part(self, number: int, cut: Cut) -> tuple[Window, npt.NDArray[np.uint8]]:
        window = _window(cut)
        stored = self._orientation.stored_window(window, self.index.height_px, self.index.width_px)
        if self._into and self._orientation == Orientation():
            return stored, self._into[number]
        return stored, np.empty((cut.count, *stored[2:]), np.uint8)

    def close(self, codec: str) -> None:
        """The end of the pass: make sure that every asked frame came."""
        if self._taken < len(self._expected):
            self.refuse("the file ends before it")
        self.codec = codec

    def refuse(self, why: str) -> NoReturn:
        """Blame the next frame that should have come.

        Raises:
            VideoError: always.
        """
        raise VideoError(self.task.path, self.task.start + self._taken * self._stride, why)

    def grey(self) -> Iterator[npt.NDArray[np.uint8]]:
        """The collected frames of each cut, [count, h, w] uint8: upright, in full range."""
        for _, raw in self._parts:
            if self._luma.bits == 8 and not self._luma.full_range:
                for rows in (raw.reshape(-1, raw.shape[-1]),) if raw.flags.c_contiguous else raw:
                    cv2.LUT(rows, range_table(8, False), dst=rows)
            yield self._orientation.upright(raw) if raw.flags.c_contiguous else raw
