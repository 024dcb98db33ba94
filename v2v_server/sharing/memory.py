"""Hold one sample in memory that a worker fills, and that is sealed before a consumer reads it. I/O.

The server owns the memory. So it outlives the worker, and lasts until the ring drops it and the last reader is done.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import cached_property

from v2v_protocol.arena import ArenaName, Slot, array_offsets
from v2v_protocol.shared_memory import create_memory, read_arrays, seal_memory

mappings: weakref.WeakSet[object] = weakref.WeakSet()
"""All mappings that exist, each with a descriptor of its own: also those that only messages on their way refer to."""


class SampleMemory:
    """Memory for one sample.

    Args:
        sizes: bytes of each array.

    Attributes:
        slot: what a lease names, so that the worker writes there.
        nbytes: its size.

    Raises:
        OSError: the system does not support sealed anonymous files, or has no memory left.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self._sizes = tuple(sizes)
        self.nbytes = array_offsets(sizes, 1)[-1]
        token = os.urandom(16).hex()
        self._descriptor = create_memory(ArenaName(os.getpid(), 0, 1, token).memory_name, self.nbytes)
        weakref.finalize(self, os.close, self._descriptor)
        self.slot = Slot(str(ArenaName(os.getpid(), self._descriptor, 1, token)), 1)

    def seal(self) -> bool:
        """Make the memory read-only for every process; return False if one still has it mapped for writing."""
        try:
            seal_memory(self._descriptor, content=True)
        except OSError:
            return False
        return True

    @cached_property
    def arrays(self) -> Sequence[bytes | memoryview]:
        """Bytes of each array, for all messages: mapped once, or copied if the system has no descriptor left. They stay
        valid without this object.
        """
        try:
            arrays = read_arrays(self._descriptor, self._sizes)
        except OSError:
            offsets = array_offsets(self._sizes, 1)
            return [os.pread(self._descriptor, size, at) for size, at in zip(self._sizes, offsets, strict=False)]
        mappings.add(arrays[0].obj)
        return arrays
