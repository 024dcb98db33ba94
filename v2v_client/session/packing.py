"""Decompress arrays that were compressed for transport over a network."""

from __future__ import annotations

import zstandard

from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Buffer


def unpack(frame: Buffer, size: int) -> Buffer:
    """Return the bytes of an array.

    Args:
        frame: a zstd frame that states its content size.
        size: of the array, in bytes. No more than this is ever allocated.

    Raises:
        ProtocolError: it is not a zstd frame, or it holds another number of bytes.
    """
    try:
        stated = zstandard.frame_content_size(frame)
        if stated == size:
            return zstandard.ZstdDecompressor().decompress(frame)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"sample: a compressed array is damaged: {error}") from None
    raise ProtocolError(f"sample: a compressed array states {stated} bytes; it has {size}")
