"""Makes a part of a real server slow: on its PYTHONPATH, this is run by every Python it starts.

``V2V_SLOW`` is "broker" or "handover". Nothing in the product knows of this.
"""

import os
import time
from pathlib import Path


def _slowly(function, seconds):
    def call(*arguments, **named):
        time.sleep(seconds)
        return function(*arguments, **named)

    return call


slow = os.environ.get("V2V_SLOW", "")
is_worker = b"v2v_server.commands.worker" in Path("/proc/self/cmdline").read_bytes().split(b"\0")
try:
    if slow == "handover" and is_worker:
        from v2v_server.worker import process

        process.open_output_buffer = _slowly(process.open_output_buffer, 0.1)
    if slow == "broker" and not is_worker:
        from v2v_server.broker.dispatcher import Dispatcher

        Dispatcher.from_worker = _slowly(Dispatcher.from_worker, 0.05)
except (AttributeError, ImportError) as error:
    # Python goes on after any other error here, and the test would prove nothing.
    raise SystemExit(f"nothing is made slow: {error}") from error
