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
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple, NoReturn

import av
import numpy as np
import numpy.typing as npt
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.video.frame_index import NO_TIMESTAMP, FrameIndex
from v2v_server.video.packets import is_unreferenced, length_bytes
from v2v_server.video.picture import (
    DEFAULT_MATRIX,
    MIXED,
    SDR,
    TRANSFERS,
    BeyondBits,
    Chroma,
    ChromaCut,
    ChromaStack,
    LumaFormat,
    Orientation,
    PixelRect,
    Signal,
    copy_luma,
    luma_plane,
    stretch,
)
from v2v_server.video.source import opened, packets, reason

BIT_EXACT_CODECS = frozenset({
    "h264", "hevc", "vp8", "vp9", "av1", "ffv1", "huffyuv", "ffvhuff", "png", "utvideo",
    "tiff", "webp", "bmp",
})  # fmt: skip
"""Codecs whose standard fixes every bit of the decoded picture, or that are lossless, so that all hosts agree. Not so
MPEG-1, 2, 4 and MJPEG: their standards leave the precision of the inverse transform open."""


@dataclass(frozen=True, slots=True)
class Cut:
    """What one sample takes of a clip: a number of frames, and a part of the picture. No shot boundary, which is CUTS.

    Attributes:
        count: number of frames, at least 1; with a stride, of those that are taken.
        window: (top, left, height, width) in the upright picture, pixels; None takes all of it.
        chroma: what it takes of the colour; None takes none.
        cells: (top, left, rows, columns) of the cells whose motion is wanted (:mod:`v2v_server.motion`); None: none.
        still: a smaller window, enough where nothing moves in the cells; a store file then reads it instead.
    """

    count: int
    window: PixelRect | None = None
    chroma: ChromaCut | None = None
    cells: PixelRect | None = None
    still: PixelRect | None = None


class SampleView(NamedTuple):
    """What a cut is for, where its frames are rendered.

    Attributes:
        spec, params: the stream's spec and the sample's draw.
        arrays: requested arrays, by name.
        before: moments of frames before the clip that are rendered too, seconds since its first one.
    """

    spec: StreamSpec
    params: SampleParams
    arrays: tuple[str, ...]
    before: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ClipRequest:
    """What is wanted of the frames of a video.

    Attributes:
        index: the video's frames, or a part that holds the wanted ones.
        start: ordinal of the first wanted frame, presentation order.
        cuts: what each sample takes of them, at least one.
        stride: takes frames start, start + stride ...
        rows: (first, one after the last) usable row, which the cells of a cut count from; None: all rows.
        most_bits: bits of a level to keep of deeper luma, 8 to ``picture.MOST_BITS``; None: 8, and the signal is SDR,
            whatever the file states.
        samples: (seed, epoch, index) of the sample of each cut, for pixels that differ from sample to sample; empty
            where no sample is made.
        views: what they are for, for pixels that render the camera's view and know what moves in it.
    """

    index: FrameIndex
    start: int
    cuts: tuple[Cut, ...]
    stride: int = 1
    rows: tuple[int, int] | None = None
    most_bits: int | None = None
    samples: tuple[tuple[int, int, int], ...] = ()
    views: tuple[SampleView, ...] = ()

    @property
    def count(self) -> int:
        """Return the number of frames of the longest cut."""
        return max(cut.count for cut in self.cuts)

    @property
    def usable(self) -> PixelRect:
        """Return the part of the upright picture that may be used."""
        top, bottom = self.rows or (0, self.index.height_px)
        return top, 0, bottom - top, self.index.width_px

    def seconds(self, cut: Cut) -> npt.NDArray[np.float64]:
        """Return the presentation times of the frames of a cut, [count], seconds."""
        return self.index.seconds(self.start, (cut.count - 1) * self.stride + 1)[:: self.stride]

    def window(self, cut: Cut) -> PixelRect:
        """Return the window of a cut."""
        return cut.window or (0, 0, self.index.height_px, self.index.width_px)

    def check(self) -> None:
        """Check that the index has the frames, and the picture the windows.

        Raises:
            UsageError: it has not.
        """
        height_px, width_px = self.index.height_px, self.index.width_px
        for cut in self.cuts:
            self.index.position(self.start, (cut.count - 1) * self.stride + 1)
            top, left, height, width = self.window(cut)
            inside = top >= 0 and left >= 0 and top + height <= height_px and left + width <= width_px
            if not inside or height < 1 or width < 1:
                raise UsageError(
                    f"window (top {top}, left {left}, {width}x{height} px) does not lie inside a picture of "
                    f"{width_px}x{height_px} px"
                )


@dataclass(frozen=True, slots=True)
class DecodedPicture:
    """A decoded picture, or a part of it.

    Attributes:
        luma: [h, w] levels, upright and in full range, of the signal's dtype.
        grey: the same in 8 bits.
        signal: what the levels mean.
        codec: name of the format that it was decoded from.
        bit_exact: whether every host decodes these very bytes.
        colour: [2, rows, columns] int8, Cb and Cr; None if they were not asked for.
        matrix: of the colour (:class:`v2v_server.video.picture.Chroma`).
    """

    luma: npt.NDArray[Any]
    grey: npt.NDArray[np.uint8]
    signal: Signal
    codec: str
    bit_exact: bool
    colour: npt.NDArray[np.int8] | None = None
    matrix: str = DEFAULT_MATRIX


class DecodedFrame(NamedTuple):
    """A frame in the decoder's memory, which it holds.

    Attributes:
        frame: the frame.
        samples, luma: see :func:`v2v_server.video.picture.luma_plane`.
        orientation, height_px, width_px: of the upright picture.
        signal: what the levels mean that were asked for.
        codec: FFmpeg's name of the format.
    """

    frame: VideoFrame
    samples: npt.NDArray[np.unsignedinteger]
    luma: LumaFormat
    orientation: Orientation
    height_px: int
    width_px: int
    signal: Signal
    codec: str

    def part(self, window: PixelRect, signal: Signal = SDR) -> npt.NDArray[Any]:
        """Return levels of a window of the upright picture, [h, w] of the signal's dtype, in full range."""
        stored = self.orientation.stored_window(window, self.height_px, self.width_px)
        part = np.empty((1, *stored[2:]), signal.dtype)
        copy_luma(self.samples, self.luma, stored, part[0], signal)
        stretch(part, self.luma)
        upright: npt.NDArray[Any] = self.orientation.upright(part)[0]
        return upright

    def picture(self, window: PixelRect, chroma: ChromaCut | None) -> DecodedPicture:
        """Return a window of the picture, with the colour of a cut."""
        luma = self.part(window, self.signal)
        grey = self.part(window) if self.signal.bits > SDR.bits else luma
        is_exact = self.codec in BIT_EXACT_CODECS
        if chroma is None:
            return DecodedPicture(luma, grey, self.signal, self.codec, is_exact)
        stack = ChromaStack(chroma, self.orientation, self.height_px, self.width_px)
        return DecodedPicture(luma, grey, self.signal, self.codec, is_exact, *stack.cells_of(self.frame))


Watch = Callable[[], Callable[[DecodedFrame], object]]
"""What else looks at the frames: called whenever decoding begins; returns what gets each frame."""


class Stack:
    """Collects the asked frames of one pass, and refuses what is not exactly that.

    Args:
        path: the file.
        wanted: the request.
        watch: looks at each frame.
        collects: whether to keep the cuts.
    """

    def __init__(self, path: str, wanted: ClipRequest, watch: Watch | None = None, *, collects: bool = True) -> None:
        self.path, self.wanted = path, wanted
        self._show = None if watch is None else watch()
        self.index = index = wanted.index
        self._orientation = index.orientation
        self.codec = ""  # FFmpeg's name, once decoding has begun
        self.signal = SDR  # of the collected frames
        self.sparse = False  # whether frames before the range are left out on purpose
        self._cuts = wanted.cuts if collects else ()
        self._stride = stride = wanted.stride
        first, most = wanted.start - index.first, wanted.count
        # Single numbers of an array take longer to get.
        self._pts: list[int] = index.pts.tolist() if index.seekable else []
        self._expected: list[int] = index.pts[first : first + (most - 1) * stride + 1 : stride].tolist()
        self.seen = 0  # ordinal of the next delivered frame, for files where they must be counted
        self.name = ""  # of the next frame in error messages
        self.taken = 0
        self._cursor = 0  # where the next frame is expected in the index
        self._damaged = False
        size = index.height_px, index.width_px
        self._colours = [
            None if cut.chroma is None else ChromaStack(cut.chroma, self._orientation, *size) for cut in self._cuts
        ]
        self._luma: LumaFormat | None = None
        self._parts: list[
            tuple[PixelRect, npt.NDArray[np.unsignedinteger]]
        ] = []  # stored window and frames of each cut

    def take(self, frame: VideoFrame) -> bool:
        """Look at the next frame that the decoder delivers; True once the last asked one is in."""
        if frame.is_corrupt and not self.index.seekable and not self.seen:
            return False  # frames are counted from the first sound one
        ordinal, self.seen = self.seen, self.seen + 1
        # A damaged or lost frame spoils what refers to it, until decoding starts afresh.
        lost = not self.sparse and self._after_a_gap(frame)
        self._damaged = frame.is_corrupt or ((self._damaged or lost) and not frame.key_frame)
        if not self._is_next(frame, ordinal):
            return False
        if self._damaged:
            self.refuse("is damaged, or refers to a damaged or lost frame")
        try:
            self._copy(frame)
            for colour in self._colours:
                if colour is not None:
                    colour.add(frame, self.taken)
        except BeyondBits as error:
            self.refuse(str(error))
        self.taken += 1
        return self.taken == len(self._expected)

    def _after_a_gap(self, frame: VideoFrame) -> bool:
        """Return whether the decoder skipped a frame that the index lists before this one."""
        pts, at = self._pts, self._cursor
        if not self.index.seekable or frame.pts is None or frame.pts < pts[0]:
            return False
        found = at if at < len(pts) and pts[at] == frame.pts else bisect_left(pts, frame.pts)
        self._cursor = found + 1
        return found > at

    def _is_next(self, frame: VideoFrame, ordinal: int) -> bool:
        if not self.index.seekable:
            return ordinal >= self.wanted.start and (ordinal - self.wanted.start) % self._stride == 0
        if frame.pts is None:
            self.refuse("the decoder delivers a frame without a time stamp")
        expected = self._expected[self.taken]
        if frame.pts == expected:
            return True
        if frame.pts > expected:
            self.refuse(f"is missing: the decoder delivers time stamp {frame.pts} where {expected} should come")
        if self.taken and not (self._stride > 1 and frame.pts in self._pts):  # not one that the stride skips
            self.refuse(
                f"the decoder delivers time stamp {frame.pts}, which the index does not have, before {expected}"
            )
        return False

    def _copy(self, frame: VideoFrame) -> None:
        if self._luma is None:
            self._luma = LumaFormat.of(frame)
            if self.wanted.most_bits is not None:
                self.signal = Signal(min(self._luma.bits, self.wanted.most_bits), TRANSFERS.get(frame.color_trc, ""))
            self._size = self._orientation.size(self.index.height_px, self.index.width_px)
            self._parts = [self._part(cut) for cut in self._cuts]
        if (frame.height, frame.width) != self._size:
            height, width = self._orientation.size(frame.height, frame.width)
            self.refuse(
                f"the picture is {width}x{height} px here and {self.index.width_px}x{self.index.height_px} px at first"
            )
        if not self._luma.describes(frame):
            self.refuse(f"the picture format changes from {self._luma} to {LumaFormat.of(frame)}")
        if self.wanted.most_bits is not None and TRANSFERS.get(frame.color_trc, "") != self.signal.transfer:
            self.signal = self.signal._replace(transfer=MIXED)
        samples = luma_plane(frame, self._luma)
        for stored, raw in self._parts:
            if self.taken < len(raw):
                copy_luma(samples, self._luma, stored, raw[self.taken], self.signal)
        if self._show is not None:
            size = self.index.height_px, self.index.width_px
            self._show(DecodedFrame(frame, samples, self._luma, self._orientation, *size, self.signal, self.codec))

    def _part(self, cut: Cut) -> tuple[PixelRect, npt.NDArray[np.unsignedinteger]]:
        window = self.wanted.window(cut)
        stored = self._orientation.stored_window(window, self.index.height_px, self.index.width_px)
        return stored, np.empty((cut.count, *stored[2:]), self.signal.dtype)

    def refuse(self, why: str) -> NoReturn:
        """Blame the next frame that should have come.

        Raises:
            VideoError: always.
        """
        raise VideoError(self.path, self.wanted.start + self.taken * self._stride, f"{self.name}{why}")

    def chroma(self) -> list[Chroma | None]:
        """Return the collected colour of each cut; None if it takes none."""
        return [None if colour is None else colour.chroma() for colour in self._colours]

    def grey(self) -> Iterator[npt.NDArray[Any]]:
        """Yield the collected frames of each cut, [count, h, w] of the signal's dtype: upright, in full range."""
        for _, raw in self._parts:
            assert self._luma is not None
            stretch(raw, self._luma)
            yield self._orientation.upright(raw)


_VERSIONED_CODECS = frozenset({"h264", "mpeg4"})


@dataclass(frozen=True, slots=True)
class DecodedClip:
    """A range of frames.

    Attributes:
        frames: [count, h, w], C-contiguous: full-range luma (see :mod:`v2v_server.video.picture`), uint8, or uint16
            if the signal has more than 8 bits.
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
        saturated: how many values of these arrays were clipped, by name; only those that have any.
        unlabelled: why requested arrays cannot be made of this video, by name.
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
    saturated: Mapping[str, int] = field(default_factory=dict)
    unlabelled: Mapping[str, str] = field(default_factory=dict)


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
