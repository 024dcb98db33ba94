"""A server that gives the memory it has freed back to the system when it is sent SIGUSR2.

The allocator keeps what is freed between things that are not, so that the resident memory of a server that was pressed
hard once stays up, by an amount that depends on how much was on its way at the same moment. What it holds is seen only
after that.
"""

from __future__ import annotations

import signal
import sys

from v2v_protocol.allocator import give_back_freed_memory
from v2v_server.commands.serve import main

if __name__ == "__main__":
    signal.signal(signal.SIGUSR2, lambda _number, _frame: give_back_freed_memory())
    sys.exit(main())
