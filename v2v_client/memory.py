"""Hold batches in memory that the server's workers on this host may write to, and reuse it.

The rules between processes are in :mod:`v2v_protocol.arena`. An :class:`Arena` is an anonymous file whose size is
sealed, so that no peer can make a page fault fail. A complete batch is a private mapping of the file: its user's writes
are invisible to workers. If no page of the mapping was written to, it also serves the next batch.

:class:`BatchBuffers` reuses memory once its last user is gone, because fresh memory costs more than the copy into it:
the kernel hands out zeroed pages one fault at a time. A lent array (:func:`lend`) does not own its memory but refers to
a small *loan* object that does: NumPy keeps the object behind ``__array_interface__`` alive as the array's base.
Everything made from that array without copying (a view, a torch tensor, a tensor's storage, another tensor or array of
the same storage) keeps the loan alive; its finalizer returns the memory. References are not counted by hand, and the
user does not have to release anything. An arena that was in use during a fork is not reused: the child may refer to it
indefinitely, and this process cannot find out.

:class:`Slots` (pure) tracks which slot each sample may be written to, and what its arrival means for the slot. If no
slots are offered (not supported by the system, or disabled), samples arrive in messages.
"""

from __future__ import annotations

import mmap
import os
import resource
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.arena import (
    NO_SLOT,
    ArenaName,
    Slot,
    array_offsets,
    create_memory,
    open_memory,
    read_arrays,
    seal_memory,
)
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Want
from v2v_protocol.sample import Form, Layout, new_arrays

ByteArray = npt.NDArray[np.uint8]

_DESCRIPTORS_AN_ARENA = 8
"""Allowed files per arena. An arena has two open files, its own and its mapping's, so all arenas together use at most
a quarter of the process's limit."""
_POPULATE_READ = 22
"""MADV_POPULATE_READ of Linux 5.14, asm-generic/mman-common.h: mapping all pages at once is cheaper than one by one."""
_PRESENT_IN_FILE = np.uint64(1 << 63 | 1 << 61)
"""Bits in /proc/PID/pagemap: the page is present and file-backed."""


class _Loan:
    """Own lent memory from NumPy's point of view."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, memory: ByteArray) -> None:
        address = memory.ctypes.data, False
        self.__array_interface__ = {"version": 3, "data": address, "shape": memory.shape, "typestr": "|u1"}


def lend(memory: ByteArray, back: Callable[[ByteArray], object]) -> ByteArray:
    """Return another array of the same memory, and call ``back`` when it is no longer used.

    Args:
        memory: [bytes], kept alive until then.
        back: called with the memory once nothing refers to the returned array. It may run in any thread, and does not
            run at the end of the process.
    """
    loan = _Loan(memory)
    # The finalizer holds the memory while the loan lives.
    weakref.finalize(loan, back, memory).atexit = False
    return np.asarray(loan)


def batch_arrays(memory: ByteArray, layout: Layout, slots: int) -> dict[str, npt.NDArray[Any]]:
    """Return the rows of each array, [slots, ...], as views of a batch's memory."""
    sizes = Form.of(layout).sizes
    places = zip(layout.items(), sizes, array_offsets(sizes, slots), strict=False)  # the last offset is the total size
    return {
        name: memory[offset : offset + slots * size].view(dtype).reshape(slots, *shape)
        for (name, (dtype, shape)), size, offset in places
    }


class Arena:
    """Hold memory for the samples of one batch. It is freed once nothing refers to the arena or its arrays.

    Args:
        layout: dtype and shape of each array of one sample, in the order of the headers.
        slots: samples of the batch.

    Attributes:
        process: id of the process that created it.

    Raises:
        OSError: the system does not support sealed anonymous files, or has no memory left.
    """

    def __init__(self, layout: Layout, slots: int) -> None:
        self.process = os.getpid()
        self._layout = dict(layout)
        self._slots = slots
        sizes = Form.of(layout).sizes
        self._sizes = dict(zip(layout, sizes, strict=True))
        *offsets, self._bytes = array_offsets(sizes, slots)
        self._offsets = dict(zip(layout, offsets, strict=True))
        token = os.urandom(16).hex()
        memory_name = ArenaName(self.process, 0, slots, token).memory_name
        self._descriptor = create_memory(memory_name, self._bytes)
        weakref.finalize(self, os.close, self._descriptor).atexit = False
        seal_memory(self._descriptor, content=False)
        self._memory: ByteArray | None = None  # mapped for an earlier batch and no longer in use
        self._name = str(ArenaName(self.process, self._descriptor, slots, token))
        _arenas.add(self)

    def slot(self, row: int) -> Slot:
        """Return the slot that tells a worker where to write the sample of that row."""
        return Slot(self._name, row + 1)

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Copy a sample into a row.

        Args:
            row: 0 .. slots - 1.
            arrays: C-contiguous, such as voxels [T, bins, H, W], with dtypes and shapes of the layout.
        """
        for name, array in arrays.items():
            offset, rest = self._offset(name, row), array.reshape(-1).view(np.uint8).data
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                offset, rest = offset + written, rest[written:]

    def get(self, row: int) -> dict[str, npt.NDArray[Any]]:
        """Return a copy of the sample in a row: arrays by name, such as voxels [T, bins, H, W]."""
        sample = new_arrays(self._layout)
        for name, array in sample.items():
            offset, rest = self._offset(name, row), array.reshape(-1).view(np.uint8).data
            while rest:
                count = os.preadv(self._descriptor, [rest], offset)
                offset, rest = offset + count, rest[count:]
        return sample

    def arrays(self, unused: Callable[[], object]) -> dict[str, npt.NDArray[Any]]:
        """Return the rows of each array, [slots, ...], without a copy. Writing to them does not change the arena.

        The arena must not be written to while anything refers to them.

        Args:
            unused: called, in any thread, once nothing refers to them.
        """
        memory, self._memory = self._memory, None
        if memory is None or not _is_unwritten(memory):
            memory = self._map()

        def back(memory: ByteArray) -> None:
            self._memory = memory
            unused()

        return batch_arrays(lend(memory, back), self._layout, self._slots)

    def _map(self) -> ByteArray:
        """Map the whole file privately, with all its pages."""
        mapping = mmap.mmap(self._descriptor, self._bytes, mmap.MAP_PRIVATE)
        with suppress(OSError):  # an older kernel maps each page as it is read
            mapping.madvise(_POPULATE_READ)
        return np.frombuffer(mapping, np.uint8)

    def _offset(self, name: str, row: int) -> int:
        return self._offsets[name] + row * self._sizes[name]


def _is_unwritten(memory: ByteArray) -> bool:
    """Return whether no page of a private mapping was written to, so that it still shows the file.

    A page that was written to is a copy that no longer belongs to the file, which the kernel reports for each page
    (proc_pid_pagemap(5)). Reading that takes a fraction of the time of mapping the file again.
    """
    first, pages = memory.ctypes.data // mmap.PAGESIZE, -(-len(memory) // mmap.PAGESIZE)
    try:
        descriptor = os.open("/proc/self/pagemap", os.O_RDONLY | os.O_CLOEXEC)
        try:
            flags = np.frombuffer(os.pread(descriptor, 8 * pages, 8 * first), np.uint64)
        finally:
            os.close(descriptor)
    except OSError:
        return False
    return len(flags) == pages and bool(np.all(flags & _PRESENT_IN_FILE == _PRESENT_IN_FILE))


_arenas: weakref.WeakSet[Arena] = weakref.WeakSet()


def open_arena(layout: Layout, slots: int) -> Arena | None:
    """Open an arena; None if the system does not support them or this process may not have more.

    Samples then arrive in messages.
    """
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and _DESCRIPTORS_AN_ARENA * len(_arenas) >= files:
        return None
    try:
        return Arena(layout, slots)
    except OSError:
        return None


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
            arrays: copied into the row, such as voxels [T, bins, H, W]; None if a worker has written them into the
                row's slot.
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
        """Return the rows of each array, [batch size, ...], once they are filled. Call this once, as the last call."""
        return self._own if self._arena is None else self._buffers.lend_arrays(self._arena)


class BatchBuffers:
    """Keep the memory of a dataset's batches from one iteration to the next."""

    def __init__(self) -> None:
        self._form: tuple[Layout, int, int] = {}, 0, 0
        # Deques: finalizers may run in any thread (that of DataLoader's pinning, say), and their methods are atomic.
        self._free: deque[ByteArray] = deque()
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
        """Return private arrays for a batch, [batch size, ...]. Their memory comes back once nothing refers to them."""
        layout, batch_size, _ = self._form
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(array_offsets(Form.of(layout).sizes, batch_size)[-1], np.uint8)
        return batch_arrays(lend(memory, self._free.append), layout, batch_size)

    def _take_arena(self) -> Arena | None:
        while self._arenas:
            arena = self._arenas.pop()
            if arena.process == os.getpid():  # otherwise the parent, from which this process was forked, may use it
                return arena
        return open_arena(*self._form[:2])

    def lend_arrays(self, arena: Arena) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays, [batch size, ...], of an arena whose batch is complete.

        The arena comes back once nothing refers to them. An arena whose batch was never completed does not come back.
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


class Slots:
    """Track the slots named in the requests of one connection, without their bytes."""

    def __init__(self) -> None:
        self._offered: dict[int, Slot] = {}
        self._named: dict[int, Slot] = {}

    def offer(self, slots: Mapping[int, Slot]) -> None:
        """Offer slots, by index, for samples that were never requested yet."""
        self._offered.update(slots)

    def want(self, epoch: int, indices: Sequence[int]) -> Want:
        """Build a request for samples, each with the slot that was offered for it.

        A repeated request names no slot, because the first worker may still be writing to it.
        """
        slots = [self._offered.pop(index, None) for index in indices]
        self._named.update({index: slot for index, slot in zip(indices, slots, strict=True) if slot is not None})
        if not any(slots):
            return Want(epoch, tuple(indices))
        return Want(
            epoch,
            tuple(indices),
            tuple("" if slot is None else slot.arena for slot in slots),
            tuple(NO_SLOT if slot is None else slot.number for slot in slots),
        )

    def record_arrival(self, index: int, number: int, *, in_message: bool) -> bool | None:
        """Record that a sample arrived; return whether its slot is free: no worker may still write there.

        None: the arrays were written to another sample's slot and cannot be read.

        Args:
            index: global index of the sample.
            number: slot number in the sample's header.
            in_message: whether the message contained the arrays.
        """
        slot = self._named.get(index)
        returned = slot is not None and number == slot.number
        if not in_message and not returned:
            return None
        self._named.pop(index, None)
        return returned or slot is None


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
