"""Which frames a file has: their presentation time stamps and the places where decoding may begin."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError, UsageError
from v2v_server.video.picture import Orientation

NO_TIMESTAMP = -(2**63)
"""Stands for an unknown pts or dts (FFmpeg's AV_NOPTS_VALUE)."""

LARGEST_FRAMES = 2**24
"""Most frames of one index: 77 hours at 60 frames per second."""

LARGEST_INDEXED_SIDE_PX = 2**16 - 1

_MAGIC = b"VFI1"
_HEADER = struct.Struct("<4sQIIIIHHB")  # magic, first, frames, keyframes, time base (2), height, width, flags
_INT64 = np.dtype("<i8")
_SEEKABLE, _TRANSPOSE, _FLIP_Y, _FLIP_X, _BITS_SHIFT = 1, 2, 4, 8, 4
_UPRIGHT = Orientation()


@dataclass(frozen=True, slots=True, eq=False)
class FrameIndex:
    """The frames of a file, or of a slice of it, in presentation order.

    Attributes:
        first: ordinal, in the whole file, of the first frame listed here.
        pts: [n] int64, presentation time stamps in units of ``time_base``; strictly increasing where ``seekable``,
            all :data:`NO_TIMESTAMP` where not.
        keyframes: [k] int64, ordinals of the frames at which decoding may begin, increasing.
        keyframe_dts: [k] int64, their decoding time stamps, :data:`NO_TIMESTAMP` where the container gives none.
        time_base: (numerator, denominator) of a second.
        height_px, width_px: size of the upright picture (rotation metadata applied).
        seekable: False when the time stamps are missing, not unique or not to be trusted (H.264 with B-frames in
            AVI): decoding then counts frames from the beginning of the file.
        orientation: how the stored pictures are turned upright, as the first frame says: H.264 and HEVC may say it with
            keyframes only.
        bits: that levels of 16-bit pictures hold, 8 to 15, as the user states; 0: what the format says.
    """

    first: int
    pts: npt.NDArray[np.int64]
    keyframes: npt.NDArray[np.int64]
    keyframe_dts: npt.NDArray[np.int64]
    time_base: tuple[int, int]
    height_px: int
    width_px: int
    seekable: bool
    orientation: Orientation = _UPRIGHT
    bits: int = 0

    def __len__(self) -> int:
        return len(self.pts)

    def __repr__(self) -> str:
        ways = f"{len(self.keyframes)} keyframes" if self.seekable else "not seekable"
        return f"FrameIndex({self.first}..{self.end - 1}, {self.width_px}x{self.height_px}, {ways})"

    @property
    def end(self) -> int:
        """Ordinal after the last frame."""
        return self.first + len(self.pts)

    def position(self, start: int, count: int) -> int:
        """Return the place of frame ``start`` in ``pts``, after a check that the range lies in this index.

        Raises:
            UsageError: an empty range, or one not inside first .. end.
        """
        if count < 1 or start < self.first or start + count > self.end:
            raise UsageError(
                f"frames {start} .. {start + count - 1} asked of an index that holds {self.first} .. {self.end - 1}"
            )
        return start - self.first

    def slice(self, start: int, count: int) -> FrameIndex:
        """Return the part needed to decode frames start .. start + count - 1: from the keyframe at or before ``start``.

        Raises:
            UsageError: the range does not lie in this index.
        """
        self.position(start, count)
        which = int(np.searchsorted(self.keyframes, start, side="right")) - 1
        first = int(self.keyframes[which]) if which >= 0 else self.first
        kept = (self.keyframes >= first) & (self.keyframes < start + count)
        return replace(
            self,
            first=first,
            pts=self.pts[first - self.first : start + count - self.first],
            keyframes=self.keyframes[kept],
            keyframe_dts=self.keyframe_dts[kept],
        )

    def only(self, kept: npt.NDArray[np.bool_]) -> FrameIndex:
        """Return the index without some frames of the file.

        Args:
            kept: [n], whether each frame stays.
        """
        keys = kept[self.keyframes - self.first]
        ordinals = self.first + np.cumsum(kept) - 1
        return replace(
            self,
            pts=self.pts[kept],
            keyframes=ordinals[self.keyframes - self.first][keys],
            keyframe_dts=self.keyframe_dts[keys],
        )

    def timed(self, pts: npt.NDArray[np.int64]) -> FrameIndex:
        """Return the index of the same frames with time stamps, [n] nanoseconds; decoding may begin at each."""
        return replace(
            self, pts=pts, keyframes=self.first + np.arange(len(pts)), keyframe_dts=np.full(len(pts), NO_TIMESTAMP),
            time_base=(1, 10**9), seekable=True,
        )  # fmt: skip

    def seconds(self, start: int, count: int) -> npt.NDArray[np.float64]:
        """Return the presentation times of frames start .. start + count - 1.

        Returns:
            [count] float64, seconds on the container's clock; NaN where unknown.

        Raises:
            UsageError: the range does not lie in this index.
        """
        at = self.position(start, count)
        if not self.seekable:
            return np.full(count, np.nan)
        numerator, denominator = self.time_base
        return self.pts[at : at + count].astype(np.float64) * numerator / denominator

    def to_bytes(self) -> bytes:
        """Encode the index: a few bytes a frame at a varying rate, next to nothing at a constant one."""
        lies = self.orientation
        flags = _SEEKABLE * self.seekable | _TRANSPOSE * lies.transpose | _FLIP_Y * lies.flip_y | _FLIP_X * lies.flip_x
        flags |= self.bits << _BITS_SHIFT
        head = _HEADER.pack(
            _MAGIC, self.first, len(self.pts), len(self.keyframes), *self.time_base,
            self.height_px, self.width_px, flags,
        )  # fmt: skip
        if not self.seekable:
            return head
        parts = (_steps(_steps(self.pts)), _steps(self.keyframes), _steps(self.keyframe_dts))
        return head + zlib.compress(b"".join(part.astype(_INT64).tobytes() for part in parts), 6)

    @classmethod
    def from_bytes(cls, data: bytes, most_frames: int = LARGEST_FRAMES) -> FrameIndex:
        """Decode what :meth:`to_bytes` returned. Allocates at most 24 bytes for each frame it accepts.

        Raises:
            ProtocolError: ``data`` is no such encoding, or states more than ``most_frames`` frames.
        """
        if len(data) < _HEADER.size:
            raise ProtocolError(f"frame index of {len(data)} bytes: shorter than its header of {_HEADER.size}")
        magic, first, frames, keys, numerator, denominator, height, width, flags = _HEADER.unpack_from(data)
        seekable, bits = bool(flags & _SEEKABLE), flags >> _BITS_SHIFT
        orientation = Orientation(bool(flags & _TRANSPOSE), bool(flags & _FLIP_Y), bool(flags & _FLIP_X))
        if magic != _MAGIC:
            raise ProtocolError(f"frame index begins with {magic!r} instead of {_MAGIC!r}")
        if not 1 <= frames <= most_frames or first + frames > LARGEST_FRAMES or keys > frames:
            raise ProtocolError(f"frame index: {frames} frames from {first}, {keys} keyframes; limit {most_frames}")
        if not (numerator and denominator and height and width) or 0 < bits < 8:
            raise ProtocolError(f"frame index: time base {numerator}/{denominator}, {width}x{height} px, flags {flags}")
        packed = data[_HEADER.size :]
        if not seekable:
            if keys or packed:
                raise ProtocolError(f"frame index: {keys} keyframes and {len(packed)} bytes though it is not seekable")
            return unseekable(frames, (numerator, denominator), height, width, orientation, first, bits)
        stored = inflated("frame index", packed, (frames + 2 * keys) * _INT64.itemsize)
        values = np.frombuffer(stored, _INT64).astype(np.int64)
        pts, keyframes, dts = np.split(values, [frames, frames + keys])
        pts, keyframes, dts = np.cumsum(np.cumsum(pts)), np.cumsum(keyframes), np.cumsum(dts)
        if pts[0] == NO_TIMESTAMP or not _increasing(pts):
            raise ProtocolError("frame index: time stamps that do not increase")
        if keys and (keyframes[0] < first or keyframes[-1] >= first + frames or not _increasing(keyframes)):
            raise ProtocolError(
                f"frame index: keyframes outside frames {first} .. {first + frames - 1}, or in disorder"
            )
        return cls(first, pts, keyframes, dts, (numerator, denominator), height, width, True, orientation, bits)


def unseekable(
    frames: int,
    time_base: tuple[int, int],
    height_px: int,
    width_px: int,
    orientation: Orientation = _UPRIGHT,
    first: int = 0,
    bits: int = 0,
) -> FrameIndex:
    """Return the index of a file whose frames can only be counted from its beginning."""
    none = np.empty(0, np.int64)
    pts = np.broadcast_to(np.int64(NO_TIMESTAMP), (frames,))
    return FrameIndex(first, pts, none, none, time_base, height_px, width_px, False, orientation, bits)


def _steps(values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    # Differences wrap around modulo 2**64, and so do the sums that undo them: exact for any value.
    steps = values.copy()
    steps[1:] -= values[:-1]
    return steps


def _increasing(values: npt.NDArray[np.int64]) -> bool:
    return bool(np.all(values[1:] > values[:-1]))


def inflated(what: str, packed: bytes, size: int) -> bytes:
    """Return ``packed`` decompressed to exactly ``size`` bytes; never allocate much more than that.

    Raises:
        ProtocolError: it is something else; the message begins with what it should be.
    """
    stream = zlib.decompressobj()
    try:
        raw = stream.decompress(packed, size + 1)
    except zlib.error as error:
        raise ProtocolError(f"{what} does not decompress: {error}") from error
    if len(raw) != size or not stream.eof or stream.unused_data:
        raise ProtocolError(f"{what} decompresses to {len(raw)} bytes; its header promises {size}")
    return raw
