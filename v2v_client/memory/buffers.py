"""Memory for batches that is used again, but never while anything still looks at it.

Fresh memory costs more than the copy into it: the kernel hands out zeroed pages one fault at a time. So memory whose
last user is gone (:mod:`v2v_client.memory.loan`) goes back to its pool.

A process that was forked while somebody looked at an arena may look at it for as long as it likes, and nobody here
would know: such an arena is not used again.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from v2v_client.memory.arena import Arena, open_arena
from v2v_client.memory.loan import lend
from v2v_protocol.arena import Slot
from v2v_protocol.sample import Layout


class BufferPool:
    """Arrays of one dtype and shape.

    Args:
        dtype, shape: of the arrays.
        spare: most buffers kept while nobody uses them.
    """

    def __init__(self, dtype: str, shape: tuple[int, ...], spare: int) -> None:
        self._dtype = np.dtype(dtype)
        self._shape = shape
        # A deque, because finalizers may run in any thread (that of DataLoader's pinning, say): its methods are atomic.
        self._free: deque[npt.NDArray[np.uint8]] = deque(maxlen=spare)

    def take(self) -> npt.NDArray[Any]:
        """A C-contiguous array of unspecified content; its memory comes back when the last reference to it dies."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(math.prod(self._shape) * self._dtype.itemsize, np.uint8)
        return lend(memory, self._dtype, self._shape, self._free.append)


class Memory(Protocol):
    """The rows of one batch."""

    def slot(self, row: int) -> Slot | None:
        """Where a worker of this host may put the sample of that row."""

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Copies a sample into a row."""

    def whole(self) -> dict[str, npt.NDArray[Any]]:
        """All rows of each array, once they are filled. To be called once, and nothing else after it."""


class OwnMemory:
    """Memory that this process alone can reach.

    Args:
        arrays: with a row for each sample, by name.
    """

    def __init__(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        self._arrays = arrays

    def slot(self, row: int) -> Slot | None:
        """See :class:`Memory`."""
        return None

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """See :class:`Memory`."""
        for name, array in arrays.items():
            self._arrays[name][row] = array

    def whole(self) -> dict[str, npt.NDArray[Any]]:
        """See :class:`Memory`."""
        return self._arrays


class SharedMemory:
    """An arena, which comes back when its batch is not used any more; one whose batch never became whole does not."""

    def __init__(self, arena: Arena, free: deque[Arena]) -> None:
        self._arena = arena
        self._free = free

    def slot(self, row: int) -> Slot | None:
        """See :class:`Memory`."""
        return self._arena.slot(row)

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """See :class:`Memory`."""
        self._arena.put(row, arrays)

    def get(self, row: int) -> dict[str, npt.NDArray[Any]]:
        """A copy of what is in a row."""
        return self._arena.get(row)

    def whole(self) -> dict[str, npt.NDArray[Any]]:
        """See :class:`Memory`."""
        arena, free, forks = self._arena, self._free, _forks

        def unused() -> None:
            if forks == _forks:
                free.append(arena)

        return arena.arrays(unused)


class BatchBuffers:
    """The memory of a dataset's batches, which one iteration leaves to the next."""

    def __init__(self) -> None:
        self._form: object = None
        self._pools: dict[str, BufferPool] = {}
        self._arenas: deque[Arena] = deque()
        self._layout: Layout = {}
        self._batch_size = 0

    def shape(self, layout: Layout, batch_size: int, spare: int) -> None:
        """What is taken from now on is for batches of that many samples; memory of another form is let go.

        Args:
            layout: of one sample.
            batch_size: samples of a batch.
            spare: most batches kept while nobody uses them.
        """
        form = dict(layout), batch_size, spare
        if form != self._form:
            self._form, self._layout, self._batch_size = form, layout, batch_size
            self._arenas = deque(maxlen=spare)
            self._pools = {
                name: BufferPool(dtype, (batch_size, *shape), spare) for name, (dtype, shape) in layout.items()
            }

    def own(self) -> OwnMemory:
        """Memory for a batch, of unspecified content, that no other process can reach."""
        return OwnMemory({name: pool.take() for name, pool in self._pools.items()})

    def shared(self) -> SharedMemory | None:
        """The same, with slots for the workers of this host; None where the system has no such memory."""
        while self._arenas:
            arena = self._arenas.pop()
            if arena.process == os.getpid():  # otherwise the process that this one was forked from may go on with it
                return SharedMemory(arena, self._arenas)
        opened = open_arena(self._layout, self._batch_size)
        return None if opened is None else SharedMemory(opened, self._arenas)


_forks = 0


def _note_fork() -> None:
    global _forks
    _forks += 1


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_note_fork)
