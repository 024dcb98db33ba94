"""Arrays that were compressed for their way over a network."""

from __future__ import annotations

import zstandard

from v2v_protocol.errors import ProtocolError
from v2v_protocol.wire import Buffer


def unpack(frame: Buffer, size: int) -> Buffer:
    """The bytes of an array.

    Args:
        frame: zstd, with its size stated.
        size: of the array, bytes. No more is ever allocated.

    Raises:
        ProtocolError: the frame is none, or holds another number of bytes.
    """
    try:
        stated = zstandard.frame_content_size(frame)
        if stated == size:
            return zstandard.ZstdDecompressor().decompress(frame)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"sample: a compressed array is damaged: {error}") from None
    raise ProtocolError(f"sample: a compressed array states {stated} bytes; it has {size}")
