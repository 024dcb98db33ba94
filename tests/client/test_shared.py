"""Test the table between processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch.utils.data._utils.worker as torch_worker

from v2v_client.passes import Shared, Start, Table
from v2v_client.position import ResumeState

FORK = multiprocessing.get_context("fork")
SPAWN = multiprocessing.get_context("spawn")
TABLE = Table(Start(ResumeState(None, 7, 3, 0, 0, 1)))


def test_ranks_that_get_a_dataset_from_one_process_each_have_their_own_epochs() -> None:
    """torch.multiprocessing.spawn and notebook launchers do this. Ranks that are seeded alike name their
    passes alike."""
    shared = Shared(TABLE)
    with shared.change() as table:
        table.begin("before", 0, 1)
    for _ in range(2):
        assert _forked(_rank, shared) == (3, 4)
    assert shared.read().start.state.epoch == 3


def _rank(shared: Shared) -> tuple[int, int]:
    first: int = _forked(_loader_worker, shared)
    return first, shared.read().start.state.epoch


def _loader_worker(shared: Shared) -> int:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    with shared.change() as table:
        number, _ = table.begin("pass", 0, 1)
        epoch = table.passes[number].start.state.epoch
        table.deliver(number, 0, finished=True)
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
    """Its loader workers, which are forked or spawned in turn, have those of the rank."""
    shared = Shared(TABLE)
    here, there = SPAWN.Pipe()
    process = SPAWN.Process(target=_spawned_rank, args=(shared, there))
    process.start()
    there.close()
    assert here.recv() == (3, 4)
    process.join()
    process.close()
    here.close()
    assert shared.read().start.state.epoch == 3


def _spawned_rank(shared: Shared, there: Any) -> None:
    there.send(_rank(shared))


def test_tables_of_ended_ranks_do_not_fill_the_file() -> None:
    """A notebook may launch ranks again and again with one dataset."""
    shared = Shared(TABLE)
    with shared.change() as table:
        table.set_epoch(5)
    for rank in range(100):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "getpid", lambda rank=rank: 1_000_000 + rank)
            with shared.change() as table:
                assert table.start.state.epoch == 5
                table.set_epoch(rank)
    size = os.fstat(shared._descriptor).st_size
    assert size % (1 << 30) < 80 * len(pickle.dumps(TABLE))
    assert shared.read().start.state.epoch == 5


def test_a_copy_is_a_table_of_its_own() -> None:
    shared = Shared(TABLE)
    copied = pickle.loads(pickle.dumps(shared))
    with copied.change() as table:
        table.set_epoch(4)
    assert (shared.read().start.state.epoch, copied.read().start.state.epoch) == (3, 4)


def test_changes_of_many_threads_and_processes_are_all_kept() -> None:
    shared = Shared(TABLE)
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
        with shared.change() as table:
            table.set_epoch(table.start.state.epoch + 1)


def _count_up_as_a_loader_worker(shared: Shared) -> None:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    _count_up(shared)


def test_a_process_that_is_killed_in_a_change_leaves_no_lock_and_the_table_as_it_was() -> None:
    shared = Shared(TABLE)
    here, there = FORK.Pipe()

    def run() -> None:
        torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
        with shared.change() as table:
            table.set_epoch(9)
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
    def write(tables: dict[int, Table], *, at: int) -> None:
        there.send("about to write")
        signal.pause()

    return write
