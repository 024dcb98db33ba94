"""Run code as on a processor without any extension of its instruction set, with kernels compiled for it."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

COMPILE_SECONDS = 1200
"""A kernel takes half a minute of processor time to compile, of which a busy machine gives a tenth."""
_ROOT = Path(__file__).parents[3]


def printed_on_a_generic_processor(code: str, tmp_path: Path) -> list[str]:
    """Return the words that a program prints there.

    All tests of a run share the kernels that they compile. One program runs at a time: numba's cache cannot take more.
    """
    run = tmp_path.parents[1] if "PYTEST_XDIST_WORKER" in os.environ else tmp_path.parent
    cache = run / "generic-kernels"
    cache.mkdir(exist_ok=True)
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", code]
    with (run / "generic-kernels.lock").open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return subprocess.run(
            command,
            env=os.environ | generic,
            cwd=_ROOT,
            capture_output=True,
            text=True,
            timeout=COMPILE_SECONDS,
            check=True,
        ).stdout.split()
