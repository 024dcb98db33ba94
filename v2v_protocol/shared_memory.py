"""Create and open anonymous files in memory (memfd_create(2)) that processes of one user and host share. I/O.

:mod:`v2v_protocol.arena` names them. Their size is sealed, so that no peer can make a page fault fail.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Sequence

from v2v_protocol.arena import ArenaName, array_offsets


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
