"""Compressing a block of differences: densely (zstd), or so that it is read in half the time (LZ4HC).

What is unpacked was checked before, and is unpacked into a known number of bytes and no more.
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
    """How blocks are compressed; who reads them need only know the method.

    Attributes:
        method: "zstd" or "lz4".
        search: zstd: how hard it looks for repetitions, as ``ZstdCompressionParameters`` takes it.
        level: of LZ4HC.
    """

    method: str
    search: tuple[tuple[str, int], ...] = ()
    level: int = 0

    def packer(self) -> Callable[[Bytes], bytes]:
        """What compresses a block. For one thread at a time."""
        if self.method == "zstd":
            parameters = zstandard.ZstdCompressionParameters(write_content_size=False, **dict(self.search))
            return zstandard.ZstdCompressor(compression_params=parameters).compress
        return lambda block: lz4.block.compress(
            block, mode="high_compression", compression=self.level, store_size=False
        )


def _zstd(strategy: int, hash_log: int, min_match: int, search_log: int) -> Packing:
    search = {"strategy": strategy, "hash_log": hash_log, "chain_log": hash_log, "min_match": min_match}
    return Packing("zstd", (*search.items(), ("search_log", search_log), ("window_log", 15)))


# Differences of decoded frames repeat themselves little, apart from zeros: what makes them small is coding each by its
# frequency. So only long repetitions are looked for; looking for short ones costs who reads as well.
DENSE = _zstd(zstandard.STRATEGY_LAZY, 15, 6, 5)
QUICK = _zstd(zstandard.STRATEGY_FAST, 6, 7, 1)
"""For the cache: 4 % larger than :data:`DENSE`, and written six times as fast."""
FAST = Packing("lz4", level=6)

SIZES = {"dense": DENSE, "fast": FAST}
METHODS = ("zstd", "lz4")


class UnpackingError(Exception):
    """A block does not give the bytes that it should."""


def unpack(method: str, packed: Bytes, size: int) -> bytes:
    """The ``size`` bytes of a block.

    Raises:
        UnpackingError: it holds something else.
    """
    try:
        if method == "zstd":
            # The decompressor allocates what a frame claims, whatever the limit is.
            claimed = zstandard.frame_content_size(packed)
            if claimed > size:
                raise UnpackingError(f"claims {claimed} bytes instead of {size}")
            block = _decompressor().decompress(packed, max_output_size=size)
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
