"""A loader worker ends only once the batches it handed over are on their way.

``torch.utils.data.DataLoader`` passes batches on in a daemon thread of each worker, which moves tensors into shared
memory there, and does not wait for it when a trainer leaves an epoch early. A worker that was forked ends without
further ado. One that was spawned takes its interpreter down around that thread, and C++ answers with "terminate called
without an active exception": the trainer reads that its loader worker was killed by SIGABRT.
"""

from __future__ import annotations

import atexit
import functools
import threading

_FEEDER = "QueueFeederThread"
"""The name that CPython's multiprocessing/queues.py gives to the thread."""

_PATIENCE = 4.0
"""Seconds; a DataLoader kills workers that have not ended after five (torch.utils.data._utils)."""


@functools.cache
def send_before_exit() -> None:
    """To be called in a loader worker, as often as one likes."""
    atexit.register(_wait_for_feeders)


def _wait_for_feeders() -> None:
    for thread in threading.enumerate():
        if thread.name == _FEEDER:
            thread.join(_PATIENCE)
