"""A server that returns freed memory to the system on SIGUSR2.

The allocator keeps freed memory, by an amount that depends on the messages in flight at the peak: only after this can
a leak be told from it.
"""

from __future__ import annotations

import signal
import sys

from v2v_protocol.allocator import give_back_freed_memory
from v2v_server.commands.serve import main

if __name__ == "__main__":
    signal.signal(signal.SIGUSR2, lambda _number, _frame: give_back_freed_memory())
    sys.exit(main())
