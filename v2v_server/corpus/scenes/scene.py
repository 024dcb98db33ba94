"""What a video shows, in a few numbers for every sixteen frames: enough to know what of it is worth decoding.

They are measured once (:mod:`v2v_server.corpus.scenes.analysis`) and kept whole, so that they have one encoding, which
the digest of a catalogue can cover.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError

ANALYSIS_VERSION = 1
"""Raise it with every change of what an analysis finds: earlier ones are then repeated."""
SEGMENT_FRAMES = 16
"""Frames of a segment. Segment i of a video holds frames 16 i .. 16 i + 15."""
MOST_FRAMES = 4096
"""Frames of a video that are analysed, from its beginning. Nothing is known of later ones."""
LAG_FRAMES = 4
"""Frames over which motion and change are measured."""
UNKNOWN = 2**16 - 1
"""A number that could not be measured."""
EMPTY_CONTRAST_LEVELS = 0.5
"""A segment whose blocks differ by less (standard deviation) shows nothing: black, white, a fade's end."""

TILES = 4
"""Rows and columns of tiles that a picture is divided into."""
MOTION = slice(0, TILES**2)
CHANGE = slice(TILES**2, 2 * TILES**2)
CONTRAST, DARK, CLIPPED, FLICKER, NOISE = range(2 * TILES**2, 2 * TILES**2 + 5)
"""Columns of :attr:`Scene.segments`; tiles row by row."""
COLUMNS = NOISE + 1
_UNITS = np.array([64.0] * TILES**2 + [64.0] * TILES**2 + [64.0, 1000.0, 1000.0, 64.0, 64.0])
"""How many of each column's units make one pixel, grey level or whole."""
_MAGIC = b"VSC1"
_HEADER = struct.Struct("<4sIIHI")  # magic, first, end, segments, shot boundaries


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The statistics of a video, or of a slice of it.

    Attributes:
        first: ordinal of the first frame of the first segment.
        end: ordinal after the last frame that was analysed.
        shot_boundaries: ordinals of the frames at which another shot begins, increasing.
        segments: [n, 37] uint16, one row a segment, :data:`UNKNOWN` where a number could not be measured. Of each tile:

            MOTION    95th percentile of its motion, the largest of the segment's quarters; 1/64 px a frame
            CHANGE    largest change of the mean of a block of 8 x 8 pixels over four frames; the fourth is any frame
                      of the segment after its first, or the next segment's first; 1/64 grey level

            and of the whole picture:

            CONTRAST  standard deviation of the block means, the largest of all frames; 1/64 grey level
            DARK      share of the pixels below grey level 16; 1/1000
            CLIPPED   share of the pixels from grey level 250 on; 1/1000
            FLICKER   mean distance of a frame's mean from that of its two neighbours; 1/64 grey level
            NOISE     deviation of one pixel from frame to frame in the stillest tenth of the blocks; 1/64 grey level
    """

    first: int
    end: int
    shot_boundaries: tuple[int, ...]
    segments: npt.NDArray[np.uint16]

    @classmethod
    def unknown(cls) -> Scene:
        """Return the scene of a video that could not be analysed."""
        return cls(0, 0, (), np.empty((0, COLUMNS), np.uint16))

    @classmethod
    def of(cls, end: int, shot_boundaries: tuple[int, ...], values: npt.NDArray[np.float64]) -> Scene:
        """Make a scene of numbers in px, grey levels and shares of 1: [n, 37] float64, NaN where unknown."""
        units = np.clip(np.rint(values * _UNITS), 0, UNKNOWN - 1)
        return cls(0, end, shot_boundaries, np.where(np.isnan(units), UNKNOWN, units).astype(np.uint16))

    def __repr__(self) -> str:
        boundaries = f"{len(self.shot_boundaries)} shot boundaries"
        return f"Scene({self.first}..{self.end - 1}, {boundaries}, {len(self.segments)} segments)"

    def values(self, start: int, end: int) -> npt.NDArray[np.float64]:
        """Return the segments that frames start .. end - 1 touch: [n, 37] float64 in px, grey levels and shares, NaN
        where unknown.

        Frames that were not analysed have no row.
        """
        low = max(0, (start - self.first) // SEGMENT_FRAMES)
        high = max(low, -((self.first - min(end, self.end)) // SEGMENT_FRAMES))
        part = self.segments[low:high]
        return np.where(part == UNKNOWN, np.nan, part / _UNITS)

    def runs(self, frames: int) -> list[tuple[int, int]]:
        """Return the stretches of a video of ``frames`` frames between shot boundaries, without its empty segments.

        Returns:
            (first frame, frame after the last one) of each, in order.
        """
        bounds = [0, *(boundary for boundary in self.shot_boundaries if boundary < frames), frames]
        empty = np.flatnonzero(self.segments[:, CONTRAST] < EMPTY_CONTRAST_LEVELS * _UNITS[CONTRAST])
        holes = [(self.first + SEGMENT_FRAMES * int(at), self.first + SEGMENT_FRAMES * (int(at) + 1)) for at in empty]
        runs = []
        for start, end in pairwise(bounds):
            at = start
            for low, high in holes:
                if high > at and low < end:
                    if low > at:
                        runs.append((at, low))
                    at = high
            if at < end:
                runs.append((at, end))
        return runs

    def slice(self, start: int, count: int) -> Scene:
        """Return the part that frames start .. start + count - 1 touch."""
        end = min(start + count, self.end)
        if end <= start:
            return Scene.unknown()
        low = (start - self.first) // SEGMENT_FRAMES
        high = -((self.first - end) // SEGMENT_FRAMES)
        boundaries = tuple(boundary for boundary in self.shot_boundaries if start < boundary < end)
        return Scene(self.first + SEGMENT_FRAMES * low, end, boundaries, self.segments[low:high])

    def to_bytes(self) -> bytes:
        """Return a compact encoding, the same for equal scenes."""
        body = np.array(self.shot_boundaries, "<u4").tobytes() + self.segments.astype("<u2").tobytes()
        head = _HEADER.pack(_MAGIC, self.first, self.end, len(self.segments), len(self.shot_boundaries))
        return head + zlib.compress(body, 6)

    @classmethod
    def from_bytes(cls, data: bytes) -> Scene:
        """Decode a scene from :meth:`to_bytes`; allocate at most its own size, about 50 kB.

        Raises:
            ProtocolError: ``data`` is not such an encoding.
        """
        if len(data) < _HEADER.size:
            raise ProtocolError(f"scene of {len(data)} bytes: shorter than its header of {_HEADER.size}")
        magic, first, end, rows, boundaries = _HEADER.unpack_from(data)
        if magic != _MAGIC:
            raise ProtocolError(f"scene begins with {magic!r} instead of {_MAGIC!r}")
        covered = end <= first + rows * SEGMENT_FRAMES < end + SEGMENT_FRAMES
        if end > MOST_FRAMES or first % SEGMENT_FRAMES or not covered or boundaries > max(0, end - first):
            raise ProtocolError(
                f"scene: frames {first} .. {end - 1} in {rows} segments with {boundaries} shot boundaries"
            )
        size = 4 * boundaries + 2 * COLUMNS * rows
        stream = zlib.decompressobj()
        try:
            body = stream.decompress(data[_HEADER.size :], size + 1)
        except zlib.error as error:
            raise ProtocolError(f"scene does not decompress: {error}") from error
        if len(body) != size or not stream.eof or stream.unused_data:
            raise ProtocolError(f"scene decompresses to {len(body)} bytes; its header promises {size}")
        frames = np.frombuffer(body, "<u4", boundaries).astype(np.int64)
        if boundaries and (frames[0] <= first or frames[-1] >= end or np.any(frames[1:] <= frames[:-1])):
            raise ProtocolError(f"scene: shot boundaries outside frames {first + 1} .. {end - 1}, or in disorder")
        segments = np.frombuffer(body, "<u2", offset=4 * boundaries).astype(np.uint16).reshape(rows, COLUMNS)
        return cls(first, end, tuple(frames.tolist()), segments)
