"""Running code as on a processor without any extension of its instruction set, compiled afresh."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).parents[3]


def printed_on_a_generic_processor(code: str, cache: Path) -> list[str]:
    """The words that a Python program prints whose kernels are compiled for such a processor, into an empty folder."""
    generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env=os.environ | generic, cwd=_ROOT, capture_output=True, text=True, timeout=240, check=True
    ).stdout.split()
