"""Collecting the asked frames of one pass of a decoder, and refusing what is not exactly that."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame

from v2v_protocol.errors import VideoError
from v2v_server.video.colour.chroma import Chroma, ChromaCut, ChromaStack
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MIXED, SDR, TRANSFERS, BeyondBits, LumaFormat, Signal, copy_luma, luma_plane, stretch
from v2v_server.video.orientation import Orientation, Window


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
    window: Window | None = None
    chroma: ChromaCut | None = None
    cells: Window | None = None
    still: Window | None = None


class DecodedFrame(NamedTuple):
    """A frame in the decoder's memory, which it holds.

    Attributes:
        samples, luma: see :func:`v2v_server.video.luma.luma_plane`.
        orientation, height_px, width_px: of the upright picture.
    """

    samples: npt.NDArray[np.unsignedinteger]
    luma: LumaFormat
    orientation: Orientation
    height_px: int
    width_px: int

    def raw(self, window: Window) -> npt.NDArray[np.unsignedinteger]:
        """Return a window of the upright picture as the decoder stores it, without a copy."""
        top, left, height, width = self.orientation.stored_window(window, self.height_px, self.width_px)
        return self.samples[top : top + height, left : left + width]

    def part(self, window: Window) -> npt.NDArray[np.uint8]:
        """Return a window of the upright picture, [h, w] uint8 in full range."""
        stored = self.orientation.stored_window(window, self.height_px, self.width_px)
        part = np.empty((1, *stored[2:]), np.uint8)
        copy_luma(self.samples, self.luma, stored, part[0])
        stretch(part, self.luma)
        upright: npt.NDArray[np.uint8] = self.orientation.upright(part)[0]
        return upright


Watch = Callable[[], Callable[[DecodedFrame], object]]
"""What else looks at the frames: called whenever decoding begins; returns what gets each frame."""


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Which frames of a file are to be decoded.

    Attributes:
        path, index, start, stride, most_bits: see :func:`v2v_server.video.decode.decode_cuts`.
    """

    path: str
    index: FrameIndex
    start: int
    stride: int
    most_bits: int | None = None


def window_of(cut: Cut) -> Window:
    """Return the window of a cut that was checked."""
    assert cut.window is not None
    return cut.window


class Stack:
    """Collects the asked frames of one pass, and refuses what is not exactly that."""

    def __init__(self, wanted: FrameRange, cuts: Sequence[Cut], watch: Watch | None = None) -> None:
        self.wanted = wanted
        self._show = None if watch is None else watch()
        self.index = index = wanted.index
        self._orientation = index.orientation
        self.codec = ""  # FFmpeg's name, once decoding has begun
        self.signal = SDR  # of the collected frames
        self.sparse = False  # whether frames before the range are left out on purpose
        self._cuts = cuts
        self._stride = stride = wanted.stride
        first, most = wanted.start - index.first, max(cut.count for cut in cuts)
        self._pts: list[int] = index.pts.tolist()  # single numbers of an array take longer to get
        self._expected = self._pts[first : first + (most - 1) * stride + 1 : stride]
        self._seen = 0  # frames delivered by the decoder, for files where they must be counted
        self.taken = 0
        self._cursor = 0  # where the next frame is expected in the index
        self._damaged = False
        size = index.height_px, index.width_px
        self._colours = [
            None if cut.chroma is None else ChromaStack(cut.chroma, self._orientation, *size) for cut in cuts
        ]
        self._parts: list[tuple[Window, npt.NDArray[np.unsignedinteger]]] = []  # stored window and frames of each cut

    def take(self, frame: VideoFrame) -> bool:
        """Look at the next frame that the decoder delivers; True once the last asked one is in."""
        if frame.is_corrupt and not self.index.seekable and not self._seen:
            return False  # frames are counted from the first sound one
        ordinal, self._seen = self._seen, self._seen + 1
        # A damaged or lost frame spoils what refers to it, until decoding starts afresh.
        lost = not self.sparse and self._after_a_gap(frame)
        self._damaged = frame.is_corrupt or ((self._damaged or lost) and not frame.key_frame)
        if not self._is_next(frame, ordinal):
            return False
        if self._damaged:
            self.refuse("is damaged, or refers to a damaged or lost frame")
        try:
            self._copy(frame)
            self._collect_colour(frame)
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
        if self.taken and not self._is_passed_over(frame.pts):
            self.refuse(
                f"the decoder delivers time stamp {frame.pts}, which the index does not have, before {expected}"
            )
        return False

    def _is_passed_over(self, pts: int) -> bool:
        """Return whether a frame before the next one to take is one that the stride skips."""
        return self._stride > 1 and pts in self._pts

    def _copy(self, frame: VideoFrame) -> None:
        if not self._parts:
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
        self._keep(samples)
        if self._show is not None:
            height, width = self.index.height_px, self.index.width_px
            self._show(DecodedFrame(samples, self._luma, self._orientation, height, width))

    def _keep(self, samples: npt.NDArray[np.unsignedinteger]) -> None:
        for stored, raw in self._parts:
            if self.taken < len(raw):
                copy_luma(samples, self._luma, stored, raw[self.taken], self.signal)

    def _part(self, cut: Cut) -> tuple[Window, npt.NDArray[np.unsignedinteger]]:
        window = window_of(cut)
        stored = self._orientation.stored_window(window, self.index.height_px, self.index.width_px)
        return stored, np.empty((cut.count, *stored[2:]), self.signal.dtype)

    def refuse(self, why: str) -> NoReturn:
        """Blame the next frame that should have come.

        Raises:
            VideoError: always.
        """
        raise VideoError(self.wanted.path, self.wanted.start + self.taken * self._stride, why)

    def _collect_colour(self, frame: VideoFrame) -> None:
        for colour in self._colours:
            if colour is not None:
                colour.add(frame, self.taken)

    def chroma(self) -> list[Chroma | None]:
        """Return the collected colour of each cut; None if it takes none."""
        return [None if colour is None else colour.chroma() for colour in self._colours]

    def grey(self) -> Iterator[npt.NDArray[Any]]:
        """Yield the collected frames of each cut, [count, h, w] of the signal's dtype: upright, in full range."""
        for _, raw in self._parts:
            stretch(raw, self._luma)
            yield self._orientation.upright(raw)


class LastFrame(Stack):
    """Keep only the last of the asked frames, of one cut."""

    def __init__(self, wanted: FrameRange, cut: Cut) -> None:
        super().__init__(wanted, [cut])
        self.colour: tuple[npt.NDArray[np.int8], str] | None = None  # Cb and Cr of the last frame, and their matrix

    def _collect_colour(self, frame: VideoFrame) -> None:
        (colour,) = self._colours
        self.colour = None if colour is None else colour.cells_of(frame)

    def _keep(self, samples: npt.NDArray[np.unsignedinteger]) -> None:
        ((stored, last),) = self._parts
        self._parts = [(stored, np.empty_like(last))]  # a caller may keep the last one
        copy_luma(samples, self._luma, stored, self._parts[0][1][0], self.signal)
        if self.signal.bits > SDR.bits:
            self._grey = np.empty(last.shape, np.uint8)
            copy_luma(samples, self._luma, stored, self._grey[0])

    def _part(self, cut: Cut) -> tuple[Window, npt.NDArray[np.unsignedinteger]]:
        return super()._part(replace(cut, count=1))

    def grey_picture(self) -> npt.NDArray[np.uint8]:
        """Return the last frame in 8 bits, [h, w], where the signal has more."""
        upright: npt.NDArray[np.uint8] = self._orientation.upright(self._grey)[0]
        return upright

    def picture(self) -> npt.NDArray[Any]:
        """Return the last frame that was taken, [h, w] of the signal's dtype: upright, in full range."""
        (grey,) = self.grey()
        picture: npt.NDArray[Any] = grey[0]
        return picture
