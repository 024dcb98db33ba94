"""What the copies of a dataset agree on, by the order in which they change it."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch.utils.data._utils.worker as torch_worker

from v2v_client.position.shared import Agreed, LoaderIteration, Shared
from v2v_client.position.state import ResumeState

WORKERS = range(2)
FORK = multiprocessing.get_context("fork")
LOADED = ResumeState(None, 7, 3, 0, 8, 1)


def started(agreed: Agreed, name: str, worker: int, loaded: ResumeState | None = None) -> tuple[Any, ...]:
    iteration = agreed.start(name, worker, loaded)
    return iteration.number, iteration.epoch, iteration.state


# --- the record, without a process ------------------------------------------------------------------------------------


def test_the_epoch_ends_with_the_last_loader_worker() -> None:
    agreed = Agreed(3)
    for epoch in (3, 4):
        numbers = {started(agreed, f"iteration {epoch}", worker) for worker in WORKERS}
        ((number, *decided),) = numbers
        assert decided == [epoch, None]
        for worker in WORKERS:
            assert agreed.epoch == epoch
            agreed.finish(number, worker, len(WORKERS))
            agreed.finish(number, worker, len(WORKERS))  # once more counts once
    assert agreed.epoch == 5


@pytest.mark.parametrize("finished_before", [0, 1])
@pytest.mark.parametrize("state", [None, LOADED], ids=["set_epoch", "a loaded state"])
def test_workers_that_finish_what_was_left_early_do_not_end_the_epoch_that_was_set(
    state: ResumeState | None, finished_before: int
) -> None:
    """It is the same epoch once more, as a validation repeats it; they had prefetched its last batches."""
    agreed = Agreed(3)
    early = max(agreed.start("early", worker, None).number for worker in WORKERS)
    for worker in WORKERS[:finished_before]:
        agreed.finish(early, worker, len(WORKERS))
    agreed.begin(3, state)
    again, *decided = started(agreed, "again", 0)
    assert decided == [3, state]
    for worker in WORKERS[finished_before:]:
        agreed.finish(early, worker, len(WORKERS))
    assert (agreed.epoch, agreed.state) == (3, state)
    assert started(agreed, "again", 1) == (again, 3, state)
    for worker in WORKERS:
        agreed.finish(again, worker, len(WORKERS))
    assert (agreed.epoch, agreed.state) == (4, None)


def test_a_late_worker_begins_what_its_siblings_began() -> None:
    """Whatever was set since."""
    agreed = Agreed(3)
    first = started(agreed, "iteration", 0)
    agreed.begin(9, None)
    assert started(agreed, "iteration", 1) == first


def test_workers_that_are_restored_again_with_the_same_seeds_begin_again() -> None:
    agreed = Agreed(0)
    for round in (1, 2):
        for worker in WORKERS:
            assert started(agreed, "iteration", worker, LOADED) == (round, 3, LOADED)
        for worker in WORKERS:
            agreed.finish(round, worker, len(WORKERS))
        assert agreed.epoch == 4


def test_the_record_does_not_grow() -> None:
    """A small corpus has a hundred thousand epochs in a week."""
    agreed, sizes = Agreed(0), set()
    for epoch in range(1000, 1100):
        agreed.begin(epoch, None)
        agreed.finish(agreed.start(f"iteration {epoch}", 0, None).number, 0, 2)
        sizes.add(len(agreed.iterations))
    assert max(sizes) <= 8


# --- the record between processes -------------------------------------------------------------------------------------


def test_ranks_that_get_a_dataset_from_one_process_each_have_their_own_epochs() -> None:
    """As torch.multiprocessing.spawn and notebook launchers hand it over. Ranks that are seeded alike name their
    iterations alike."""
    shared = Shared(3)
    with shared.change() as agreed:
        agreed.start("before", 0, None)
    for _ in range(2):
        assert _forked(_rank, shared) == (3, 4)
    assert shared.agreed().epoch == 3


def _rank(shared: Shared) -> tuple[int, int]:
    first: int = _forked(_loader_worker, shared)
    return first, shared.agreed().epoch


def _loader_worker(shared: Shared) -> int:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    with shared.change() as agreed:
        iteration: LoaderIteration = agreed.start("iteration", 0, None)
        agreed.finish(iteration.number, 0, 1)
    return iteration.epoch


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
    shared = Shared(3)
    spawned = Shared.__new__(Shared)
    descriptor = SimpleNamespace(detach=lambda: os.dup(shared._descriptor))
    spawned.__setstate__({"descriptor": descriptor, "process": os.getpid() + 1})
    with spawned.change() as agreed:
        agreed.begin(4, None)
    assert (shared.agreed().epoch, spawned.agreed().epoch) == (3, 4)


def test_a_copy_is_a_record_of_its_own() -> None:
    shared = Shared(3)
    copied = pickle.loads(pickle.dumps(shared))
    with copied.change() as agreed:
        agreed.begin(4, None)
    assert (shared.agreed().epoch, copied.agreed().epoch) == (3, 4)


def test_changes_of_many_threads_and_processes_are_all_kept() -> None:
    shared = Shared(0)
    threads = [threading.Thread(target=_count_up, args=(shared,)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(3):
        _forked(_count_up_as_a_loader_worker, shared)
    for thread in threads:
        thread.join()
    assert shared.agreed().epoch == 6 * 50


def _count_up(shared: Shared) -> None:
    for _ in range(50):
        with shared.change() as agreed:
            agreed.begin(agreed.epoch + 1, None)


def _count_up_as_a_loader_worker(shared: Shared) -> None:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    _count_up(shared)


def test_a_process_that_is_killed_in_a_change_leaves_no_lock_and_the_record_as_it_was() -> None:
    shared = Shared(3)
    here, there = FORK.Pipe()

    def run() -> None:
        torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
        with shared.change() as agreed:
            agreed.begin(9, None)
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
    assert shared.agreed().epoch == 3


def _stopped(there: Any) -> Callable[..., None]:
    def write(agreed: Agreed, *, half: int) -> None:
        there.send("about to write")
        signal.pause()

    return write
