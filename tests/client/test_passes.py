"""Test where a dataset stands: the table of passes, its file between processes, and states of ranks and workers."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch.utils.data._utils.worker as torch_worker

from tests.waiting import result_in_process
from v2v_client.passes import Iteration, Position, Shared, Start, Table
from v2v_client.position import Consumer, ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError

WORKERS = range(2)
LOADED = ResumeState(None, 7, 3, 0, 8, 1)


def at(epoch: int) -> Table:
    return Table(Start(ResumeState(None, 7, epoch, 0, 0, 1)))


def begin(table: Table, name: str, worker: int, loaded: ResumeState | None = None) -> int:
    return table.begin(name, worker, len(WORKERS), loaded)[0]


def test_the_epoch_ends_with_the_last_loader_worker() -> None:
    table = at(3)
    for epoch in (3, 4):
        (number,) = {begin(table, f"pass {epoch}", worker) for worker in WORKERS}
        for worker in WORKERS:
            assert table.start.state.place == (epoch, 0, 0)
            for _ in range(2):  # a second time counts once
                table.deliver(number, worker, finished=True)
    assert table.start.state.place == (5, 0, 0)


@pytest.mark.parametrize("finished_before", [0, 1])
@pytest.mark.parametrize("state", [None, LOADED], ids=["set_epoch", "a loaded state"])
def test_workers_that_finish_what_was_left_early_do_not_end_the_epoch_that_was_set(
    state: ResumeState | None, finished_before: int
) -> None:
    """It is the same epoch again, as a validation repeats it; they had prefetched its last batches."""
    table = at(3)
    (early,) = {begin(table, "early", worker) for worker in WORKERS}
    for worker in WORKERS[:finished_before]:
        table.deliver(early, worker, finished=True)
    if state is None:
        table.set_epoch(3)
    else:
        table.load(state)
    start = table.start.state
    again = begin(table, "again", 0)
    assert table.passes[again].start.state == start
    for worker in WORKERS[finished_before:]:
        table.deliver(early, worker, finished=True)
    assert table.start.state == start
    assert begin(table, "again", 1) == again
    for worker in WORKERS:
        table.deliver(again, worker, finished=True)
    assert table.start.state.place == (4, 0, 0)


def test_a_late_worker_begins_what_its_siblings_began() -> None:
    """Even if another epoch was set since."""
    table = at(3)
    first = begin(table, "pass", 0)
    table.set_epoch(9)
    assert begin(table, "pass", 1) == first


def test_workers_that_are_restored_again_with_the_same_seeds_begin_again() -> None:
    table = at(0)
    for number in (1, 2):
        for worker in WORKERS:
            assert begin(table, "pass", worker, LOADED) == number
            assert table.passes[number].start.state == LOADED
        for worker in WORKERS:
            table.deliver(number, worker, finished=True)
        assert table.start.state.place == (4, 0, 0)


def test_the_table_does_not_grow() -> None:
    """A small corpus has a hundred thousand epochs in a week."""
    table, sizes = at(0), set()
    for epoch in range(1000, 1100):
        table.set_epoch(epoch)
        table.deliver(begin(table, f"pass {epoch}", 0), 0, finished=True)
        sizes.add(len(table.passes))
    assert max(sizes) <= 8


def test_a_pass_that_is_no_longer_remembered_changes_nothing() -> None:
    table = at(0)
    first = begin(table, "pass", 0)
    for epoch in range(10):
        begin(table, f"later {epoch}", 0)
    table.deliver(first, 0, used=True, finished=True)
    assert (table.start.state.place, first in table.passes) == ((0, 0, 0), False)


FORK = multiprocessing.get_context("fork")
TABLE = Table(Start(ResumeState(None, 7, 3, 0, 0, 1)))


def test_ranks_that_get_a_dataset_from_one_process_each_have_their_own_epochs() -> None:
    """torch.multiprocessing.spawn and notebook launchers do this. Ranks that are seeded alike name their
    passes alike."""
    shared = Shared(TABLE)
    with shared.change() as table:
        table.begin("before", 0, 1)
    for _ in range(2):
        assert result_in_process(_rank, shared) == (3, 4)
    assert shared.read().start.state.epoch == 3


def _rank(shared: Shared) -> tuple[int, int]:
    first: int = result_in_process(_loader_worker, shared)
    return first, shared.read().start.state.epoch


def _loader_worker(shared: Shared) -> int:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    with shared.change() as table:
        number, _ = table.begin("pass", 0, 1)
        epoch = table.passes[number].start.state.epoch
        table.deliver(number, 0, finished=True)
    return epoch


def test_a_rank_that_is_spawned_has_its_own_epochs() -> None:
    """Its loader workers, which are forked or spawned in turn, have those of the rank."""
    shared = Shared(TABLE)
    assert result_in_process(_rank, shared, method="spawn") == (3, 4)
    assert shared.read().start.state.epoch == 3


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
    assert os.fstat(shared._descriptor).st_size % (1 << 30) < 80 * len(pickle.dumps(TABLE))
    assert shared.read().start.state.epoch == 5


def test_changes_of_many_threads_and_processes_are_all_kept() -> None:
    shared = Shared(TABLE)
    threads = [threading.Thread(target=_count_up, args=(shared,)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(3):
        result_in_process(_count_up_as_a_loader_worker, shared)
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


STREAM = StreamIdentity({}, "spec", "catalogue", 1, sequences=24)
ALONE = Consumer(batch_size=4, rank=0, world_size=1)
HALF = Consumer(batch_size=4, rank=1, world_size=2)
BEGINNING = ResumeState(STREAM, 3, 7, 0, 0, 1)


@pytest.fixture(autouse=True)
def no_worker() -> Iterator[None]:
    yield
    torch_worker._worker_info = None


def become_worker(worker: int, workers: int) -> None:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=worker, num_workers=workers, seed=50 + worker, dataset=None)


def after(batch: int) -> ResumeState:
    return ALONE.after(BEGINNING, ALONE.plan(STREAM, BEGINNING), batch, None)


def test_another_world_size_takes_up_what_no_rank_consumed() -> None:
    taken = HALF.adopt(after(0))
    assert (taken.origin, taken.position, taken.world_size) == (4, 0, 2)
    assert HALF.plan(STREAM, taken).indices(0) == (5, 7, 9, 11)


@pytest.mark.parametrize("named", [False, True])
def test_a_rest_without_a_global_batch_is_skipped_unless_its_epoch_is_named(named: bool) -> None:
    position = Position(3, 0)
    position.load(after(4), HALF)
    if named:
        position.set_epoch(7)
    begun = position.begin(HALF)
    assert begun.state.epoch == (7 if named else 8)
    assert len(begun.batches(HALF.plan(STREAM, begun.state))) == (0 if named else 3)
    position.finish(begun)
    assert position.start(HALF).place == (8 if named else 9, 0, 0)


@pytest.mark.parametrize(
    ("here", "consumer"),
    [(None, ALONE), ((0, 2), ALONE), ((1, 3), ALONE), ((1, 2), Consumer(5, 0, 1)), ((1, 2), Consumer(4, 0, 2))],
    ids=str,
)
def test_a_share_belongs_to_one_loader_worker(here: tuple[int, int] | None, consumer: Consumer) -> None:
    state = Iteration(1, BEGINNING, worker=1, workers=2, in_loader=True).after(ALONE, 2, None)
    become_worker(1, 2)
    Position(3, 0).load(state, ALONE)
    torch_worker._worker_info = None
    if here is not None:
        become_worker(*here)
    Position(3, 0).load(BEGINNING, ALONE)
    with pytest.raises(UsageError, match=r"loader worker 1 of 2 \(batch_size 4, world size 1\)"):
        Position(3, 0).load(state, consumer)


def test_only_the_newest_iteration_affects_the_position() -> None:
    position = Position(3, 0)
    older, newer = position.begin(ALONE), position.begin(ALONE)
    first, second = after(0), after(1)
    position.reached(newer, ALONE, first, last=False)
    position.reached(older, ALONE, second, last=True)
    position.finish(older)
    assert position.state(ALONE) == first
    position.finish(newer)
    assert position.state(ALONE) == ResumeState(None, 3, 1, 0, 0, 1)


def test_a_shallow_copy_moves_on_by_itself() -> None:
    position = Position(3, 0)
    begun = position.begin(ALONE)
    position.reached(begun, ALONE, after(2), last=False)
    other = copy.copy(position)
    other.begin(ALONE)
    assert position.state(ALONE) == after(2)
    assert other.state(ALONE) == ResumeState(None, 3, 0, 0, 0, 1)


def test_the_world_size_is_that_of_the_consumer() -> None:
    """The process group may be set up after the dataset was created."""
    position = Position(3, 0)
    begun = position.begin(HALF)
    assert begun.state.world_size == position.state(HALF).world_size == 2
    saved = HALF.after(begun.state, HALF.plan(STREAM, begun.state), 0, None)
    assert (saved.position, saved.world_size) == (4, 2)


def test_an_earlier_epoch_than_the_loaded_one_is_refused_until_a_pass_begins() -> None:
    """Loops that count epochs from 0 after a resume would train on the same samples again."""
    position = Position(3, 0)
    position.load(after(0), ALONE)
    with pytest.raises(UsageError, match=r"set_epoch\(0\): the loaded state is in epoch 7.*dataset\.epoch"):
        position.set_epoch(0)
    assert position.state(ALONE) == after(0)
    position.set_epoch(7)
    assert position.state(ALONE) == after(0)
    position.load(after(0), ALONE)
    position.begin(ALONE)
    position.set_epoch(0)
    assert position.start(ALONE).place == (0, 0, 0)


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("batches", [1, 2])
def test_passes_that_are_left_early_again_and_again_are_repeated_with_one_warning(workers: int, batches: int) -> None:
    """A loop may take few batches: fewer than its loader workers prefetch, so that they look like one that inspects."""
    position, warned = Position(3, 0), []
    copies = [copy.copy(position) for _ in range(workers)] or [position]
    for _ in range(4):
        repeats = []
        for worker, own in enumerate(copies):
            if workers:
                become_worker(worker, workers)
            begun = own.begin(ALONE)
            repeats.append(begun.repeats)
            for count in range(1, batches + 1):
                own.reached(begun, ALONE, after(count), last=False)
        warned.append(sum(repeats))
    assert warned == ([0, 1, 0, 0] if batches == 2 and not workers else [0, 0, 1, 0])


def test_loader_workers_together_count_the_batches_of_a_pass() -> None:
    """Two workers prefetch two batches each, and make one for each batch that the loop takes."""
    position = Position(3, 0)
    copies = [copy.copy(position) for _ in range(2)]
    for taken, repeats in ((5, False), (6, True)):
        position.set_epoch(taken)
        for delivered, expected in ((taken, False), (0, repeats)):
            for worker, own in enumerate(copies):
                become_worker(worker, 2)
                begun = own.begin(ALONE)
                assert begun.repeats == (expected and worker == 0)
                for count in range(1, (delivered + 1 - worker) // 2 + 1):
                    own.reached(begun, ALONE, after(count), last=False)


def test_a_restored_loader_that_is_left_early_continues_where_it_was_restored() -> None:
    position = Position(3, 0)
    states = [Iteration(1, BEGINNING, worker, 2, True).after(ALONE, 2 - worker, None) for worker in range(2)]
    for restored in (True, False):  # the second pass is made by new loader workers, which load nothing
        for worker, state in enumerate(states):
            own = copy.copy(position)
            become_worker(worker, 2)
            if restored:
                own.load(state, ALONE)
            else:
                own._iterations = 1
            begun = own.begin(ALONE)
            assert list(begun.batches(ALONE.plan(STREAM, begun.state))) == ([4] if worker == 0 else [3, 5])
            assert own.state(ALONE).place == (7, 0, 0)
