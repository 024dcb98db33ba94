"""A server that returns freed memory to the system on SIGUSR2.

The allocator keeps freed memory, by an amount that depends on the messages in flight at the peak: only after this can
a leak be told from it.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from contextlib import suppress

import psutil

from bench.processes import rss_mib
from v2v_protocol.arena import give_back_freed_memory
from v2v_server.commands.serve import main

MODULE = "bench.chaos.trimming_server"
_TRIM_SECONDS = 0.5
_SETTLE_SECONDS = 30.0
_SETTLED_POLLS = 4


def trimmed_mib(pid: int) -> float:
    """Return the memory that such a server holds after it has returned what is free; 0 when it has ended."""
    with suppress(psutil.NoSuchProcess):
        psutil.Process(pid).send_signal(signal.SIGUSR2)
        time.sleep(_TRIM_SECONDS)
    return rss_mib(pid) or 0.0


def settled_mib(pid: int, limit_mib: float = math.inf) -> float:
    """Return a trimming server's memory once it is within the limit and stable, at the latest after 30 s."""
    deadline = time.monotonic() + _SETTLE_SECONDS
    lowest, unchanged = math.inf, 0
    while True:
        held = trimmed_mib(pid)
        unchanged = 0 if held < lowest - 1.0 else unchanged + 1
        lowest = min(lowest, held)
        if time.monotonic() > deadline or (held <= limit_mib and unchanged >= _SETTLED_POLLS):
            return held


if __name__ == "__main__":
    signal.signal(signal.SIGUSR2, lambda _number, _frame: give_back_freed_memory())
    sys.exit(main())
