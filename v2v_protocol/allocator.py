"""Configure the C library's allocator for processes that receive many megabytes per second."""

from __future__ import annotations

import ctypes

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
