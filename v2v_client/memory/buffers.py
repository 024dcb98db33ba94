"""Memory for batches that is used again, but never while anything still looks at it.

Fresh memory costs more than the copy into it: the kernel hands out zeroed pages one fault at a time. So memory whose
last user is gone (:func:`v2v_client.memory.arena.lend`) is kept for the next batch.

A process that was forked while somebody looked at an arena may look at it for as long as it likes, and nobody here
would know: such an arena is not used again.
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
    """The rows of one batch that is being filled.

    Its workers may put samples into the slots of an arena. Where a sample came otherwise, and a worker may still write
    to its slot, the batch leaves the arena for memory that no other process can reach.

    Args:
        buffers: where memory of its own comes from.
        arena: where workers may put samples; None for memory of its own from the beginning.

    Attributes:
        lent: whether there were slots.
        in_place: samples that a worker put into their row.
    """

    def __init__(self, buffers: BatchBuffers, arena: Arena | None) -> None:
        self._buffers = buffers
        self._arena = arena
        self._own = buffers.arrays() if arena is None else {}
        self._left: Arena | None = None
        self._filled: list[int] = []
        self.has_slots = arena is not None
        self.in_place = 0

    def slot(self, row: int) -> Slot | None:
        """Where a worker of this host may put the sample of that row."""
        return None if self._arena is None else self._arena.slot(row)

    def fill(self, row: int, arrays: Mapping[str, npt.NDArray[Any]] | None, *, slot_is_free: bool = True) -> None:
        """A sample has come.

        Args:
            row: of the batch.
            arrays: copied into it; None where a worker has put them into the row's slot.
            slot_is_free: whether no worker writes to that slot any more.
        """
        if not slot_is_free and self._arena is not None:
            self._left, self._arena, self._own = self._arena, None, self._buffers.arrays()
            for before in self._filled:
                self._put(before, self._left.get(before))
        if arrays is not None:
            self._put(row, arrays)
        else:
            self.in_place += 1
            if self._left is not None:
                self._put(row, self._left.get(row))
        self._filled.append(row)

    def _put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        if self._arena is not None:
            self._arena.put(row, arrays)
            return
        for name, array in arrays.items():
            self._own[name][row] = array

    def finish(self) -> dict[str, npt.NDArray[Any]]:
        """All rows of each array, once they are filled. To be called once, and nothing else after it."""
        return self._own if self._arena is None else self._buffers.lend_arrays(self._arena)


class BatchBuffers:
    """The memory of a dataset's batches, which one iteration leaves to the next."""

    def __init__(self) -> None:
        self._form: tuple[Layout, int, int] = {}, 0, 0
        # Deques: finalizers may run in any thread (that of DataLoader's pinning, say), and their methods are atomic.
        self._free: deque[Bytes] = deque()
        self._arenas: deque[Arena] = deque()

    def shape(self, layout: Layout, batch_size: int, spare: int) -> None:
        """What is taken from now on is for batches of that many samples; memory of another form is let go.

        Args:
            layout: of one sample.
            batch_size: samples of a batch.
            spare: most batches kept while nobody uses them.
        """
        form = dict(layout), batch_size, spare
        if form != self._form:
            self._form = form
            self._free, self._arenas = deque(maxlen=spare), deque(maxlen=spare)

    def take(self, *, shared: bool) -> BatchMemory:
        """Memory for a batch, of unspecified content.

        Args:
            shared: with slots for the workers of this host, where the system has such memory.
        """
        return BatchMemory(self, self._take_arena() if shared else None)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays for a batch that no other process can reach; they come back when nothing looks at them any more."""
        layout, batch_size, _ = self._form
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(batch_bytes(layout, batch_size), np.uint8)
        return batch_arrays(lend(memory, self._free.append), layout, batch_size)

    def _take_arena(self) -> Arena | None:
        while self._arenas:
            arena = self._arenas.pop()
            if arena.process == os.getpid():  # otherwise the process that this one was forked from may go on with it
                return arena
        return open_arena(*self._form[:2])

    def lend_arrays(self, arena: Arena) -> dict[str, npt.NDArray[Any]]:
        """The arrays of an arena whose batch is whole; it comes back when nothing looks at them any more. One whose
        batch never became whole does not."""
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
