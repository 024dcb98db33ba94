"""What we ask of the operating system: memory that is reused, children that do not outlive their parent, and a folder
for compiled code."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

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


def choose_compile_cache(environment: MutableMapping[str, str] = os.environ) -> None:
    """Decides where numba keeps compiled kernels; to be called before numba is imported.

    Numba itself writes beside the code or into the home folder, and refuses to start where neither can be written, as
    in a hardened container. So: ``NUMBA_CACHE_DIR`` if it is set; beside the code if that can be written; else a folder
    below ``V2V_CACHE_DIR``, the user's cache folder, or the one for temporary files.
    """
    if environment.get("NUMBA_CACHE_DIR"):
        return
    code = Path(__file__).parent / "simulation"
    if os.access(code, os.W_OK) and (not (code / "__pycache__").exists() or os.access(code / "__pycache__", os.W_OK)):
        return
    ours = environment.get("V2V_CACHE_DIR")
    user = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "v2v"
    folder = (Path(ours) if ours else user) / "numba"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    environment["NUMBA_CACHE_DIR"] = str(folder) if writable else str(Path(tempfile.gettempdir()) / "v2v-numba")
