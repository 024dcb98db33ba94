"""Finding out what a video file holds: one pass over its packets, of which only the first few are decoded."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from fractions import Fraction

import av
import numpy as np
from av.container import InputContainer
from av.format import Flags
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_SIDE_PX, NO_TIMESTAMP, FrameIndex, unseekable
from v2v_server.video.hidden import is_hidden
from v2v_server.video.luma import LumaFormat
from v2v_server.video.orientation import Orientation
from v2v_server.video.source import opened, packets, pictures, reason, time_base
from v2v_server.video.tiles import tiles_of


@dataclass(frozen=True, slots=True)
class VideoFacts:
    """What a video file holds.

    Attributes:
        frames: how many frames there are to decode; the container's own count is not believed.
        height_px, width_px: size of the upright picture.
        codec: FFmpeg's name of the format ("h264", "vp9"), whichever decoder is used.
        pixel_format: FFmpeg's name of the decoded format ("yuv420p10le").
        frames_per_second: average rate: from the first and last time stamps, else the container's; NaN if unknown.
        rotation_degrees: of the display matrix, counter-clockwise as FFmpeg reports it (-90 .. 180).
        full_range: whether luma spans 0 .. 255 (see :mod:`v2v_server.video.luma`).
        index: the frames.
    """

    frames: int
    height_px: int
    width_px: int
    codec: str
    pixel_format: str
    frames_per_second: float
    rotation_degrees: int
    full_range: bool
    index: FrameIndex


def probe(path: str | os.PathLike[str]) -> VideoFacts:
    """Open, decode the first frame, and walk over all packets.

    Frames that the decoder does not deliver are not counted: hidden reference frames, frames outside the edit list,
    and those in front of the first one that can be decoded in a file cut in mid-GOP. A file whose time stamps cannot
    be trusted is decoded once to be counted, as far as it decodes.

    Raises:
        VideoError: the file does not open, has no video track, or not one frame of it decodes.
    """
    name = os.fspath(path)
    try:
        with opened(name) as (container, stream):
            tiles = tiles_of(name, container)
            head, shown = _walk(name, container, stream)
            base = time_base(stream)
            # Read before the container is closed: the stream's fields are gone after that.
            rate = stream.average_rate or stream.guessed_rate
            reorders = _reorders_without_pts(container, stream)
            codec = stream.codec_context.codec.canonical_name
    except av.FFmpegError as error:
        raise VideoError(name, None, f"cannot be read: {reason(error)}") from error
    height, width = Orientation.of(head).size(head.height, head.width)
    if tiles:
        width = tiles[-1].right_px
    if not (1 <= height <= LARGEST_SIDE_PX and 1 <= width <= LARGEST_SIDE_PX):
        raise VideoError(name, None, f"its picture of {width}x{height} px is larger than {LARGEST_SIDE_PX} px a side")
    index = None if reorders else _index(shown, head, base, (height, width))
    if tiles:
        if index is None or Orientation.of(head) != Orientation():
            raise VideoError(name, None, "calls its tracks tiles, but they are turned or cannot be sought")
        index = replace(index, tiles=tiles)
    if index is None:
        index = unseekable(_count_by_decoding(name), base, height, width)
    if not 1 <= len(index) <= LARGEST_FRAMES:
        raise VideoError(name, None, f"holds {len(index)} frames; this program serves 1 .. {LARGEST_FRAMES}")
    return VideoFacts(
        frames=len(index),
        height_px=height,
        width_px=width,
        codec=codec,
        pixel_format=head.format.name,
        frames_per_second=_rate(index, rate),
        rotation_degrees=head.rotation,
        full_range=LumaFormat.of(head).full_range,
        index=index,
    )


@dataclass(frozen=True, slots=True)
class _Shown:
    """A packet that gives one frame."""

    pts: int | None
    dts: int | None
    keyframe: bool


def _walk(name: str, container: InputContainer, stream: VideoStream) -> tuple[VideoFrame, list[_Shown]]:
    """The first frame that decodes without error, and every packet that gives a frame, in stored order."""
    codec = stream.codec_context.codec.canonical_name
    head: VideoFrame | None = None
    failure: av.FFmpegError | None = None
    shown: list[_Shown] = []
    for packet in packets(container, stream):
        if head is None:
            head, failure = _first_sound(stream, packet, failure)
        if not packet.is_discard and not is_hidden(codec, memoryview(packet)):
            shown.append(_Shown(packet.pts, packet.dts, packet.is_keyframe))
    if head is None:
        head, failure = _first_sound(stream, None, failure)
    if head is None:
        raise VideoError(name, 0, f"no frame decodes: {reason(failure) if failure else 'its track is empty'}")
    return head, shown


def _first_sound(
    stream: VideoStream, packet: Packet[VideoStream] | None, failure: av.FFmpegError | None
) -> tuple[VideoFrame | None, av.FFmpegError | None]:
    try:
        frames = stream.decode(packet)
    except av.FFmpegError as error:
        return None, failure or error
    return next((frame for frame in frames if not frame.is_corrupt), None), failure


def _reorders_without_pts(container: InputContainer, stream: VideoStream) -> bool:
    """Whether the decoder reorders frames although the container stores no presentation time stamps.

    libavformat then guesses them from the stored order, wrongly.
    """
    names = container.format.name.split(",")
    stores_none = "avi" in names or bool(Flags(container.format.flags) & Flags.no_timestamps)
    return stores_none and bool(stream.codec_context.has_b_frames)


def _index(shown: list[_Shown], head: VideoFrame, base: tuple[int, int], size: tuple[int, int]) -> FrameIndex | None:
    """The index by presentation time; None when the time stamps do not name the frames."""
    if head.pts is None or any(packet.pts is None for packet in shown):
        return None
    # The decoder delivers in order of presentation: what lies before its first frame never comes.
    kept = sorted((p for p in shown if p.pts is not None and p.pts >= head.pts), key=lambda p: p.pts or 0)
    pts = np.array([p.pts for p in kept], np.int64)
    if not len(pts) or pts[0] != head.pts or np.any(pts[1:] == pts[:-1]):
        return None
    keys = [ordinal for ordinal, packet in enumerate(kept) if packet.keyframe]
    dts = [kept[ordinal].dts for ordinal in keys]
    return FrameIndex(
        first=0,
        pts=pts,
        keyframes=np.array(keys, np.int64),
        keyframe_dts=np.array([NO_TIMESTAMP if value is None else value for value in dts], np.int64),
        time_base=base,
        height_px=size[0],
        width_px=size[1],
        seekable=True,
    )


def _count_by_decoding(name: str) -> int:
    """How many sound frames the decoder delivers before the first error."""
    count = 0
    with opened(name) as (container, stream):
        try:
            for frame in pictures(container, stream):
                if frame.is_corrupt:
                    break
                count += 1
        except av.FFmpegError:
            return count  # what lies behind the error cannot be had; what lies before it can
    return count


def _rate(index: FrameIndex, stated: Fraction | None) -> float:
    if index.seekable and len(index) > 1:
        numerator, denominator = index.time_base
        return (len(index) - 1) * denominator / (int(index.pts[-1] - index.pts[0]) * numerator)
    return float(stated) if stated else float("nan")
