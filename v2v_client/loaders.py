"""End loader workers properly: send what they have queued, and end with their parent.

``torch.utils.data.DataLoader`` sends batches in a daemon thread of each loader worker, which moves tensors into shared
memory. It does not wait for that thread when a trainer leaves an epoch early. A forked worker just ends. A spawned
worker finalizes its interpreter while the thread still runs, and C++ aborts with "terminate called without an active
exception": the trainer reads that its loader worker was killed by SIGABRT.
"""

from __future__ import annotations

import atexit
import functools
import os
import threading
import time

_FEEDER = "QueueFeederThread"
"""Name of the thread in CPython's multiprocessing/queues.py."""

_PATIENCE = 4.0
"""Seconds to wait for the thread. A DataLoader kills workers that have not ended after 5 (torch.utils.data._utils)."""

_PARENT_SECONDS = 1.0
"""Interval at which a loader worker checks that its parent lives."""


@functools.cache
def send_before_exit() -> None:
    """Delay this loader worker's exit until its batches are sent. Repeated calls do nothing."""
    atexit.register(_wait_for_feeders)


def _wait_for_feeders() -> None:
    for thread in threading.enumerate():
        if thread.name == _FEEDER:
            thread.join(_PATIENCE)


@functools.cache
def end_with_parent() -> None:
    """End this loader worker within seconds of its parent's death, even while it waits for a server."""
    threading.Thread(target=_wait_for_orphaned, args=(os.getppid(),), name="v2v-parent", daemon=True).start()


def _wait_for_orphaned(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_SECONDS)
    os._exit(1)  # without a parent, no process can receive its batches
