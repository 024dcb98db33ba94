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
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError
from v2v_server.video.collect import BIT_EXACT_CODECS, ClipRequest, Cut, DecodedFrame, DecodedPicture, Stack, Watch
from v2v_server.video.colour.chroma import Chroma
from v2v_server.video.frame_index import NO_TIMESTAMP, FrameIndex
from v2v_server.video.luma import SDR, Signal
from v2v_server.video.packets import is_unreferenced, length_bytes
from v2v_server.video.source import opened, packets, reason

_VERSIONED_CODECS = frozenset({"h264", "mpeg4"})


@dataclass(frozen=True, slots=True)
class DecodedClip:
    """A range of frames.

    Attributes:
        frames: [count, h, w], C-contiguous: full-range luma (see :mod:`v2v_server.video.luma`), uint8, or uint16 if the
            signal has more than 8 bits.
        seconds: [count] float64, presentation times; NaN where unknown.
        codec: FFmpeg's name of the format.
        bit_exact: whether every host decodes these very bytes.
        origin: "" where they were decoded just now; "store" or "cache" where they were read from there.
        chroma: colour of the frames that the cut names; None without.
        signal: what the levels mean.
        motion: [count, 2, rows, columns] int16, the motion to each frame from the one before in the cells of its cut
            (:mod:`v2v_server.motion`), zero for the first; None if it was not asked for.
        arrays: arrays of the sample that come with the pixels, by name, as they are delivered.
        is_view: whether the frames are what the camera of the sample sees, so that its view is not applied.
        levels: :class:`v2v_server.simulation.voxel.Levels` between these frames; None without.
    """

    frames: npt.NDArray[Any]
    seconds: npt.NDArray[np.float64]
    codec: str
    bit_exact: bool
    origin: str = ""
    chroma: Chroma | None = None
    signal: Signal = SDR
    motion: npt.NDArray[np.int16] | None = None
    arrays: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    is_view: bool = False
    levels: Any = None  # of a package above this one


Way = Callable[[Stack], Generator[VideoFrame, None, None]]
"""Yields the decoded frames for a stack."""


class _SeekFailed(Exception):
    """Decoding did not begin at the keyframe that the index names."""


def decode_cuts(
    path: str | os.PathLike[str],
    request: ClipRequest,
    watch: Watch | None = None,
    ways: Sequence[Way] = (),
) -> tuple[DecodedClip, ...]:
    """Return several cuts of some frames, from one pass of the decoder.

    Memory: the cuts themselves (frames x height x width bytes each) and what the decoder holds.

    Args:
        path: the file.
        request: what is wanted.
        watch: looks at the frames of the longest cut.
        ways: of getting the frames, each tried where the one before failed; none: those of a video file.

    Raises:
        UsageError: a range outside the index, or a window outside the picture.
        VideoError: a frame of the longest cut is missing or damaged, the file is shorter than its index, or the
            picture's size or format changes. Its ``frame`` is the ordinal of the first frame that was not delivered.
    """
    request.check()
    for stack in _passes(path, request, watch, ways):  # noqa: B007 - the last one is complete
        pass
    return tuple(
        DecodedClip(
            grey, request.seconds(cut), stack.codec, stack.codec in BIT_EXACT_CODECS, signal=stack.signal, chroma=chroma
        )
        for grey, chroma, cut in zip(stack.grey(), stack.chroma(), request.cuts, strict=True)
    )


def stream_pictures(
    path: str | os.PathLike[str], request: ClipRequest, ways: Sequence[Way] = ()
) -> Generator[DecodedPicture, None, None]:
    """Yield the frames of the only cut of a request, in the memory of one. See :func:`decode_cuts`."""
    request.check()
    (cut,), done = request.cuts, 0
    shown: list[DecodedPicture] = []

    def see(frame: DecodedFrame) -> None:
        shown[:] = [frame.picture(request.window(cut), cut.chroma)]

    for stack in _passes(path, request, lambda: see, ways, collects=False):
        if stack.taken > done:
            done += 1
            yield shown[0]


def decodes_as_listed(path: str, index: FrameIndex, start: int, count: int) -> bool:
    """Return whether the decoder delivers these frames, undamaged and all alike.

    Raises:
        UsageError: the range does not lie in the index.
    """
    index.position(start, count)
    try:
        for _ in _passes(path, ClipRequest(index, start, (Cut(count, (0, 0, 1, 1)),))):
            pass
    except VideoError:
        return False
    return True


def _passes(
    path: str | os.PathLike[str],
    wanted: ClipRequest,
    watch: Watch | None = None,
    ways: Sequence[Way] = (),
    *,
    collects: bool = True,
) -> Generator[Stack, None, None]:
    """Decode in one way after the other, until one does not fail; yield the stack of the pass after each frame."""
    for frames_of in ways or _WAYS:
        stack = Stack(os.fspath(path), wanted, watch, collects=collects)
        try:
            with closing(frames_of(stack)) as frames:
                for frame in frames:
                    complete = stack.take(frame)
                    yield stack
                    if complete:
                        return
            stack.refuse("the file ends before it")
        except _SeekFailed:
            continue
        except VideoError:
            if frames_of is (ways or _WAYS)[-1]:
                raise


def _from_keyframe_on(stack: Stack) -> Generator[VideoFrame, None, None]:
    """Yield the frames from the last keyframe at or before the range, without unreferenced ones.

    Raises:
        _SeekFailed, VideoError: seeking failed or saves nothing: decode from the beginning instead.
    """
    wanted, index = stack.wanted, stack.wanted.index
    if not index.seekable or wanted.start == 0:
        raise _SeekFailed
    which = int(np.searchsorted(index.keyframes, wanted.start, side="right")) - 1
    keyframe = int(index.keyframes[which]) if which >= 0 else 0
    begin = int(index.pts[index.position(wanted.start, 1)])
    with opened(stack.path) as (container, stream):
        codec = stack.codec = stream.codec_context.codec.canonical_name
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
            yield from _from_keyframe(frames, pts) if keyframe else frames
        except av.FFmpegError as error:
            raise _SeekFailed from error


def _from_beginning(stack: Stack) -> Generator[VideoFrame, None, None]:
    """Every frame of the file."""
    with opened(stack.path) as (container, stream):
        stack.codec = stream.codec_context.codec.canonical_name
        begun = False
        for packet in chain(packets(container, stream), [None]):
            try:
                frames = stream.decode(packet)
            except av.FFmpegError as error:
                if begun:
                    stack.refuse(f"does not decode: {reason(error)}")
                continue  # a file may begin in the middle of a group of frames
            begun |= any(not frame.is_corrupt for frame in frames)
            yield from frames


_WAYS: Sequence[Way] = (_from_keyframe_on, _from_beginning)


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
    """Yield the same frames after checking that the first is the keyframe of that pts.

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
    """Yield the packets from the keyframe of that pts on.

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
