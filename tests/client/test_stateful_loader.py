"""Test a dataset with the calls of torchdata's StatefulDataLoader, made by hand.

In every loader worker it loads that worker's own state, creates an iterator, and requests the state after each batch
and after the end. If a loader's state says that its epoch was finished, the loader creates such workers, drops them
unused, and creates new ones from the dataset of the main process.
"""

import multiprocessing
import os
from dataclasses import dataclass
from typing import Any

import pytest
import torch.utils.data._utils.worker as torch_worker

from tests.client.fake_server import FakeServer
from v2v_client import RepeatedSamplesWarning, UsageError, V2VStreamDataset

WORKERS = 2
FORK = multiprocessing.get_context("fork")


@dataclass
class Outcome:
    """Hold the outcome of one loader worker: each batch's indices and state, and the state after the end."""

    batches: list[tuple[int, tuple[int, ...], dict[str, Any]]]
    ended: dict[str, Any] | None
    error: str = ""


def _worker(dataset, worker, workers, seed, state, most, connection):
    torch_worker._worker_info = torch_worker.WorkerInfo(
        id=worker, num_workers=workers, seed=seed + worker, dataset=dataset
    )
    outcome = Outcome([], None)
    try:
        if state is not None:
            dataset.load_state_dict(state)
        batches = iter(dataset)
        dataset.state_dict()
        connection.send("ready")
        connection.recv()
        for _ in range(most):
            batch = next(batches, None)
            if batch is None:
                outcome.ended = dataset.state_dict()
                break
            outcome.batches.append((batch.epoch, batch.indices, dataset.state_dict()))
    except (UsageError, RepeatedSamplesWarning) as error:
        outcome.error = str(error)
    connection.send(outcome)
    connection.close()
    os._exit(0)


def run(dataset, seed, states=(None, None), most=(99, 99)):
    """Run one iteration of a loader and return its workers' outcomes. All create their iterators before any reads."""
    started = []
    for worker in range(WORKERS):
        here, there = FORK.Pipe()
        process = FORK.Process(
            target=_worker, args=(dataset, worker, WORKERS, seed, states[worker], most[worker], there)
        )
        process.start()
        there.close()
        started.append((process, here))
    outcomes = []
    ready = [here.recv() for _, here in started]
    for (_, here), said in zip(started, ready, strict=True):
        if said == "ready":
            here.send("go")
    for (process, here), said in zip(started, ready, strict=True):
        outcomes.append(here.recv() if said == "ready" else said)
        process.join()
        process.close()
        here.close()
    return outcomes


def in_order(outcomes):
    """Return the batches in the training loop's order: one of each worker in turn."""
    rows = [[(epoch, indices) for epoch, indices, _ in outcome.batches] for outcome in outcomes]
    longest = max(len(row) for row in rows)
    return [row[turn] for turn in range(longest) for row in rows if turn < len(row)]


def whole(epoch, first=0):
    return [(epoch, tuple(range(4 * batch, 4 * batch + 4))) for batch in range(first, 5)]


@pytest.fixture
def server():
    with FakeServer(sequences=23, credit=8) as running:
        yield running


def dataset(server, **options):
    return V2VStreamDataset(server.address, **({"batch_size": 4, "timeout_seconds": 60.0} | options))


def test_each_loader_worker_resumes_at_its_own_position(server):
    first = run(dataset(server), 100, most=(2, 1))
    states = [outcome.batches[-1][2] for outcome in first]
    rest = run(dataset(server), 200, states)
    # Worker 0 delivered batches 0 and 2, worker 1 batch 1.
    assert [row[:2] for row in rest[0].batches] == [whole(0)[4]]
    assert [row[:2] for row in rest[1].batches] == [whole(0)[3]]


def test_the_initial_state_of_a_loader_worker_starts_the_epoch(server):
    stream = dataset(server)
    begun = run(stream, 100, most=(0, 0))
    assert in_order(run(stream, 200)) == whole(0)
    assert begun[0].batches == []


def test_states_after_the_end_start_a_whole_next_epoch(server):
    first = run(dataset(server), 100)
    assert in_order(first) == whole(0)
    assert in_order(run(dataset(server), 200, [outcome.ended for outcome in first])) == whole(1)


def test_a_restored_finished_loader_starts_a_whole_next_epoch(server):
    first = run(dataset(server), 100)
    states = [outcome.batches[-1][2] for outcome in first]
    restored = dataset(server)
    dropped = run(restored, 200, states, most=(0, 0))
    assert [outcome.batches for outcome in dropped] == [[], []]
    assert in_order(run(restored, 300)) == whole(1)


def test_a_restored_epoch_with_no_batches_left_yields_no_batches(server):
    first = run(dataset(server), 100)
    states = [outcome.batches[-1][2] for outcome in first]
    restored = dataset(server)
    assert [outcome.batches for outcome in run(restored, 200, states)] == [[], []]
    assert in_order(run(restored, 300)) == whole(1)


def test_a_late_loader_worker_starts_the_epoch_of_the_others(server):
    """All workers of an iteration deliver the same epoch, even if one finishes it before another starts."""
    stream = dataset(server, batch_size=20)  # one batch: worker 1 has none, and is done at once
    for epoch in (0, 1):
        outcomes = run(stream, 100 + epoch)
        assert in_order(outcomes) == [(epoch, tuple(range(20)))]


def test_the_state_of_a_loader_worker_is_refused_elsewhere(server):
    state = run(dataset(server), 100, most=(1, 1))[1].batches[-1][2]
    with pytest.raises(UsageError, match=r"loader worker 1 of 2 .* Batch\.resume_state"):
        dataset(server).load_state_dict(state)
    swapped = run(dataset(server), 200, [state, state])
    assert "loader worker 1 of 2" in swapped[0].error
    other_batch = run(dataset(server, batch_size=5), 300, [None, state])
    assert "batch_size 4" in other_batch[1].error


def test_loader_workers_resume_from_the_state_of_a_rank(server):
    batches = iter(dataset(server))
    state = [next(batches).resume_state for _ in range(2)][-1]
    assert in_order(run(dataset(server), 100, [state, state])) == whole(0, first=2)


def test_a_state_loaded_twice_starts_the_iteration_at_its_position(server):
    """A trainer does this after two non-finite losses. The seeds are in the loader's state, so they are equal."""
    stream = dataset(server)
    states = [outcome.batches[-1][2] for outcome in run(stream, 100, most=(2, 1))]
    for _ in range(2):
        assert in_order(run(stream, 100, states)) == [whole(0)[4], whole(0)[3]]
        assert in_order(run(stream, 200)) == whole(1)


def test_short_passes_that_are_left_early_warn_at_the_third(server):
    """Each worker makes no more batches than it prefetches, so two passes could be a look at the data."""
    stream = dataset(server)
    errors = [[outcome.error for outcome in run(stream, 100 * turn, most=(1, 1))] for turn in range(3)]
    assert errors[:2] == [["", ""], ["", ""]]
    assert sorted("set_epoch" in error for error in errors[2]) == [False, True]  # the worker that is first says so
