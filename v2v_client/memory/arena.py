"""Hold a batch's rows in memory that the server's workers on this host may write to.

The rules are in :mod:`v2v_protocol.arena`. The memory is an anonymous file whose size is sealed, so that no peer can
make a page fault fail. A complete batch is a private mapping of the file: its user's writes are invisible to workers.
If no page of the mapping was written to, it also serves the next batch.

Memory is reused once its last user is gone. A lent array (:func:`lend`) does not own its memory but refers to a small
*loan* object that does: NumPy keeps the object behind ``__array_interface__`` alive as the array's base. Everything
made from that array without copying (a view, a torch tensor, a tensor's storage, another tensor or array of the same
storage) keeps the loan alive; its finalizer returns the memory. References are not counted by hand, and the user does
not have to release anything.
"""

from __future__ import annotations

import mmap
import os
import resource
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.arena import ArenaName, Slot, array_offsets, create_memory, seal_memory
from v2v_protocol.sample import Form, Layout, new_arrays

Bytes = npt.NDArray[np.uint8]

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

    def __init__(self, memory: Bytes) -> None:
        address = memory.ctypes.data, False
        self.__array_interface__ = {"version": 3, "data": address, "shape": memory.shape, "typestr": "|u1"}


def lend(memory: Bytes, back: Callable[[Bytes], object]) -> Bytes:
    """Return another array of the same memory, and call ``back`` when it is no longer used.

    Args:
        memory: kept alive until then.
        back: called with the memory once nothing refers to the returned array. It may run in any thread, and does not
            run at the end of the process.
    """
    loan = _Loan(memory)
    # The finalizer holds the memory while the loan lives.
    weakref.finalize(loan, back, memory).atexit = False
    return np.asarray(loan)


def batch_bytes(layout: Layout, slots: int) -> int:
    """Return the size in bytes of the memory of a batch of ``slots`` samples."""
    return array_offsets(Form.of(layout).sizes, slots)[-1]


def batch_arrays(memory: Bytes, layout: Layout, slots: int) -> dict[str, npt.NDArray[Any]]:
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
        self._memory: Bytes | None = None  # mapped for an earlier batch and no longer in use
        self._name = str(ArenaName(self.process, self._descriptor, slots, token))
        _arenas.add(self)

    def slot(self, row: int) -> Slot:
        """Return the slot that tells a worker where to write the sample of that row."""
        return Slot(self._name, row + 1)

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Copy a sample into a row.

        Args:
            row: 0 .. slots - 1.
            arrays: C-contiguous, with dtypes and shapes of the layout.
        """
        for name, array in arrays.items():
            offset, rest = self._offset(name, row), array.reshape(-1).view(np.uint8).data
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                offset, rest = offset + written, rest[written:]

    def get(self, row: int) -> dict[str, npt.NDArray[Any]]:
        """Return a copy of the sample in a row."""
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

        def back(memory: Bytes) -> None:
            self._memory = memory
            unused()

        return batch_arrays(lend(memory, back), self._layout, self._slots)

    def _map(self) -> Bytes:
        """Map the whole file privately, with all its pages."""
        mapping = mmap.mmap(self._descriptor, self._bytes, mmap.MAP_PRIVATE)
        with suppress(OSError):  # an older kernel maps each page as it is read
            mapping.madvise(_POPULATE_READ)
        return np.frombuffer(mapping, np.uint8)

    def _offset(self, name: str, row: int) -> int:
        return self._offsets[name] + row * self._sizes[name]


def _is_unwritten(memory: Bytes) -> bool:
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
