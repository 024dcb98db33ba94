"""A batch's rows in memory that the server's workers on this host may write to; the rules are in
:mod:`v2v_protocol.arena`.

It is an anonymous file whose size is sealed, so that no peer can make a page fault fail. A batch that is whole is a
private mapping of it: what its holder writes stays his, and no worker can see it. A mapping that nobody has written to
serves the next batch as well.

Memory is used again once its last user is gone. An array that is lent (:func:`lend`) does not own its memory but refers
to a small *loan* object that does: NumPy keeps the object behind ``__array_interface__`` alive as the array's base.
Whatever is made from that array without copying, a view, a torch tensor, a tensor's storage, another tensor or array of
the same storage, keeps the loan alive; its finalizer gives the memory back. No reference is counted by hand, and no
promise of the user is needed.
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

from v2v_protocol.arena import ArenaName, Slot, array_offsets
from v2v_protocol.sample import Form, Layout, new_arrays

Bytes = npt.NDArray[np.uint8]

_DESCRIPTORS_AN_ARENA = 8
"""It has two open files, its own and its mapping's; all arenas leave three quarters of what a process may have."""
_POPULATE_READ = 22
"""MADV_POPULATE_READ of Linux 5.14, asm-generic/mman-common.h: all pages at once is cheaper than one at a time."""
_THE_FILES = np.uint64(1 << 63 | 1 << 61)
"""In /proc/PID/pagemap: the page is there, and it is a file's."""


class _Loan:
    """Owner, in the eyes of NumPy, of borrowed memory."""

    __slots__ = ("__array_interface__", "__weakref__")

    def __init__(self, memory: Bytes) -> None:
        address = memory.ctypes.data, False
        self.__array_interface__ = {"version": 3, "data": address, "shape": memory.shape, "typestr": "|u1"}


def lend(memory: Bytes, back: Callable[[Bytes], object]) -> Bytes:
    """The memory as another array.

    Args:
        memory: kept until it is back.
        back: called with the memory once nothing refers to that array any more, in whatever thread that happens; not at
            the end of the process.
    """
    loan = _Loan(memory)
    # The finalizer holds the memory while the loan lives.
    weakref.finalize(loan, back, memory).atexit = False
    return np.asarray(loan)


def batch_bytes(layout: Layout, slots: int) -> int:
    """Size of the memory of a batch of so many samples."""
    return array_offsets(Form.of(layout).sizes, slots)[-1]


def batch_arrays(memory: Bytes, layout: Layout, slots: int) -> dict[str, npt.NDArray[Any]]:
    """The rows of each array, [slots, ...], in the memory of a batch, without a copy."""
    sizes = Form.of(layout).sizes
    places = zip(layout.items(), sizes, array_offsets(sizes, slots), strict=False)  # after the last begins nothing
    return {
        name: memory[offset : offset + slots * size].view(dtype).reshape(slots, *shape)
        for (name, (dtype, shape)), size, offset in places
    }


class Arena:
    """Memory for the samples of one batch. It is freed when nothing refers to this, or to arrays of it, any more.

    Args:
        layout: dtype and shape of each array of one sample, in the order of the headers.
        slots: samples of the batch.

    Attributes:
        process: id of the one that made it.

    Raises:
        OSError: the system has no such memory.
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
        self._descriptor = _sealed_file(memory_name, self._bytes)
        weakref.finalize(self, os.close, self._descriptor).atexit = False
        self._memory: Bytes | None = None  # mapped for an earlier batch, which nothing looks at any more
        self._name = str(ArenaName(self.process, self._descriptor, slots, token))
        _arenas.add(self)

    def slot(self, row: int) -> Slot:
        """What a worker is told, to put a sample into that row."""
        return Slot(self._name, row + 1)

    def put(self, row: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Copies a sample into a row.

        Args:
            row: of the batch.
            arrays: C-contiguous, of the layout.
        """
        for name, array in arrays.items():
            offset, rest = self._offset(name, row), array.reshape(-1).view(np.uint8).data
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                offset, rest = offset + written, rest[written:]

    def get(self, row: int) -> dict[str, npt.NDArray[Any]]:
        """A copy of the sample in a row."""
        sample = new_arrays(self._layout)
        for name, array in sample.items():
            offset, rest = self._offset(name, row), array.reshape(-1).view(np.uint8).data
            while rest:
                count = os.preadv(self._descriptor, [rest], offset)
                offset, rest = offset + count, rest[count:]
        return sample

    def arrays(self, unused: Callable[[], object]) -> dict[str, npt.NDArray[Any]]:
        """The rows of each array, [slots, ...], without a copy. Writing to them changes nothing here.

        As long as anything looks at them, nobody may write to the arena.

        Args:
            unused: called once nothing looks at them, in whatever thread that happens.
        """
        memory, self._memory = self._memory, None
        if memory is None or not _is_unwritten(memory):
            memory = self._map()

        def back(memory: Bytes) -> None:
            self._memory = memory
            unused()

        return batch_arrays(lend(memory, back), self._layout, self._slots)

    def _map(self) -> Bytes:
        """All of it, privately, with all its pages."""
        mapping = mmap.mmap(self._descriptor, self._bytes, mmap.MAP_PRIVATE)
        with suppress(OSError):  # an older kernel maps each page as it is read
            mapping.madvise(_POPULATE_READ)
        return np.frombuffer(mapping, np.uint8)

    def _offset(self, name: str, row: int) -> int:
        return self._offsets[name] + row * self._sizes[name]


def _is_unwritten(memory: Bytes) -> bool:
    """Whether a private mapping still shows what is mapped: nobody has written to any of its pages.

    A page that was written to is a copy, which is no longer the file's: the kernel says so of each page
    (proc_pid_pagemap(5)). Asking takes a fraction of the time of mapping it anew.
    """
    first, pages = memory.ctypes.data // mmap.PAGESIZE, -(-len(memory) // mmap.PAGESIZE)
    try:
        descriptor = os.open("/proc/self/pagemap", os.O_RDONLY | os.O_CLOEXEC)
        try:
            said = np.frombuffer(os.pread(descriptor, 8 * pages, 8 * first), np.uint64)
        finally:
            os.close(descriptor)
    except OSError:
        return False
    return len(said) == pages and bool(np.all(said & _THE_FILES == _THE_FILES))


_arenas: weakref.WeakSet[Arena] = weakref.WeakSet()


def open_arena(layout: Layout, slots: int) -> Arena | None:
    """An arena; None where the system has none, or this process enough of them, and samples come in messages."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files != resource.RLIM_INFINITY and _DESCRIPTORS_AN_ARENA * len(_arenas) >= files:
        return None
    try:
        return Arena(layout, slots)
    except OSError:
        return None


def _sealed_file(name: str, size: int) -> int:
    create = getattr(os, "memfd_create", None)  # Linux only, and so is sealing
    if create is None:
        raise OSError("this system has no memfd_create")
    from fcntl import F_ADD_SEALS, F_SEAL_GROW, F_SEAL_SEAL, F_SEAL_SHRINK, fcntl

    descriptor: int = create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, size)
        fcntl(descriptor, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor
