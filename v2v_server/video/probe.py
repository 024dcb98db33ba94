"""Find out what a video file holds: one pass over its packets, of which few are decoded unless in doubt.

Decoding confirms the first frames, those around the longest gaps in the time stamps, and the last group of frames if
it is short. If :mod:`v2v_server.video.packets` finds a reason for doubt, the whole file is decoded once.
"""

from __future__ import annotations

import hashlib
import os
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import av
import numpy as np
from av.container import InputContainer
from av.format import Flags
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError
from v2v_server.video.decode import decodes_as_listed
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_INDEXED_SIDE_PX, NO_TIMESTAMP, FrameIndex, unseekable
from v2v_server.video.packets import Fields, PacketSigns, is_hidden, steps_and_gaps, times_are_doubtful
from v2v_server.video.picture import SMPTE_240M, LumaFormat, Orientation, stated_matrix
from v2v_server.video.source import (
    count_transport_pictures,
    describe_cut,
    dolby_vision_profile,
    moving_tracks,
    opened,
    packets,
    reason,
    time_base,
)

LONGEST_CPU_SECONDS = 1200.0
"""Processor time that listing the frames of a file may take: of the longest films it is seconds, and some minutes where
they have to be decoded."""

_RATE_TOLERANCE = 0.05
"""Most relative distance of a stated rate from the average."""
DOLBY_VISION = "Dolby Vision profile"


@dataclass(frozen=True, slots=True)
class VideoFacts:
    """What a video file holds.

    Attributes:
        frames: number of decodable frames; the container's own count is ignored.
        height_px, width_px: size of the upright picture.
        codec: FFmpeg's name of the format ("h264", "vp9"), whichever decoder is used.
        pixel_format: FFmpeg's name of the decoded format ("yuv420p10le").
        frames_per_second: average rate: from the time stamps, without gaps, else the container's; NaN if unknown.
        rotation_degrees: of the first frame's display matrix, counter-clockwise as FFmpeg reports it (-90 .. 180).
        full_range: whether luma spans 0 .. 255 (see :mod:`v2v_server.video.picture`).
        index: the frames.
        interlaced: whether the first picture, or any that is stored as two fields, says that its even and odd rows were
            taken at different times.
        content: 32 hexadecimal digits that name what the track stores: every packet, and when each frame is shown.
        remark: what of the file is not served, or served with wrong grey levels or times, and why; "" if all is.
        made_of: fingerprint of the video that a store file was made from, which then names it; "" for any other.
        highest_level: of the 16-bit pictures of a sequence that were looked at; -1 for any other.
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
    interlaced: bool = False
    content: str = ""
    remark: str = ""
    made_of: str = ""
    highest_level: int = -1


def probe(path: str | os.PathLike[str]) -> VideoFacts:
    """Open, decode the first frame, and walk over all packets.

    Frames that the decoder does not deliver are not counted: hidden reference frames, frames outside the edit list,
    frames before the first keyframe of a file that starts in mid-GOP, and frames after a change of size or luma format.
    Two fields are one frame. A file whose packets may not name its frames is decoded once.

    Raises:
        VideoError: the file does not open, has no video track, or not one frame of it decodes.
    """
    name = os.fspath(path)
    try:
        with opened(name) as (container, stream):
            head, shown = _walk(name, container, stream)
            base = time_base(stream)
            # Read before the container is closed: the stream's fields are gone after that. The average counts the
            # fields of H.264 in AVI.
            rates = stream.guessed_rate, stream.average_rate, stream.codec_context.framerate
            others = _other_tracks(name, container, stream)
            reorders = bool(stream.codec_context.has_b_frames)
            stores_pts = _stores_pts(container)
            codec = stream.codec_context.codec.canonical_name
    except av.FFmpegError as error:
        raise VideoError(name, None, f"cannot be read: {reason(error)}") from error
    orientation = Orientation.of(head, codec)
    height, width = orientation.size(head.height, head.width)
    if not (1 <= height <= LARGEST_INDEXED_SIDE_PX and 1 <= width <= LARGEST_INDEXED_SIDE_PX):
        raise VideoError(
            name, None, f"its pictures of {width}x{height} px are larger than {LARGEST_INDEXED_SIDE_PX} px a side"
        )
    uncounted = unseekable(1, base, height, width, orientation)
    index, change = _index(shown, head, uncounted) if stores_pts or not reorders else None, ""
    if index is None or _is_doubtful(shown, reorders) or not is_confirmed(name, index):
        found = Delivered.of(name, head, _Effort(name).check)
        index = None if index is None else found.confirmed(index, shown.signs.empty_pts)
        change = found.change or (f"is damaged from frame {found.sound} on" if found.is_damaged else "")
        if index is None:
            index = unseekable(found.sound, base, height, width, orientation)
    if not len(index):
        raise VideoError(name, None, "holds no frame that decodes")
    return VideoFacts(
        frames=len(index),
        height_px=height,
        width_px=width,
        codec=codec,
        pixel_format=head.format.name,
        frames_per_second=_rate(index, shown, [float(each) for each in rates if each]),
        rotation_degrees=head.rotation,
        full_range=LumaFormat.of(head).full_range,
        interlaced=head.interlaced_frame or shown.fields,
        index=index,
        content=_content(shown, index, head),
        remark="; ".join(filter(None, (*_left_out(name, shown, index, change), others))),
    )


@dataclass(slots=True)
class _Shown:
    """The packets that begin a frame, in stored order: 17 bytes each. :data:`NO_TIMESTAMP` where there is none."""

    signs: PacketSigns
    pts: array[int] = field(default_factory=lambda: array("q"))
    dts: array[int] = field(default_factory=lambda: array("q"))
    is_keyframe: bytearray = field(default_factory=bytearray)
    fields: bool = False
    is_cut: bool = False  # the last one lacks its end, and is left out
    stored: hashlib._Hash = field(default_factory=hashlib.sha256)  # of every packet of the track

    def add(self, packet: Packet[VideoStream]) -> None:
        self.pts.append(NO_TIMESTAMP if packet.pts is None else packet.pts)
        self.dts.append(NO_TIMESTAMP if packet.dts is None else packet.dts)
        self.is_keyframe.append(packet.is_keyframe)


def _walk(name: str, container: InputContainer, stream: VideoStream) -> tuple[VideoFrame, _Shown]:
    """Return the first frame that decodes without error, and every packet that begins a frame."""
    codec = stream.codec_context.codec.canonical_name
    fields = Fields(stream.codec_context.extradata) if codec == "h264" else None
    head: VideoFrame | None = None
    failure: av.FFmpegError | None = None
    cut: list[Packet[VideoStream]] = []
    shown, effort = _Shown(PacketSigns(stream)), _Effort(name)
    for packet in packets(container, stream, cut):
        effort.check(len(shown.pts))
        if head is None:
            head, failure = _first_sound(stream, packet, failure)
        content = memoryview(packet)
        shown.stored.update(content)
        shown.signs.read(packet, content)
        begins = not is_hidden(codec, content) if fields is None else fields.begins_frame(content)
        if begins and not packet.is_discard:
            shown.add(packet)
    if head is None:
        head, failure = _first_sound(stream, None, failure)
    if head is None:
        raise VideoError(name, 0, f"no frame decodes: {reason(failure) if failure else 'its track is empty'}")
    shown.fields, shown.is_cut = fields is not None and fields.seen, bool(cut)
    return head, shown


class _Effort:
    """Limit of the work on one file, which may never end or list frames without end."""

    def __init__(self, name: str) -> None:
        self._name, self._until = name, time.process_time() + LONGEST_CPU_SECONDS

    def check(self, frames: int) -> None:
        """Check the number of frames so far against the limits; raise VideoError beyond them."""
        if frames > LARGEST_FRAMES:
            why = f"holds more than {LARGEST_FRAMES} frames, the most that this program serves"
            raise VideoError(self._name, None, why)
        if time.process_time() > self._until:
            why = f"takes more than {LONGEST_CPU_SECONDS:.0f} s of processor time to list its frames"
            raise VideoError(self._name, None, why)


def _first_sound(
    stream: VideoStream, packet: Packet[VideoStream] | None, failure: av.FFmpegError | None
) -> tuple[VideoFrame | None, av.FFmpegError | None]:
    try:
        frames = stream.decode(packet)
    except av.FFmpegError as error:
        return None, failure or error
    return next((frame for frame in frames if not frame.is_corrupt), None), failure


def _stores_pts(container: InputContainer) -> bool:
    """Return whether the container stores presentation time stamps.

    libavformat guesses them from the stored order where it does not: wrongly, if the decoder reorders frames.
    """
    names = container.format.name.split(",")
    return "avi" not in names and not Flags(container.format.flags) & Flags.no_timestamps


def _is_doubtful(shown: _Shown, reorders: bool) -> bool:
    pts, dts = np.array(shown.pts, np.int64), np.array(shown.dts, np.int64)
    return shown.signs.picture_changes or bool(shown.signs.empty_pts) or times_are_doubtful(pts, dts, reorders)


def _index(shown: _Shown, head: VideoFrame, uncounted: FrameIndex) -> FrameIndex | None:
    """Return the index by presentation time; None if the time stamps do not name the frames."""
    pts = np.array(shown.pts, np.int64)
    if head.pts is None or np.any(pts == NO_TIMESTAMP):
        return None
    # The decoder delivers in order of presentation: what lies before its first frame never comes.
    order = np.argsort(pts, kind="stable")
    order = order[pts[order] >= head.pts]
    pts = pts[order]
    if not len(pts) or pts[0] != head.pts or np.any(pts[1:] == pts[:-1]):
        return None
    keys = np.flatnonzero(np.frombuffer(shown.is_keyframe, np.uint8)[order])
    return replace(
        uncounted,
        pts=pts,
        keyframes=keys.astype(np.int64),
        keyframe_dts=np.array(shown.dts, np.int64)[order[keys]],
        seekable=True,
    )


def _left_out(name: str, shown: _Shown, index: FrameIndex, change: str) -> Iterator[str]:
    """Yield what is missing of the track: the frames that are served are compared with all of its pictures."""
    cut = describe_cut(name) or ("is truncated" if shown.is_cut else "")
    yield f"{cut}; its last picture is left out" if shown.is_cut else cut
    empty = np.setdiff1d(np.array(shown.signs.empty_pts, np.int64), index.pts)
    stored = len(shown.pts) - len(empty)
    if (missing := stored - len(index)) > 0:
        change = f"{missing} of {stored} pictures are left out: {change or 'they do not decode'}"
    yield change
    if profile := dolby_vision_profile(name):
        yield f"is {DOLBY_VISION} {profile}, which stores IPT-PQ: its grey is not luma"


def _other_tracks(name: str, container: InputContainer, stream: VideoStream) -> str:
    """Say which other tracks of pictures a file has; "" if none."""
    others = [track.codec_context for track in moving_tracks(container) if track is not stream]
    tracks = [f"{decoder.width}x{decoder.height} px" for decoder in others if decoder]
    if container.format.name == "mpegts":
        counts = count_transport_pictures(name)
        tracks = [f"{count} pictures of track {pid}" for pid, count in sorted(counts.items()) if pid != stream.id]
    return f"other tracks are left out: {', '.join(tracks)}" if tracks else ""


def _content(shown: _Shown, index: FrameIndex, head: VideoFrame) -> str:
    stored = shown.stored.copy()
    if (matrix := stated_matrix(head)) == SMPTE_240M:
        stored.update(matrix.encode())  # colour of such files was that of BT.601 under the name without it
    if index.orientation != Orientation():
        stored.update(f"{index.orientation};".encode())
    for part in (index.pts, index.keyframes):
        stored.update(b"%d;" % len(part) + part.astype("<i8").tobytes())
    return stored.hexdigest()[:32]


def _rate(index: FrameIndex, shown: _Shown, stated: Sequence[float]) -> float:
    """Return frames per second: the average without gaps, else the first that the file states."""
    numerator, denominator = index.time_base
    if index.seekable and len(index) > 1:
        steps, are_gaps = steps_and_gaps(index.pts)
        steps = steps[~are_gaps]
        return len(steps) * denominator / (int(steps.sum()) * numerator)
    span = max(shown.pts, default=0) - min(shown.pts, default=0)
    if (
        0 < span < min(len(shown.pts), 2 * len(set(shown.pts))) - 1
    ):  # frames follow each other within a tick of the clock
        average = (len(shown.pts) - 1) * denominator / (span * numerator)
        return next((each for each in stated if abs(each / average - 1) < _RATE_TOLERANCE), average)
    return stated[0] if stated else float("nan")


_FIRST_FRAMES = 8
_LONGEST_LAST_GROUP = 64
_MOST_GAPS = 8
_MOST_LOST = 0.1
"""Share of the frames that may be lost without an error of the decoder."""


def is_confirmed(path: str, listed: FrameIndex) -> bool:
    """Return whether frames decode as listed: the first, the last, and those around gaps.

    Args:
        path: the file.
        listed: all of its frames, seekable.
    """
    places = [(0, min(_FIRST_FRAMES, len(listed)))]
    if len(listed) > 1:
        steps, are_gaps = steps_and_gaps(listed.pts)
        longest = np.argsort(steps)[::-1][:_MOST_GAPS]
        places += [(int(before), 2) for before in longest if are_gaps[before]]
    last = int(listed.keyframes[-1]) if len(listed.keyframes) else 0
    if len(listed) - last <= _LONGEST_LAST_GROUP:
        places.append((last, len(listed) - last))
    return all(decodes_as_listed(path, listed, *place) for place in places)


@dataclass(slots=True)
class Delivered:
    """What a decoder delivers of a whole file, up to the first frame of another size or luma format.

    Attributes:
        pts: time stamps from the first sound frame on, :data:`NO_TIMESTAMP` for none.
        sound: number of frames in front of the first damage behind that one.
        is_damaged: whether an error or a damaged frame came behind the first sound frame.
        change: what is different from the frame behind these on, for the user; "" if nothing is.
    """

    pts: array[int] = field(default_factory=lambda: array("q"))
    sound: int = 0
    is_damaged: bool = False
    change: str = ""

    @classmethod
    def of(cls, path: str, head: VideoFrame, check: Callable[[int], None]) -> Delivered:
        """Decode a file.

        Args:
            path: the file.
            head: its first sound frame.
            check: called with the number of frames so far.

        Raises:
            VideoError: by ``check``.
        """
        luma, found = LumaFormat.of(head), cls()
        with opened(path) as (container, stream):
            for packet in chain(packets(container, stream), [None]):
                check(len(found.pts))
                try:
                    frames = stream.decode(packet)
                except av.FFmpegError:
                    found.is_damaged = bool(found.pts)
                    continue
                for frame in frames:
                    if frame.is_corrupt and not found.pts:
                        continue
                    if (frame.height, frame.width) != (head.height, head.width) or not luma.describes(frame):
                        form, before = _form(frame), _form(head)
                        found.change = f"from frame {len(found.pts)} on they are {form} instead of {before}"
                        return found
                    found.is_damaged |= frame.is_corrupt
                    found.sound += not found.is_damaged
                    found.pts.append(NO_TIMESTAMP if frame.pts is None else frame.pts)
        return found

    def confirmed(self, listed: FrameIndex, empty_pts: array[int]) -> FrameIndex | None:
        """Return the part of a list that the decoder delivers; None where it delivers other frames, or another order.

        Frames after the last delivered one are left out, and so are empty packets. Other frames that are not delivered
        are lost: they stay in the list and are refused. If many are lost, the packets do not list frames.

        Args:
            listed: all frames of the file, seekable.
            empty_pts: time stamps of packets that may decode to nothing.
        """
        pts, came = np.array(self.pts[: self.sound], np.int64), np.isin(listed.pts, np.array(self.pts, np.int64))
        if not len(pts) or not np.isin(pts, listed.pts).all() or np.any(pts[1:] <= pts[:-1]):
            return None
        last = int(np.flatnonzero(came)[-1])
        kept = came | ~np.isin(listed.pts, np.array(empty_pts, np.int64))
        kept[last + 1 :] = False
        if not self.is_damaged and np.count_nonzero(kept & ~came) > _MOST_LOST * last:
            return None
        return listed.only(kept)


def _form(frame: VideoFrame) -> str:
    return f"{frame.width}x{frame.height} px of {LumaFormat.of(frame)}"
