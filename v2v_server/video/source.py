"""Opening a video file for sequential, single-threaded reading of its picture track."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction

import av
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError

_SKIP = {"skip-unreferenced": "noref", "skip": "all"}
_STILL = Disposition.attached_pic | Disposition.timed_thumbnails


@contextmanager
def opened(
    path: str | os.PathLike[str], loop_filter: str = "exact", track: int = 0
) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container and its video track, closed at the end whatever happens.

    Tracks whose pictures are cover art do not count; the decoder runs in the calling thread only.

    Args:
        path: the file.
        loop_filter: one of ``v2v_protocol.spec.LOOP_FILTERS``.
        track: which of the video tracks: a tile, see :mod:`v2v_server.video.tiles`.

    Raises:
        VideoError: the file cannot be opened, or has no such video track.
    """
    name = os.fspath(path)
    try:
        # FFmpeg takes "12:30.mp4" for an address; no absolute path looks like one.
        container = av.open(os.path.abspath(name), "r")
    except (av.FFmpegError, OSError) as error:
        raise VideoError(name, None, f"cannot be opened: {reason(error)}") from error
    except UnicodeError as error:
        raise VideoError(name, None, f"cannot be opened: its name is not valid text ({error})") from error
    try:
        tracks = picture_tracks(container)
        if track >= len(tracks):
            raise VideoError(name, None, f"has no video track {track}" if track else "has no video track")
        stream = tracks[track]
        if stream.codec_context is None:
            raise VideoError(name, None, "holds a video codec that this build of FFmpeg cannot decode")
        for other in tracks:
            if other is not stream and hasattr(other, "discard"):  # PyAV 17 and later
                other.discard = type(other.discard).all  # the demuxer need not read it
        stream.thread_type = "NONE"
        stream.codec_context.thread_count = 1
        if loop_filter != "exact":
            stream.codec_context.options = {"skip_loop_filter": _SKIP[loop_filter]}
        yield container, stream
    finally:
        container.close()


def picture_tracks(container: InputContainer) -> list[VideoStream]:
    """The video tracks that are no cover art."""
    return [stream for stream in container.streams.video if not stream.disposition & _STILL]


def packets(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    """The track's packets in stored order. Empty ones (AVI's dropped frames) are left out: a decoder would take them
    for the end of the stream."""
    for packet in container.demux(stream):
        if packet.size:
            yield packet


def pictures(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """All frames from the current position, in the decoder's order of output."""
    for packet in packets(container, stream):
        yield from stream.decode(packet)
    yield from stream.decode(None)


def time_base(stream: VideoStream) -> tuple[int, int]:
    """(numerator, denominator) of the track's clock; 1/1 where the container states none."""
    base = stream.time_base or Fraction(1)
    return (base.numerator, base.denominator) if base > 0 else (1, 1)


def reason(error: BaseException) -> str:
    """One line that says what FFmpeg or the system complained about."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())
