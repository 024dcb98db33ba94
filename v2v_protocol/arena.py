"""Name, create and open the memory that a consumer shares with the workers of its own host. I/O, Linux.

A consumer keeps an *arena*, an anonymous file in memory (memfd_create(2)), for each batch that it fills. With each
sample that it requests it names a *slot* of the arena, the batch's row. A worker that can open the arena, or gets
its descriptor from the server, makes the sample there and sends only the header. Any other worker sends the arrays in
the message. The consumer does not need to know which it is.

An arena must not be reused too early: a worker that was given up may resume and write. So

    the server gives a slot to one worker only: not to a second one, nor to the next after the first was lost;
    a header that names the slot states that its worker no longer writes there;
    a consumer reuses an arena for another batch only when such a header has come for every slot that it named.

Its size is sealed, so that no peer can make a page fault fail.
"""

from __future__ import annotations

import ctypes
import itertools
import mmap
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from v2v_protocol.errors import ProtocolError

NO_SLOT = 0
MOST_SLOTS = 65_536
_PAGE_BYTES = 4096
_NAME = re.compile(r"(\d{1,10}):(\d{1,10}):(\d{1,10}):([0-9a-f]{32})")


def create_memory(name: str, size: int) -> int:
    """Create memory of a fixed size, bytes, filled with zeros; return its descriptor.

    Raises:
        OSError: the system does not support sealed anonymous files, or has no memory left.
    """
    create = getattr(os, "memfd_create", None)  # Linux only, and so is sealing
    if create is None:
        raise OSError("this system has no memfd_create")
    from fcntl import F_ADD_SEALS, F_SEAL_GROW, F_SEAL_SHRINK, fcntl

    descriptor: int = create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, size)
        fcntl(descriptor, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def seal_memory(descriptor: int, *, content: bool) -> None:
    """Allow no other seals any more, and no write either if ``content`` is true.

    Raises:
        OSError: a process has mapped the memory to write to it.
    """
    from fcntl import F_ADD_SEALS, F_SEAL_SEAL, F_SEAL_WRITE, fcntl

    fcntl(descriptor, F_ADD_SEALS, F_SEAL_SEAL | (F_SEAL_WRITE if content else 0))


def find_memory(name: ArenaName, writable: bool) -> int:
    """Open memory of another process; return the descriptor, which :func:`open_memory` checks.

    Raises:
        OSError: it does not exist, or is not accessible.
    """
    # Read the link first: opening another file type, such as a device or a pipe, may have side effects.
    if os.readlink(name.path) != name.link:
        raise FileNotFoundError(name.path)
    return os.open(name.path, (os.O_RDWR if writable else os.O_RDONLY) | os.O_CLOEXEC | os.O_NONBLOCK)


def open_memory(
    name: ArenaName, size: int, *, writable: bool, find: Callable[[ArenaName, bool], int] = find_memory
) -> int:
    """Open memory of another process; return the descriptor.

    Args:
        name: of the memory.
        size: its expected size, bytes.
        writable: open it for writing; otherwise its content must be sealed.
        find: :func:`find_memory`, or how the descriptor comes from a process that may call it.

    Raises:
        OSError: it does not exist, is not accessible, has another size, or its size or content is not sealed.
    """
    from fcntl import F_GET_SEALS, F_SEAL_SHRINK, F_SEAL_WRITE, fcntl

    descriptor = find(name, writable)
    try:
        if os.readlink(f"/proc/self/fd/{descriptor}") != name.link:
            raise FileNotFoundError(name.path)
        # Accessing a page beyond the end of a file would kill this process.
        needed = F_SEAL_SHRINK if writable else F_SEAL_SHRINK | F_SEAL_WRITE
        if fcntl(descriptor, F_GET_SEALS) & needed != needed:
            raise OSError("it is not sealed")
        if os.fstat(descriptor).st_size != size:
            raise OSError(f"it does not have {size} bytes")
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read_arrays(descriptor: int, sizes: Sequence[int]) -> list[memoryview]:
    """Map memory with the arrays of one sample read-only, all pages at once.

    Args:
        descriptor: of the memory; it may be closed afterwards. The mapping keeps a duplicate open.
        sizes: bytes of each array.

    Returns:
        the bytes of each array, all parts of one ``mmap``, which is unmapped when nothing refers to them any more.

    Raises:
        OSError: the system has no descriptor or no memory left.
    """
    *offsets, total = array_offsets(sizes, 1)
    whole = memoryview(mmap.mmap(descriptor, total, mmap.MAP_PRIVATE | mmap.MAP_POPULATE, mmap.PROT_READ))
    return [whole[offset : offset + size] for offset, size in zip(offsets, sizes, strict=True)]


@dataclass(frozen=True, slots=True)
class ArenaName:
    """Information by which a worker on the same host finds an arena and verifies it.

    Attributes:
        pid: process id of the consumer.
        descriptor: file descriptor of the arena in that process.
        slots: number of samples that it holds.
        token: 32 random hexadecimal digits; part of the name under which the system knows the memory.
    """

    pid: int
    descriptor: int
    slots: int
    token: str

    def __str__(self) -> str:
        return f"{self.pid}:{self.descriptor}:{self.slots}:{self.token}"

    @classmethod
    def parse(cls, text: str) -> ArenaName:
        """Parse the text of an arena name.

        Raises:
            ProtocolError: the text does not name an arena.
        """
        match = _NAME.fullmatch(text)
        if match is None or not 0 < int(match[3]) <= MOST_SLOTS:
            raise ProtocolError(f"{text!r:.80} does not name an arena")
        return cls(int(match[1]), int(match[2]), int(match[3]), match[4])

    @property
    def path(self) -> str:
        """Path under which Linux lets processes of the same user and process namespace open it."""
        return f"/proc/{self.pid}/fd/{self.descriptor}"

    @property
    def memory_name(self) -> str:
        """Name of the memory, from which the target of ``path`` is derived."""
        return f"v2v-{self.token}"

    @property
    def link(self) -> str:
        """Target of the symbolic link ``path`` while the arena exists."""
        return f"/memfd:{self.memory_name} (deleted)"


@dataclass(frozen=True, slots=True)
class Slot:
    """Memory for one sample.

    Attributes:
        arena: text of the :class:`ArenaName`.
        number: from 1.
    """

    arena: str
    number: int


def array_offsets(sizes: Sequence[int], slots: int) -> list[int]:
    """Return the offset in an arena of each array of a whole batch, then the size of the arena: whole pages, in bytes.

    Args:
        sizes: bytes of each array of one sample, in the order of the headers.
        slots: number of slots of the arena.
    """
    pages = (-(-size * slots // _PAGE_BYTES) for size in sizes)
    return [_PAGE_BYTES * before for before in itertools.accumulate(pages, initial=0)]


LARGEST_SAMPLE_BYTES = 32 << 20
"""The largest limit that every glibc accepts; larger than a sample."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3), from glibc's malloc.h."""
_EVER_BYTES = (1 << 31) - 1


def keep_freed_memory(_loader_worker: int = 0, *, most_bytes: int = _EVER_BYTES) -> bool:
    """Make this process keep memory that it freed, and reuse it, instead of returning it to the kernel.

    Every sample is received into new memory. The kernel clears and maps new memory page by page, which doubles the
    processor time of sending it. Kept memory avoids this cost, but the process stays as large as it ever was. This is a
    decision about the whole process, so nothing calls it by itself in a trainer: call it before the first iteration.
    With loader workers, pass it to them, ``DataLoader(dataset, batch_size=None, num_workers=2,
    worker_init_fn=keep_freed_memory)``.

    Args:
        most_bytes: free memory beyond this is returned to the kernel; a larger block is mapped separately.

    Returns:
        whether the C library accepted the settings; only glibc does.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    # Both: a large block is otherwise mapped by itself and unmapped when freed, or trimmed off the end of the heap.
    return bool(mallopt(_M_MMAP_THRESHOLD, min(most_bytes, 1 << 30))) and bool(mallopt(_M_TRIM_THRESHOLD, most_bytes))


def give_back_freed_memory() -> None:
    """Return all freed memory of this process to the kernel. Takes milliseconds; only glibc supports it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
