"""Test that a loader worker sends its queued batches before it ends, and says which it cannot send."""

from __future__ import annotations

import atexit
import multiprocessing
import multiprocessing.queues
import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from torch.utils.data import DataLoader, IterableDataset
from torchdata.stateful_dataloader import StatefulDataLoader

from v2v_client.loaders import send_before_exit
from v2v_protocol.errors import UsageError

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
    assert queue.get(timeout=600) == "arrived"
    process.join()
    assert process.exitcode == 0
    queue.close()


class Unsendable:
    """Hold a batch that cannot be sent, as a tensor for which /dev/shm has no space."""

    def __reduce__(self) -> tuple[Any, ...]:
        raise RuntimeError("unable to allocate shared memory(shm) for file </torch_1>: No space left on device (28)")


class Batches(IterableDataset[Any]):
    """Yield batches of which one, by its number, cannot be sent."""

    def __init__(self, count: int, unsendable: int) -> None:
        self.count, self.unsendable = count, unsendable

    def __iter__(self) -> Iterator[Any]:
        for number in range(self.count):
            yield Unsendable() if number == self.unsendable else number


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # by torchdata
@pytest.mark.parametrize("loader", [DataLoader, StatefulDataLoader])
@pytest.mark.parametrize("unsendable", [0, 2, 3])
def test_an_epoch_that_misses_a_batch_raises(loader: type[DataLoader[Any]], unsendable: int) -> None:
    came: list[Any] = []
    with pytest.raises(UsageError, match=r"cannot send a batch.*No space left.*--shm-size 2g.*num_workers=0"):
        came.extend(loader(Batches(4, unsendable), batch_size=None, num_workers=1))
    assert came == list(range(unsendable))


def test_errors_of_other_queues_are_printed(capfd: pytest.CaptureFixture[str]) -> None:
    fork = multiprocessing.get_context("fork")
    process = fork.Process(target=_queue_something_else)
    process.start()
    process.join()
    assert process.exitcode == 0
    assert "No space left on device" in capfd.readouterr().err


def _queue_something_else() -> None:
    queue: multiprocessing.queues.Queue[Any] = multiprocessing.get_context("fork").Queue()
    queue.put(Unsendable())
    queue.put("next")
    assert queue.get(timeout=600) == "next"
