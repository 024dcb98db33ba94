"""Collecting the asked frames of one pass of a decoder, and refusing what is not exactly that."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.video.colour.chroma import DEFAULT_MATRIX, Chroma, ChromaCut, ChromaStack
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MIXED, SDR, TRANSFERS, BeyondBits, LumaFormat, Signal, copy_luma, luma_plane, stretch
from v2v_server.video.orientation import Orientation, PixelRect

BIT_EXACT_CODECS = frozenset({
    "h264", "hevc", "vp8", "vp9", "av1", "ffv1", "huffyuv", "ffvhuff", "png", "utvideo",
    "tiff", "webp", "bmp",
})  # fmt: skip
"""Codecs whose standard fixes every bit of the decoded picture, or that are lossless, so that all hosts agree. Not so
MPEG-1, 2, 4 and MJPEG: their standards leave the precision of the inverse transform open."""


@dataclass(frozen=True, slots=True)
class Cut:
    """What one sample takes of a clip.

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
    """

    spec: StreamSpec
    params: SampleParams
    arrays: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ClipRequest:
    """What is wanted of the frames of a video.

    Attributes:
        index: the video's frames, or a part that holds the wanted ones.
        start: ordinal of the first wanted frame, presentation order.
        cuts: what each sample takes of them, at least one.
        stride: takes frames start, start + stride ...
        rows: (first, one after the last) usable row, which the cells of a cut count from; None: all rows.
        most_bits: bits of a level to keep of deeper luma, 8 to ``luma.MOST_BITS``; None: 8, and the signal is SDR,
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
        """Return the presentation times of the frames of a cut."""
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
        matrix: of the colour (:class:`v2v_server.video.colour.chroma.Chroma`).
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
        samples, luma: see :func:`v2v_server.video.luma.luma_plane`.
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

    def raw(self, window: PixelRect) -> npt.NDArray[np.unsignedinteger]:
        """Return a window of the upright picture as the decoder stores it, without a copy."""
        top, left, height, width = self.orientation.stored_window(window, self.height_px, self.width_px)
        return self.samples[top : top + height, left : left + width]

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
        self._pts: list[int] = index.pts.tolist()  # single numbers of an array take longer to get
        self._expected = self._pts[first : first + (most - 1) * stride + 1 : stride]
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
