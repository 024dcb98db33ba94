"""What we ask of the operating system: memory that is reused, and children that do not outlive their parent."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_LARGEST_THRESHOLD_BYTES = 32 << 20  # glibc refuses more (HEAP_MAX_SIZE / 2)
_PR_SET_PDEATHSIG = 1


def keep_freed_memory() -> bool:
    """Lets glibc serve and keep blocks of a few megabytes from its heap instead of mapping each anew.

    A sample is 1 to 4 MB. By default every one of them is mapped, faulted in page by page and unmapped again, which
    doubles the processor time of sending it.

    Returns:
        False where the C library is not glibc: nothing was changed, everything works, only slower.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST_THRESHOLD_BYTES)) and bool(
        mallopt(_M_TRIM_THRESHOLD, _LARGEST_THRESHOLD_BYTES)
    )


def die_with_parent(parent_pid: int) -> None:
    """Makes the kernel kill this process when its parent dies, even by SIGKILL (Linux; elsewhere nothing happens).

    Args:
        parent_pid: who the parent was when this process was started; if it is gone already, so are we.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)
