"""Ask PyTorch for the rank, and end loader workers properly: send what is queued, or say why not; end with the parent.

``torch.utils.data.DataLoader`` sends batches in a daemon thread of each loader worker, which moves tensors into shared
memory. It does not wait for that thread when a trainer leaves an epoch early. A forked worker just ends. A spawned
worker finalizes its interpreter while the thread still runs, and C++ aborts with "terminate called without an active
exception": the trainer reads that its loader worker was killed by SIGABRT.

If that thread cannot send a batch, CPython prints a traceback and drops it, and the epoch ends early without an error.
The usual cause is a full /dev/shm: Docker's has 64 MB.
"""

from __future__ import annotations

import atexit
import functools
import os
import threading
import time
from multiprocessing.queues import Queue
from typing import Any

import torch.distributed
from torch._utils import ExceptionWrapper
from torch.utils.data import get_worker_info

from v2v_protocol.errors import UsageError

_print_error = Queue._on_queue_feeder_error  # type: ignore[attr-defined]
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


def _send_error(queue: Any, error: Exception, unsent: Any) -> None:
    """Send the error in place of a batch, before all that was queued after it. Called by the queue's thread."""
    if get_worker_info() is None or not (isinstance(unsent, tuple) and type(unsent[0]) is int and len(unsent) == 2):
        _print_error(error, unsent)  # of another queue
        return
    number, batch = unsent
    refusal = UsageError(
        f"a loader worker cannot send a batch to the trainer: {error}. If /dev/shm is full (64 MB in Docker), "
        "enlarge it (docker run --shm-size 2g), use fewer num_workers, or num_workers=0"
    )
    failed = ExceptionWrapper((type(refusal), refusal, None), "in a loader worker")  # type: ignore[no-untyped-call]
    # torchdata sends the batch, the number of the worker and its state.
    is_stateful = isinstance(batch, tuple) and len(batch) == 3 and type(batch[1]) is int
    with queue._notempty:
        queue._sem.acquire()
        queue._buffer.appendleft((number, (failed, *batch[1:]) if is_stateful else failed))


# On import, since torchdata starts the queue's thread before it iterates.
Queue._on_queue_feeder_error = _send_error  # type: ignore[attr-defined]


@functools.cache
def end_with_parent() -> None:
    """End this loader worker within seconds of its parent's death, even while it waits for a server."""
    threading.Thread(target=_wait_for_orphaned, args=(os.getppid(),), name="v2v-parent", daemon=True).start()


def _wait_for_orphaned(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_SECONDS)
    os._exit(1)  # without a parent, no process can receive its batches


def distributed_rank() -> tuple[int, int] | None:
    """Return (rank, world size) of the default process group; None if there is none."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None
