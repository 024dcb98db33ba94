"""Read samples from memory of a server on this host (``v2v-serve --share-gib``)."""

from __future__ import annotations

import os
from collections.abc import Sequence

from v2v_protocol.arena import ArenaName, array_offsets, open_memory, read_arrays
from v2v_protocol.errors import ProtocolError


def open_sample(arena: str, sizes: Sequence[int]) -> list[memoryview]:
    """Map the sample in an arena of the server.

    Args:
        arena: text of its :class:`v2v_protocol.arena.ArenaName`; it has one slot.
        sizes: bytes of each array.

    Returns:
        the bytes of each array; an empty list if the arena is gone, is on another host or belongs to another user, or
        its content is not sealed.
    """
    try:
        descriptor = open_memory(ArenaName.parse(arena), array_offsets(sizes, 1)[-1], writable=False)
        try:
            return read_arrays(descriptor, sizes)
        finally:
            os.close(descriptor)
    except (OSError, ProtocolError):
        return []
