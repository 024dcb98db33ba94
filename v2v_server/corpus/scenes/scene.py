"""What a video shows, in a few numbers for every sixteen frames: enough to know what of it is worth decoding.

They are measured once (:mod:`v2v_server.corpus.scenes.analysis`) and kept whole, so that they have one encoding, which
the digest of a catalogue can cover. Beside the numbers there are the video's pieces: stretches of frames that are alike
in what is wrong with them.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError
from v2v_server.video.frame_index import inflated

ANALYSIS_VERSION = 6
"""Raise it with every change of what an analysis finds: earlier ones are then repeated."""
SEGMENT_FRAMES = 16
"""Frames of a segment. Segment i of a video holds frames 16 i .. 16 i + 15."""
MOST_ANALYSED_FRAMES = 4096
"""Frames of a video that are analysed, from its beginning. Later ones may be like them: if those have cuts, repeats,
fades, combing or bars, scene "auto" serves no later frame."""
LAG_FRAMES = 4
"""Frames over which motion and change are measured."""
UNKNOWN = 2**16 - 1
"""A number that could not be measured."""

TILES = 4
"""Rows and columns of tiles that a picture is divided into."""
MOTION = slice(0, TILES**2)
CHANGE = slice(TILES**2, 2 * TILES**2)
CONTRAST, DARK, CLIPPED, FLICKER, NOISE = range(2 * TILES**2, 2 * TILES**2 + 5)
"""Columns of :attr:`Scene.segments`; tiles row by row."""
COLUMNS = NOISE + 1
_UNITS = np.array([64.0] * TILES**2 + [64.0] * TILES**2 + [64.0, 1000.0, 1000.0, 64.0, 64.0])
"""How many of each column's units make one pixel, grey level or whole."""
_MAGIC = b"VSC6"
_HEADER = struct.Struct("<4sIIHI")  # magic, first, end, segments, pieces


class Flag:
    """Bits: what the frames of a piece are."""

    CUT = 1
    """A shot begins with the first of them."""
    REPEAT = 2
    """Each repeats the frame before it."""
    FADE = 4
    """They fade to or from black."""
    STILL = 8
    """Nothing moves for 16 frames or more."""
    BLACK = 16
    """There is nothing to see: black, or flat and darker than middle grey."""
    WHITE = 32
    """There is nothing to see: white, or flat and brighter than middle grey."""
    COMBED = 64
    """Two fields of different times are woven together."""
    UNSEEN = 128
    """They were not analysed, and earlier frames of the video have defects."""
    QUIET = 256
    """Little of the picture changes: less than 35 grey levels over four frames in the mean of the tiles."""


_TELLING = Flag.CUT | Flag.REPEAT | Flag.FADE | Flag.COMBED


class Sides(NamedTuple):
    """Bars at the sides of a picture, pixels."""

    top: int
    bottom: int
    left: int
    right: int


NO_BARS = Sides(0, 0, 0, 0)
PIECE = np.dtype([("end", "<i4"), ("flags", "<u2"), *((side, "<u2") for side in Sides._fields)])
"""Frames up to ``end`` - 1, from the end of the piece before; their flags; the bars of their shot, pixels."""
Pieces = npt.NDArray[np.void]
"""[n] of :data:`PIECE`."""


def sides_of(pieces: Pieces) -> npt.NDArray[np.uint16]:
    """Return the bars of pieces, [n, 4]: top, bottom, left, right."""
    return np.stack([pieces[side] for side in Sides._fields], axis=1)


def firsts_of(pieces: Pieces, first: int) -> npt.NDArray[np.int64]:
    """Return the first frame of each piece, [n], if the first of them begins at frame ``first``."""
    return np.concatenate(([first], pieces["end"]))[:-1].astype(np.int64)


def clip_pieces(pieces: Pieces, first: int, start: int, end: int) -> Pieces:
    """Return the pieces of frames start .. end - 1.

    Args:
        pieces: they begin at frame ``first``, at or before ``start``; frames after the last one have no bars, and no
            flags unless earlier ones have defects.
    """
    if not len(pieces) or pieces["end"][-1] < end:
        rest = np.array([(end, 0, *NO_BARS)], PIECE)
        if (pieces["flags"] & _TELLING).any() or sides_of(pieces).any():
            rest["flags"] = Flag.UNSEEN
        elif len(pieces) and not pieces["flags"][-1]:
            pieces = pieces[:-1]
        pieces = np.append(pieces, rest)
    firsts = firsts_of(pieces, first)
    inside = (pieces["end"] > start) & (firsts < end)
    part = pieces[inside].copy()
    if len(part):
        part["end"][-1] = end
        part["flags"][0] &= ~np.uint16(Flag.CUT) if firsts[inside][0] < start else np.uint16(0xFFFF)
    return part


def frames_before(scene: Scene | None, start: int, count: int, *, has_repeats: bool) -> npt.NDArray[np.int64]:
    """Return the ordinals of the last frames before frame ``start``, ascending, [count]; none if its shot has fewer.

    Args:
        scene: of the video, or a slice that begins with the first of them, or with the video; None: without shots.
        has_repeats: whether frames that repeat the one before them count.
    """
    shots = () if scene is None else scene.shot_boundaries
    repeats = np.empty(0, np.int64) if scene is None or has_repeats else scene.repeats[scene.repeats < start]
    first = max((0, start - count - len(repeats), *(shot for shot in shots if shot <= start)))
    found = np.setdiff1d(np.arange(first, start), repeats, assume_unique=True)
    return found[len(found) - count :] if len(found) >= count else found[:0]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The statistics of a video, or of a slice of it.

    Attributes:
        first: ordinal of the first frame of the first segment.
        end: ordinal after the last frame that was analysed.
        pieces: [p] of :data:`PIECE`, frames ``first`` .. ``end`` - 1.
        segments: [n, 37] uint16, one row a segment, :data:`UNKNOWN` where a number could not be measured. Of each tile:

            MOTION    95th percentile of its motion, the larger of the segment's halves; 1/64 px a frame
            CHANGE    largest change of the mean of a block of 8 x 8 pixels over four frames; the fourth is any frame
                      of the segment after its first, or the next segment's first; 1/64 grey level

            and of the whole picture:

            CONTRAST  standard deviation of the block means, the largest of all frames; 1/64 grey level
            DARK      share of the pixels below grey level 16; 1/1000
            CLIPPED   share of the pixels from grey level 250 on; 1/1000
            FLICKER   mean distance of a frame's mean from that of its two neighbours; 1/64 grey level
            NOISE     deviation of one pixel from frame to frame in the stillest middle blocks; 1/64 grey level
    """

    first: int
    end: int
    pieces: Pieces
    segments: npt.NDArray[np.uint16]

    @classmethod
    def unknown(cls) -> Scene:
        """Return the scene of a video that could not be analysed."""
        return cls(0, 0, np.empty(0, PIECE), np.empty((0, COLUMNS), np.uint16))

    @classmethod
    def of(cls, pieces: Pieces, values: npt.NDArray[np.float64]) -> Scene:
        """Make a scene of pieces from frame 0 on, and of numbers in px, grey levels and shares of 1.

        Args:
            values: [n, 37] float64, NaN where unknown.
        """
        units = np.clip(np.rint(values * _UNITS), 0, UNKNOWN - 1)
        return cls(0, int(pieces["end"][-1]), pieces, np.where(np.isnan(units), UNKNOWN, units).astype(np.uint16))

    @property
    def shot_boundaries(self) -> tuple[int, ...]:
        """Ordinals of the frames at which another shot begins, increasing."""
        firsts = firsts_of(self.pieces, self.first)
        return tuple(firsts[(self.pieces["flags"] & Flag.CUT) != 0].tolist())

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

    def frames_from(self, start: int, count: int) -> npt.NDArray[np.int64]:
        """Return the ordinals of frames from ``start`` on, [count], without those that repeat the one before."""
        dropped = self.repeats[self.repeats >= start]
        # A dropped frame moves each later one by one; the n-th of them has n frames before it that are dropped.
        before = dropped - np.arange(len(dropped)) - start
        wanted = np.arange(count, dtype=np.int64)
        return start + wanted + before.searchsorted(wanted, side="right")

    @property
    def repeats(self) -> npt.NDArray[np.int64]:
        """Return the ordinals of the frames that repeat the one before, [n], ascending."""
        repeats = np.repeat(self.pieces["flags"] & Flag.REPEAT, self.pieces["end"] - firsts_of(self.pieces, self.first))
        return self.first + np.flatnonzero(repeats)

    def sides(self, start: int, end: int) -> Sides:
        """Return the widest bar at each side of frames start .. end - 1."""
        part = clip_pieces(self.pieces, self.first, start, end)
        return Sides(*sides_of(part).max(axis=0).tolist())

    def slice(self, start: int, count: int) -> Scene:
        """Return the part that frames start .. start + count - 1 touch."""
        end = min(start + count, self.end)
        if end <= start:
            return Scene.unknown()
        low = (start - self.first) // SEGMENT_FRAMES
        high = -((self.first - end) // SEGMENT_FRAMES)
        first = self.first + SEGMENT_FRAMES * low
        return Scene(first, end, clip_pieces(self.pieces, self.first, first, end), self.segments[low:high])

    def to_bytes(self) -> bytes:
        """Return a compact encoding, the same for equal scenes."""
        body = self.pieces.tobytes() + self.segments.astype("<u2").tobytes()
        head = _HEADER.pack(_MAGIC, self.first, self.end, len(self.segments), len(self.pieces))
        return head + zlib.compress(body, 6)

    @staticmethod
    def is_encoding(data: bytes) -> bool:
        """Return whether data begins like the encodings of this version."""
        return data.startswith(_MAGIC)

    @classmethod
    def from_bytes(cls, data: bytes) -> Scene:
        """Decode a scene from :meth:`to_bytes`; allocate at most its own size, about 50 kB.

        Raises:
            ProtocolError: ``data`` is not such an encoding.
        """
        if len(data) < _HEADER.size:
            raise ProtocolError(f"scene of {len(data)} bytes: shorter than its header of {_HEADER.size}")
        magic, first, end, rows, count = _HEADER.unpack_from(data)
        if magic != _MAGIC:
            raise ProtocolError(f"scene begins with {magic!r} instead of {_MAGIC!r}")
        covered = end <= first + rows * SEGMENT_FRAMES < end + SEGMENT_FRAMES
        if end > MOST_ANALYSED_FRAMES or first % SEGMENT_FRAMES or not covered or count > max(0, end - first):
            raise ProtocolError(f"scene: frames {first} .. {end - 1} in {rows} segments and {count} pieces")
        size = PIECE.itemsize * count + 2 * COLUMNS * rows
        body = inflated("scene", data[_HEADER.size :], size)
        pieces = np.frombuffer(body, PIECE, count).copy()
        ends = np.concatenate(([first], pieces["end"].astype(np.int64)))
        if ends[-1] != end or np.any(ends[1:] <= ends[:-1]):
            raise ProtocolError(f"scene: its pieces do not cover frames {first} .. {end - 1} in order")
        segments = np.frombuffer(body, "<u2", offset=PIECE.itemsize * count).astype(np.uint16).reshape(rows, COLUMNS)
        return cls(first, end, pieces, segments)
