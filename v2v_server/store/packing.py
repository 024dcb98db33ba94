"""Compress blocks of differences: densely (zstd), for reading in half the time (LZ4HC), or not at all.

Blocks are checked before they are unpacked, and unpacked into a known number of bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import lz4.block
import zstandard

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
