"""Opening a video file for sequential, single-threaded reading of its picture track."""

from __future__ import annotations

import os
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from fractions import Fraction
from itertools import islice

import av
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError, VideoUnreadable
from v2v_server.video.container import TRANSPORT_BYTES, describe_cut

FORMATS = (
    "mov", "matroska", "avi", "dv", "flv", "ivf", "mpegts", "mpeg", "mpegvideo", "m4v", "mxf", "ogg", "asf", "h264",
    "hevc", "obu", "av1", "mjpeg", "yuv4mpegpipe",
)  # fmt: skip
"""FFmpeg's names of the containers that are read ("mov" is mp4 as well, "matroska" webm). None of them names other
files; playlists (concat, HLS, DASH), picture sequences and devices are not among them."""

CODECS = (
    "h264", "hevc", "vp8", "vp9", "libdav1d", "av1", "mpeg1video", "mpeg2video", "mpegvideo", "mpeg4", "msmpeg4v1",
    "msmpeg4v2", "msmpeg4", "wmv1", "wmv2", "wmv3", "vc1", "h263", "h263p", "flv", "vp6", "vp6f", "theora", "mjpeg",
    "dvvideo", "prores", "dnxhd", "cfhd", "ffv1", "huffyuv", "ffvhuff", "utvideo", "png", "rawvideo",
)  # fmt: skip
"""FFmpeg's names of the decoders that are used: those of formats that people have videos in. It has hundreds more, of
which some are hardly ever tested against damage."""

LARGEST_PICTURE_PX = 2**26
"""Most pixels of a picture, 8192 x 8192: a decoder may keep 16 of them, 1.6 GB."""

MOST_STREAMS = 100

_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": ",".join(FORMATS),
    "codec_whitelist": ",".join(CODECS),
    "max_streams": str(MOST_STREAMS),
    "max_pixels": str(LARGEST_PICTURE_PX),
}
_JPEG = b"\xff\xd8\xff"
_STILL = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
_MARKER_BYTES = 1024
"""Bytes at the end of a picture in which its last marker lies; behind it there may be padding."""
_END_OF_IMAGE = b"\xff\xd9"  # ITU-T T.81, B.1.1.3
_PACKETS_LOOKED_AT = 256
"""Of a file with several tracks: enough to see which of them hold a single picture."""


@contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a container and its video track; both are closed at the end.

    Of several tracks it is one with a decoder and more than one frame, the default one before others, a larger picture
    before smaller ones, and the first of equals. Stills such as cover art do not count. The decoder runs in the calling
    thread only. A file is opened by itself: nothing that it names.

    Args:
        path: the file.

    Raises:
        VideoError: the file cannot be opened, has no video track, or is of a format or size that is not read.
        VideoUnreadable: it is not a regular file.
    """
    name = os.fspath(path)
    try:
        # To open a named pipe waits for somebody to write into it, and a device may not end.
        if not stat.S_ISREG(os.stat(name).st_mode):
            raise VideoUnreadable(name, None, "is not a regular file")
        container = _open(name)
    except av.ArgumentError as error:
        why = f"is of no format that is read here, or damaged ({reason(error)}); these are read: {', '.join(FORMATS)}"
        raise VideoError(name, None, why) from error
    except (av.FFmpegError, OSError) as error:
        cut = "" if isinstance(error, OSError) else describe_cut(name)
        raise VideoError(name, None, f"{cut}{', and ' * bool(cut)}cannot be opened: {reason(error)}") from error
    except UnicodeError as error:
        why = f"cannot be opened: the name of the file is not valid text ({error}); rename it"
        raise VideoError(name, None, why) from error
    try:
        tracks = moving_tracks(container)
        if not tracks:
            raise VideoError(name, None, "has no video track")
        stream = _chosen(name, container, tracks)
        if stream.codec_context is None:
            raise VideoError(name, None, "holds a video codec that this build of FFmpeg cannot decode")
        decoder = stream.codec_context
        if decoder.codec.name not in CODECS:
            raise VideoError(name, None, f"holds {decoder.codec.name} video, which is not read here")
        if decoder.width * decoder.height > LARGEST_PICTURE_PX:
            size = f"{decoder.width}x{decoder.height} px"
            raise VideoError(name, None, f"its picture of {size} is larger than {LARGEST_PICTURE_PX} pixels")
        for other in tracks:
            if other is not stream:
                other.discard = type(other.discard).all  # the demuxer need not read it
        stream.thread_type = "NONE"
        decoder.thread_count = 1
        decoder.options = {"max_pixels": str(LARGEST_PICTURE_PX)}
        yield container, stream
    finally:
        container.close()


def moving_tracks(container: InputContainer) -> list[VideoStream]:
    """Return the tracks of pictures that are not stills such as cover art."""
    return [track for track in container.streams.video if not track.disposition & _STILL]


def _open(name: str) -> InputContainer:
    # FFmpeg takes "12:30.mp4" for an address; no absolute path looks like one. Tags need not be UTF-8: old cameras and
    # QuickTime write others.
    return av.open(os.path.abspath(name), "r", format=_raw_format(name), options=_OPTIONS, metadata_errors="replace")


def _chosen(name: str, container: InputContainer, tracks: Sequence[VideoStream]) -> VideoStream:
    """Return the track to serve, see :func:`opened`."""
    if len(tracks) == 1:
        return tracks[0]
    readable = [track for track in tracks if track.codec_context and track.codec_context.codec.name in CODECS]
    is_listed = "mov" in container.format.name.split(",")  # the counts of other containers are estimates, or missing
    frames = {track.index: track.frames if is_listed else 0 for track in readable}
    if len(readable) > 1 and 0 in frames.values():
        frames |= _frames_at_the_beginning(name, [index for index, count in frames.items() if not count])
    moving = [track for track in readable if frames[track.index] > 1]
    sizes = {track.index: track.codec_context.width * track.codec_context.height for track in readable}
    return min(
        moving or readable or tracks,
        key=lambda track: (not track.disposition & Disposition.default, -sizes.get(track.index, 0), track.index),
    )


def _frames_at_the_beginning(name: str, indexes: Sequence[int]) -> Counter[int]:
    """Return how many packets of each track come early, by index, until each has two."""
    found = Counter[int]()
    with closing(_open(name)) as container, suppress(av.FFmpegError):
        for packet in islice(container.demux(*(container.streams[at] for at in indexes)), _PACKETS_LOOKED_AT):
            found[packet.stream_index] += packet.size > 0
            if all(found[at] > 1 for at in indexes):
                break
    return found


def _raw_format(name: str) -> str | None:
    """Return FFmpeg's name of the container where its own guess is wrong: raw JPEG pictures, for it a still."""
    with open(os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        return "mjpeg" if file.read(len(_JPEG)) == _JPEG else None


def packets(
    container: InputContainer, stream: VideoStream, cut: list[Packet[VideoStream]] | None = None
) -> Iterator[Packet[VideoStream]]:
    """Yield the track's packets in stored order, without empty ones, which would end the decoder (AVI's drops), and
    without a last one that the end of the file cuts short, which many decoders show as if it were whole.

    Args:
        cut: receives that last one.
    """
    last: Packet[VideoStream] | None = None
    for packet in container.demux(stream):
        if packet.size:
            if last is not None:
                yield last
            last = packet
    if last is not None and not _is_cut(container, last):
        yield last
    elif last is not None and cut is not None:
        cut.append(last)


def _is_cut(container: InputContainer, packet: Packet[VideoStream]) -> bool:
    """Return whether the last packet of a track lacks its end."""
    kind = container.format.name
    if kind == "mjpeg":
        return _END_OF_IMAGE not in bytes(packet)[-_MARKER_BYTES:]
    if kind == "dv":  # all pictures have the same size; the demuxer fills up the last one
        return container.size % packet.size > 0
    # A packet of a transport stream does not say whether it has its end.
    is_broken_off = kind == "mpegts" and all(container.size % each for each in TRANSPORT_BYTES)
    return packet.is_corrupt or is_broken_off


def pictures(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Return all frames from the current position, in the decoder's order of output."""
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
