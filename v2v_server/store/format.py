"""Layout of a store file: the luma of a video, or of a piece of it, in blocks that can be read one by one.

    magic, length of the head, check of the head      8 + 4 + 8 bytes
    head                                              msgpack, see :class:`Head`
    table                                             a record of equal size for each group of frames
    blocks                                            in any order

A group is up to :attr:`Head.group` consecutive frames. A block is a group of frames of a rectangle of up to
:data:`BLOCK_ROWS` x :data:`BLOCK_COLUMNS` pixels. A record of the table states where the first block of its group
begins, the length of each block (they follow each other row by row), the hash of each block, and the hash of the record
itself. Every hash is seeded with the position of what it covers, so a valid block at another position is rejected.

A block is compressed densely (zstd), for reading in half the time (LZ4HC), or not at all. It is checked before it is
unpacked, and unpacked into a known number of bytes.

A file is written under another name, its head last, and renamed when it is complete. It is read with ``pread`` and
never mapped: truncating a mapped file kills the process that reads it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import lz4.block
import msgpack
import numpy as np
import numpy.typing as npt
import xxhash
import zstandard

from v2v_protocol.errors import ProtocolError, VideoError
from v2v_protocol.persisted import Persisted, later
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_INDEXED_SIDE_PX
from v2v_server.video.picture import DEFAULT_MATRIX, MIXED, MOST_BITS, SDR, TRANSFERS, Signal

Bytes = bytes | memoryview


@dataclass(frozen=True, slots=True)
class Packing:
    """How blocks are compressed; reading them needs only the method.

    Attributes:
        method: "zstd", "lz4", or "raw", which compresses nothing.
        search: zstd: match search settings, as ``ZstdCompressionParameters`` takes them.
        level: level of LZ4HC.
    """

    method: str
    search: tuple[tuple[str, int], ...] = ()
    level: int = 0

    def packer(self) -> Callable[[Bytes], bytes]:
        """Return a function that compresses a block. It is not thread-safe."""
        if self.method == "zstd":
            parameters = zstandard.ZstdCompressionParameters(write_content_size=False, **dict(self.search))
            return zstandard.ZstdCompressor(compression_params=parameters).compress
        if self.method == "raw":
            return bytes
        return lambda block: lz4.block.compress(
            block, mode="high_compression", compression=self.level, store_size=False
        )


def _zstd(strategy: int, hash_log: int, min_match: int, search_log: int) -> Packing:
    search = {"strategy": strategy, "hash_log": hash_log, "chain_log": hash_log, "min_match": min_match}
    return Packing("zstd", (*search.items(), ("search_log", search_log), ("window_log", 15)))


# Differences of decoded frames have few repetitions apart from zeros; entropy coding is what makes them small. So only
# long repetitions are searched for: short ones also slow down reading.
DENSE = _zstd(zstandard.STRATEGY_LAZY, 15, 6, 5)
QUICK = _zstd(zstandard.STRATEGY_FAST, 6, 7, 1)
"""Packing of the cache: 4 % larger than :data:`DENSE`, and written six times as fast."""
FAST = Packing("lz4", level=6)

RAW = Packing("raw")

SIZES = {"dense": DENSE, "fast": FAST, "raw": RAW}
"""How a prepared folder may store its files, by name."""
DEFAULT_SIZE = "dense"
PACK_METHODS = ("zstd", "lz4", "raw")


class UnpackingError(Exception):
    """A block does not unpack to the expected bytes."""


def unpack(method: str, packed: Bytes, size: int) -> Bytes:
    """Return the ``size`` bytes of a block.

    Raises:
        UnpackingError: it holds something else.
    """
    try:
        if method == "zstd":
            # The decompressor allocates the size that a frame claims, whatever the limit is.
            claimed = zstandard.frame_content_size(packed)
            if claimed > size:
                raise UnpackingError(f"claims {claimed} bytes instead of {size}")
            block: Bytes = _decompressor().decompress(packed, max_output_size=size)
        elif method == "raw":
            block = packed
        else:
            block = lz4.block.decompress(packed, uncompressed_size=size)
    except (zstandard.ZstdError, lz4.block.LZ4BlockError) as error:
        raise UnpackingError(f"does not decompress: {error}") from error
    if len(block) != size:
        raise UnpackingError(f"decompresses to {len(block)} bytes instead of {size}")
    return block


@cache
def _decompressor() -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor()


MAGIC = b"V2VSTOR1"
BLOCK_ROWS, BLOCK_COLUMNS = 32, 32
GROUP_FRAMES = 32
PIECE_FRAMES = 256
"""Largest number of frames in a cache piece. Pieces begin at multiples of this, or of a half or quarter of it."""
LARGEST_BLOCK_BYTES = 2 * GROUP_FRAMES * BLOCK_ROWS * BLOCK_COLUMNS
"""Largest packed block, bytes: no packing doubles its input."""
_LARGEST_GROUP_BYTES = 64 << 20
_PREFIX = struct.Struct("<8sIQ")
_LARGEST_HEAD_BYTES = 64 << 20
_LONGEST_FINGERPRINT = 200
"""An index keeps it for every video."""
_BLOCK = np.dtype([("bytes", "<u4"), ("check", "<u8")])


@dataclass(frozen=True, slots=True)
class Head(Persisted):
    """Head of a store file.

    Attributes:
        video: the source's id, for people.
        fingerprint: of the source file.
        height_px, width_px: size of the source's upright picture.
        top, rows: the stored rows of it: the first, and their number.
        first, count: the stored frames: ordinal of the first in the source, and their number.
        frames: number of frames of the source.
        frames_per_second: of the source; 0 if unknown.
        codec: FFmpeg's name of the source's format.
        bit_exact: whether every host decodes the source to these bytes.
        group: frames in a group.
        packing: method of :mod:`v2v_server.store.format`.
        index: ``FrameIndex.to_bytes()`` of the source; empty in a piece.
        bits, transfer: of the source (``v2v_server.video.picture.Signal``).
        matrix: of the plane "chroma" (``v2v_server.video.picture.Chroma``). These three are left out of the file
            where they are the defaults.
    """

    video: str
    fingerprint: str
    height_px: int
    width_px: int
    top: int
    rows: int
    first: int
    count: int
    frames: int
    frames_per_second: float
    codec: str
    bit_exact: bool
    group: int
    packing: str
    index: bytes = b""
    bits: int = later(SDR.bits)
    transfer: str = later(SDR.transfer)
    matrix: str = later(DEFAULT_MATRIX)

    def __post_init__(self) -> None:
        inside = (
            1 <= self.height_px <= LARGEST_INDEXED_SIDE_PX
            and 1 <= self.width_px <= LARGEST_INDEXED_SIDE_PX
            and 0 <= self.top < self.top + self.rows <= self.height_px
            and 0 <= self.first < self.first + self.count <= self.frames <= LARGEST_FRAMES
            and 1 <= self.group <= GROUP_FRAMES
            and self.packing in PACK_METHODS
            and len(self.fingerprint) <= _LONGEST_FINGERPRINT
            and SDR.bits <= self.bits <= MOST_BITS
            and self.transfer in (SDR.transfer, MIXED, *TRANSFERS.values())
        )
        if not inside:
            raise ProtocolError(
                f"{self.count} frames from {self.first} of {self.frames}, rows {self.top} + {self.rows} of "
                f"{self.width_px}x{self.height_px} px, groups of {self.group}, packed by {self.packing!r:.20}, "
                f"{self.bits} bits, transfer {self.transfer!r:.20}, fingerprint {self.fingerprint!r:.100}"
            )

    @property
    def signal(self) -> Signal:
        """What the source's levels mean."""
        return Signal(self.bits, self.transfer)

    @property
    def groups(self) -> int:
        """Return the number of groups of frames."""
        return -(-self.count // self.group)

    @property
    def down(self) -> int:
        """Return the number of rows of blocks in a picture."""
        return -(-self.rows // BLOCK_ROWS)

    @property
    def across(self) -> int:
        """Return the number of blocks in a row of blocks."""
        return -(-self.width_px // BLOCK_COLUMNS)

    @property
    def record_bytes(self) -> int:
        """Size of a record of the table, bytes."""
        return 8 + self.down * self.across * _BLOCK.itemsize + 8

    def group_frames(self, group: int) -> int:
        """Return the number of frames in a group."""
        return min(self.group, self.count - group * self.group)

    def to_bytes(self) -> bytes:
        """Return the bytes in front of the table."""
        head = msgpack.packb(self.to_dict())
        return _PREFIX.pack(MAGIC, len(head), check(head, 0)) + head


def group_frames_for(rows: int, width_px: int) -> int:
    """Return the number of frames in a group. Larger pictures get fewer, which bounds the memory of the writer."""
    return max(1, min(GROUP_FRAMES, _LARGEST_GROUP_BYTES // (rows * width_px)))


def read_head(path: str, file: int, offset: int = 0) -> tuple[Head, int]:
    """Read the head of an open file, and return it with the position of the table in the store file.

    Args:
        path, file: its name and descriptor.
        offset: where the store file begins in it.

    Raises:
        VideoError: it is not a store file, or its head is damaged.
        OSError: it cannot be read.
    """
    prefix = os.pread(file, _PREFIX.size, offset)
    if len(prefix) < _PREFIX.size or not prefix.startswith(MAGIC):
        raise VideoError(path, None, f"begins with {prefix[:8]!r}: not a store file, or a truncated one")
    _, length, expected = _PREFIX.unpack(prefix)
    head = os.pread(file, length, offset + _PREFIX.size) if length <= _LARGEST_HEAD_BYTES else b""
    if len(head) != length or check(head, 0) != expected:
        raise VideoError(path, None, "the store file is corrupt (its head is damaged): re-create it with v2v-prepare")
    try:
        return Head.from_dict(msgpack.unpackb(head)), _PREFIX.size + length
    except (ProtocolError, ValueError) as error:
        raise VideoError(
            path, None, f"the store file is corrupt (its head: {error}): re-create it with v2v-prepare"
        ) from error


def pack_record(head: Head, group: int, offset: int, sizes: list[int], checks: list[int]) -> bytes:
    """Encode a record of the table.

    Args:
        head: head of the file.
        group: number of the group.
        offset: position of its first block, bytes.
        sizes, checks: length and hash of its blocks, row by row.
    """
    blocks = np.empty(head.down * head.across, _BLOCK)
    blocks["bytes"], blocks["check"] = sizes, checks
    body = struct.pack("<Q", offset) + blocks.tobytes()
    return body + struct.pack("<Q", check(body, group + 1))


@dataclass(frozen=True, slots=True)
class BlockRecord:
    """Positions of the blocks of a group.

    Attributes:
        starts: [blocks + 1] start of each block, and the end of the last, bytes.
        checks: [blocks] hash of each block.
    """

    starts: list[int]
    checks: list[int]


def unpack_record(group: int, data: bytes) -> BlockRecord:
    """Decode the record of a group.

    Raises:
        UnpackingError: it is damaged, or a block is larger than any that is written.
    """
    start = int.from_bytes(data[:8], "little")
    is_sound = len(data) >= 16 and check(data[:-8], group + 1) == int.from_bytes(data[-8:], "little")
    if not is_sound or start >= 1 << 62:  # longer than any file; offsets are signed
        raise UnpackingError("its record in the table is damaged")
    blocks: npt.NDArray[np.void] = np.frombuffer(data[8:-8], _BLOCK)
    sizes = blocks["bytes"].astype(np.int64)
    # Check before a reader allocates: the author of a hostile file also wrote its checksums.
    if sizes.max(initial=0) > LARGEST_BLOCK_BYTES:
        number = int(sizes.argmax())
        raise UnpackingError(f"block {number} has {sizes[number]} bytes, the limit is {LARGEST_BLOCK_BYTES}")
    return BlockRecord(np.cumsum(np.concatenate([[start], sizes])).tolist(), blocks["check"].tolist())


def check(data: bytes | memoryview, place: int) -> int:
    """Return the hash of data at a place: 0 for the head, ``group + 1`` for a record, ``group << 32 | number`` for a
    block.
    """
    return xxhash.xxh3_64_intdigest(data, place)
