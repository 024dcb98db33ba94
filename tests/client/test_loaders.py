"""Test that a loader worker sends its queued batches before it ends."""

from __future__ import annotations

import atexit
import multiprocessing
import multiprocessing.queues
import os
import threading
from typing import Any

from v2v_client.loaders import send_before_exit

_the_end_has_come = threading.Event()


class Ponderous:
    """Hold a batch whose pickling goes on while its process ends, as that of tensors may."""

    def __reduce__(self) -> tuple[Any, ...]:
        _the_end_has_come.wait()
        return str, ("arrived",)


def hand_over_and_leave(queue: multiprocessing.queues.Queue[Any]) -> None:
    """Queue a batch and exit, as a loader worker does if its trainer leaves early (torch.utils.data._utils.worker)."""
    # Exit functions run in reverse order. The batch is pickled from the first of them on, and if no function waits for
    # that, the process ends before another thread runs.
    atexit.register(os._exit, 0)
    send_before_exit()
    send_before_exit()
    atexit.register(_the_end_has_come.set)
    queue.put(Ponderous())
    queue.cancel_join_thread()
    queue.close()


def test_a_spawned_process_sends_its_queued_batches_before_it_exits() -> None:
    spawn = multiprocessing.get_context("spawn")
    queue = spawn.Queue()
    process = spawn.Process(target=hand_over_and_leave, args=(queue,))
    process.start()
    assert queue.get(timeout=60) == "arrived"
    process.join()
    assert process.exitcode == 0
    queue.close()
