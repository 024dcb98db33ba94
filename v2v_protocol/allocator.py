"""A setting of the C library's allocator that a process which moves many megabytes a second gains from."""

from __future__ import annotations

import ctypes

LARGEST_SAMPLE_BYTES = 32 << 20
"""As much as every glibc takes for a limit, and more than a sample has."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3), from glibc's malloc.h."""
_EVER_BYTES = (1 << 31) - 1


def keep_freed_memory(_loader_worker: int = 0, *, most_bytes: int = _EVER_BYTES) -> bool:
    """Make this process keep memory that it freed, and use it again, instead of handing it back to the kernel.

    Every sample is received into fresh memory, and fresh memory from the kernel is cleared and mapped page by page,
    which doubles the processor time of sending it. Kept memory costs nothing of that. The price: the process stays as
    large as it ever was. It is a decision about the whole process, so nothing calls this by itself in a trainer: call
    it before the first iteration, and with loader workers give it to them,
    ``DataLoader(dataset, batch_size=None, num_workers=2, worker_init_fn=keep_freed_memory)``.

    Args:
        most_bytes: free memory beyond this is handed back after all; a larger block is mapped by itself.

    Returns:
        whether the C library understood; only glibc does.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    # Both: a large block is otherwise mapped by itself and unmapped when freed, or trimmed off the end of the heap.
    return bool(mallopt(_M_MMAP_THRESHOLD, min(most_bytes, 1 << 30))) and bool(mallopt(_M_TRIM_THRESHOLD, most_bytes))


def give_back_freed_memory() -> None:
    """Hand what this process has freed back to the kernel, wherever it lies. Takes milliseconds; only glibc can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
