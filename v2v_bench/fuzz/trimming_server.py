"""A server that gives the memory it has freed back to the system when it is sent SIGUSR2.

The allocator keeps what is freed between things that are not, so that the resident memory of a server that was pressed
hard once stays up, by an amount that depends on how much was on its way at the same moment. What it holds is seen only
after that.
"""

from __future__ import annotations

import ctypes
import signal
import sys

from v2v_server.commands.serve import main


def _trim(number: int, frame: object) -> None:
    # glibc's own; other C libraries keep less, and have nothing to call.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


if __name__ == "__main__":
    signal.signal(signal.SIGUSR2, _trim)
    sys.exit(main())
