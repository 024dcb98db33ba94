"""Test the record between processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch.utils.data._utils.worker as torch_worker

from v2v_client.position.record import Record, Start
from v2v_client.position.shared import Shared
from v2v_client.position.state import ResumeState

FORK = multiprocessing.get_context("fork")
RECORD = Record(Start(ResumeState(None, 7, 3, 0, 0, 1)))


def test_ranks_that_get_a_dataset_from_one_process_each_have_their_own_epochs() -> None:
    """torch.multiprocessing.spawn and notebook launchers do this. Ranks that are seeded alike name their
    passes alike."""
    shared = Shared(RECORD)
    with shared.change() as record:
        record.begin("before", 0, 1)
    for _ in range(2):
        assert _forked(_rank, shared) == (3, 4)
    assert shared.read().start.state.epoch == 3


def _rank(shared: Shared) -> tuple[int, int]:
    first: int = _forked(_loader_worker, shared)
    return first, shared.read().start.state.epoch


def _loader_worker(shared: Shared) -> int:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    with shared.change() as record:
        begun, _ = record.begin("pass", 0, 1)
        epoch = begun.start.state.epoch
        record.finish(begun.number, 0)
    return epoch


def _forked(function: Callable[[Shared], Any], shared: Shared) -> Any:
    here, there = FORK.Pipe()

    def run() -> None:
        there.send(function(shared))
        os._exit(0)

    process = FORK.Process(target=run)
    process.start()
    there.close()
    found = here.recv()
    process.join()
    process.close()
    here.close()
    return found


def test_a_rank_that_is_spawned_has_its_own_epochs() -> None:
    shared = Shared(RECORD)
    spawned = Shared.__new__(Shared)
    descriptor = SimpleNamespace(detach=lambda: os.dup(shared._descriptor))
    spawned.__setstate__({"descriptor": descriptor, "process": os.getpid() + 1})
    with spawned.change() as record:
        record.set_epoch(4)
    assert (shared.read().start.state.epoch, spawned.read().start.state.epoch) == (3, 4)


def test_a_copy_is_a_record_of_its_own() -> None:
    shared = Shared(RECORD)
    copied = pickle.loads(pickle.dumps(shared))
    with copied.change() as record:
        record.set_epoch(4)
    assert (shared.read().start.state.epoch, copied.read().start.state.epoch) == (3, 4)


def test_changes_of_many_threads_and_processes_are_all_kept() -> None:
    shared = Shared(RECORD)
    threads = [threading.Thread(target=_count_up, args=(shared,)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(3):
        _forked(_count_up_as_a_loader_worker, shared)
    for thread in threads:
        thread.join()
    assert shared.read().start.state.epoch == 3 + 6 * 50


def _count_up(shared: Shared) -> None:
    for _ in range(50):
        with shared.change() as record:
            record.set_epoch(record.start.state.epoch + 1)


def _count_up_as_a_loader_worker(shared: Shared) -> None:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    _count_up(shared)


def test_a_process_that_is_killed_in_a_change_leaves_no_lock_and_the_record_as_it_was() -> None:
    shared = Shared(RECORD)
    here, there = FORK.Pipe()

    def run() -> None:
        torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
        with shared.change() as record:
            record.set_epoch(9)
            shared._write = _stopped(there)  # type: ignore[method-assign]

    process = FORK.Process(target=run)
    process.start()
    here.recv()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    process.close()
    here.close()
    there.close()
    assert shared.read().start.state.epoch == 3


def _stopped(there: Any) -> Callable[..., None]:
    def write(record: Record, *, half: int) -> None:
        there.send("about to write")
        signal.pause()

    return write
