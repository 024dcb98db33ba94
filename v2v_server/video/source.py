"""Open a video file for sequential, single-threaded reading of its picture track; read what containers state and PyAV
does not report: their size, tracks that begin late, and the form of the picture.

Sources: ISO/IEC 14496-12, 4.2 (boxes); Dolby Vision Streams within the ISO Base Media File
Format, 3.2; RFC 8794, 4 (EBML); RFC 9559, 5 (Matroska); ISO/IEC 13818-1, 2.4.3 (transport stream).
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from fractions import Fraction
from itertools import chain, islice
from typing import BinaryIO

import av
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError, VideoUnreadable
from v2v_server.video.file_range import FileRange, file_of, open_bytes

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
        # Opening a FIFO blocks until there is a writer, and a device may not end.
        if not os.path.isfile(file_of(name)):
            os.stat(file_of(name))
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
    is_part = FileRange.parse(name) is not None
    options = _OPTIONS | {"protocol_whitelist": "file,subfile" if is_part else "file"}
    path = name if is_part else os.path.abspath(name)
    return av.open(path, "r", format=_raw_format(name), options=options, metadata_errors="replace")


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
    with open_bytes(name) as file:
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


def time_base(stream: VideoStream) -> tuple[int, int]:
    """(numerator, denominator) of the track's clock; 1/1 where the container states none."""
    base = stream.time_base or Fraction(1)
    return (base.numerator, base.denominator) if base > 0 else (1, 1)


def reason(error: BaseException) -> str:
    """One line that says what FFmpeg or the system complained about."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())


_WAY = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_STSD_HEAD_BYTES = 8
_ENTRY_HEAD_BYTES = 78
"""Of a visual sample entry, in front of its boxes; width and height lie at 24."""
_MOST_BOXES = 10_000
_ANY_END = 1 << 62
_ISO_KINDS = frozenset({b"ftyp", b"styp", b"moov", b"mdat", b"moof", b"free", b"skip", b"wide"})
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
TRANSPORT_BYTES = {188: 0, 192: 4, 204: 0}
"""Bytes of a packet of a transport stream, and those in front of its sync byte."""
_SYNC = 0x47
_TRANSPORT_PACKET = re.compile(rb"\x47([\x40-\x5f].)(?:[\x10-\x1f]|[\x30-\x3f](.))", re.DOTALL)
"""The beginning of a packet in which a packet of a track begins, behind an adaptation field of this length."""
_START_CODE, _VIDEO = b"\0\0\1", bytes(range(0xE0, 0xF0))
_PART_BYTES = 188 * 192 * 51 * 8
"""Whole packets of each size."""
_HEAD_BYTES = 1 << 20
_MATROSKA_DOLBY = re.compile(rb"dv[cv]C.{0,16}?\x41\xed[\x81-\xfe](.{5})", re.DOTALL)
"""The beginning of the configuration, as a mapping of block additions holds it."""
_DOLBY_KINDS = b"dvcC", b"dvvC", b"dvwC"
_NOT_LUMA_PROFILES = frozenset({5, 10, 20})
"""Profiles of Dolby Vision whose pictures are of IPT-PQ where no base layer is compatible with anything else."""


def dolby_vision_profile(path: str) -> int | None:
    """Return the profile of Dolby Vision that an MP4, QuickTime or Matroska file states, if its luma is not luma.

    Raises:
        OSError: the file cannot be read.
    """
    with open_bytes(path) as file:
        records = [found[1] for found in _MATROSKA_DOLBY.finditer(file.read(_HEAD_BYTES))]
        for kind, at in _boxes_of_entries(file):
            if kind in _DOLBY_KINDS:
                file.seek(at)
                records.append(file.read(5))
    profiles = [record[2] >> 1 for record in records if len(record) == 5 and not record[4] >> 4]
    return next((profile for profile in profiles if profile in _NOT_LUMA_PROFILES), None)


def describe_cut(path: str) -> str:
    """Say that a file is shorter than it states itself; "" if it is whole, or states no size.

    Raises:
        OSError: the file cannot be read.
    """
    with open_bytes(path) as file:
        size, stated = file.seek(0, os.SEEK_END), 0
        file.seek(0)
        head = file.read(_HEAD_BYTES)
        if head[:4] == b"RIFF" and head[4:8] != b"\xff\xff\xff\xff":
            stated = 8 + int.from_bytes(head[4:8], "little")
        elif head[:4] == _EBML and 0 < (at := head.find(_SEGMENT)) < len(head) - 12:
            length = 9 - head[at + 4].bit_length()  # the first bit that is set tells the bytes of the number
            digits = int.from_bytes(head[at + 4 : at + 4 + length], "big") & ((1 << 7 * length) - 1)
            if digits != (1 << 7 * length) - 1:  # all ones: unknown
                stated = at + 4 + length + digits
        elif head[4:8] in _ISO_KINDS:
            ends = (until for _, _, until in _boxes(file, 0, _ANY_END, _ISO_KINDS))
            stated = next((until for until in ends if size < until < _ANY_END), 0)
        elif (length := _transport_bytes(head)) and size % length:
            stated = size // length * length + length
    # A last byte of padding may be missing.
    return f"is truncated: {size:,} of at least {stated:,} bytes are there" if stated > size + 1 else ""


def count_transport_pictures(path: str) -> Counter[int]:
    """Count the packets of video that begin in a transport stream, by the number of their track (PID).

    A track that begins later than a demuxer looks is not listed when the file is opened.

    Raises:
        OSError: the file cannot be read.
    """
    found = Counter[int]()
    with open_bytes(path) as file:
        while data := file.read(_PART_BYTES):
            for packet in _TRANSPORT_PACKET.finditer(data):
                at = packet.end() + (packet[2][0] if packet[2] else 0)
                if data[at : at + 3] == _START_CODE and data[at + 3 : at + 4] in _VIDEO:
                    found[int.from_bytes(packet[1], "big") & 0x1FFF] += 1
    return found


def _transport_bytes(head: bytes) -> int:
    """Return the bytes of a packet of a transport stream; 0 of other files."""
    for length, before in TRANSPORT_BYTES.items():
        if head[before::length][:8] == bytes([_SYNC]) * 8:
            return length
    return 0


def _boxes_of_entries(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield (type, first byte of the content) of each box in a visual sample entry."""
    end = file.seek(0, os.SEEK_END)
    spans = [(0, end)]
    for kind in _WAY:
        skipped = _STSD_HEAD_BYTES * (kind == b"stsd")
        boxes = chain.from_iterable(list(_boxes(file, *span)) for span in spans)
        spans = [(at + skipped, until) for found, at, until in boxes if found == kind]
    for _, begin, until in [box for span in spans for box in _boxes(file, *span)]:
        for kind, at, _ in list(_boxes(file, begin + _ENTRY_HEAD_BYTES, until)):
            yield kind, at


def _boxes(
    file: BinaryIO, begin: int, end: int, kinds: frozenset[bytes] | None = None
) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, first byte of the content, byte behind it) of each box, up to one of other ``kinds``."""
    for _ in range(_MOST_BOXES):
        file.seek(begin)
        head = file.read(16)
        size, at = int.from_bytes(head[:4], "big"), begin + 8
        if size == 1:
            size, at = int.from_bytes(head[8:16], "big"), begin + 16
        until = end if size == 0 else begin + size
        if len(head) < 8 or not at <= until <= end or (kinds is not None and head[4:8] not in kinds):
            return
        yield head[4:8], at, until
        if (begin := until) >= end:
            return
