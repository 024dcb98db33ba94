"""Reuse memory of earlier batches, but never while it is still referenced.

Fresh memory costs more than the copy into it, because the kernel hands out zeroed pages one fault at a time. So memory
whose last user is gone (:func:`v2v_client.memory.arena.lend`) is kept for the next batch.

An arena that was in use during a fork is not reused: the child may refer to it indefinitely, and this process cannot
find out.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_client.memory.arena import Arena, Bytes, batch_arrays, batch_bytes, lend, open_arena
from v2v_protocol.arena import Slot
from v2v_protocol.sample import Layout


class BatchMemory:
    """Hold the rows of one batch that is being filled.

    Workers may write samples into the slots of an arena. If a sample arrives in a message while a worker may still
    write to its slot, the batch moves from the arena to private memory, which no other process can reach.

    Args:
        buffers: source of private memory.
        arena: memory with slots for workers; None uses private memory from the beginning.

    Attributes:
        has_slots: whether the batch started with an arena.
    """

    def __init__(self, buffers: BatchBuffers, arena: Arena | None) -> None:
        self._buffers = buffers
        self._arena = arena
        self._own = buffers.arrays() if arena is None else {}
        self._left: Arena | None = None
        self._filled: list[int] = []
        self.has_slots = arena is not None

    def slot(self, row: int) -> Slot | None:
        """Return where a worker on this host may write the sample of that row; None without an arena."""
        return None if self._arena is None else self._arena.slot(row)

    def fill(self, row: int, arrays: Mapping[str, npt.NDArray[Any]] | None, *, slot_is_free: bool = True) -> None:
        """Store an arrived sample.

        Args:
            row: 0 .. batch size - 1.
            arrays: copied into the row; None if a worker has written them into the row's slot.
            slot_is_free: False if a worker may still write to that slot.
        """
        if not slot_is_free and self._arena is not None:
            self._left, self._arena, self._own = self._arena, None, self._buffers.arrays()
            for before in self._filled:
                self._put(before, self._left.get(before))
        if arrays is not None:
            self._put(row, arrays)
        elif self._left is not None:
            self._put(row, self._left.get(row))
        self._filled.append(row)

    def _put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        if self._arena is not None:
            self._arena.put(row, arrays)
            return
        for name, array in arrays.items():
            self._own[name][row] = array

    def finish(self) -> dict[str, npt.NDArray[Any]]:
        """Return all rows of each array, once they are filled. Call this once, as the last call."""
        return self._own if self._arena is None else self._buffers.lend_arrays(self._arena)


class BatchBuffers:
    """Keep the memory of a dataset's batches from one iteration to the next."""

    def __init__(self) -> None:
        self._form: tuple[Layout, int, int] = {}, 0, 0
        # Deques: finalizers may run in any thread (that of DataLoader's pinning, say), and their methods are atomic.
        self._free: deque[Bytes] = deque()
        self._arenas: deque[Arena] = deque()

    def shape(self, layout: Layout, batch_size: int, spare: int) -> None:
        """Set the form of the batches taken from now on; memory of another form is released.

        Args:
            layout: dtype and shape of each array of one sample.
            batch_size: samples of a batch.
            spare: maximum number of unused batches to keep.
        """
        form = dict(layout), batch_size, spare
        if form != self._form:
            self._form = form
            self._free, self._arenas = deque(maxlen=spare), deque(maxlen=spare)

    def take(self, *, shared: bool) -> BatchMemory:
        """Return memory for a batch, with unspecified content.

        Args:
            shared: whether it has slots for workers on this host, if the system supports that.
        """
        return BatchMemory(self, self._take_arena() if shared else None)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return private arrays for a batch. Their memory comes back once nothing refers to them."""
        layout, batch_size, _ = self._form
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(batch_bytes(layout, batch_size), np.uint8)
        return batch_arrays(lend(memory, self._free.append), layout, batch_size)

    def _take_arena(self) -> Arena | None:
        while self._arenas:
            arena = self._arenas.pop()
            if arena.process == os.getpid():  # otherwise the parent, from which this process was forked, may use it
                return arena
        return open_arena(*self._form[:2])

    def lend_arrays(self, arena: Arena) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of an arena whose batch is complete. The arena comes back once nothing refers to them.

        An arena whose batch was never completed does not come back.
        """
        free, forks = self._arenas, _forks

        def unused() -> None:
            if forks == _forks:
                free.append(arena)

        return arena.arrays(unused)


_forks = 0


def _note_fork() -> None:
    global _forks
    _forks += 1


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_note_fork)
