"""Test the record of passes, in the orders in which processes may change it."""

from __future__ import annotations

import pytest

from v2v_client.position.record import Pass, Record, Start
from v2v_client.position.state import ResumeState

WORKERS = range(2)
LOADED = ResumeState(None, 7, 3, 0, 8, 1)


def at(epoch: int) -> Record:
    return Record(Start(ResumeState(None, 7, epoch, 0, 0, 1)))


def begun(record: Record, name: str, worker: int, loaded: ResumeState | None = None) -> Pass:
    return record.begin(name, worker, len(WORKERS), loaded)[0]


def test_the_epoch_ends_with_the_last_loader_worker() -> None:
    record = at(3)
    for epoch in (3, 4):
        (number,) = {begun(record, f"pass {epoch}", worker).number for worker in WORKERS}
        for worker in WORKERS:
            assert record.start.state.place == (epoch, 0, 0)
            for _ in range(2):  # a second time counts once
                record.finish(number, worker)
    assert record.start.state.place == (5, 0, 0)


@pytest.mark.parametrize("finished_before", [0, 1])
@pytest.mark.parametrize("state", [None, LOADED], ids=["set_epoch", "a loaded state"])
def test_workers_that_finish_what_was_left_early_do_not_end_the_epoch_that_was_set(
    state: ResumeState | None, finished_before: int
) -> None:
    """It is the same epoch again, as a validation repeats it; they had prefetched its last batches."""
    record = at(3)
    (early,) = {begun(record, "early", worker).number for worker in WORKERS}
    for worker in WORKERS[:finished_before]:
        record.finish(early, worker)
    if state is None:
        record.set_epoch(3)
    else:
        record.load(state)
    start = record.start.state
    again = begun(record, "again", 0)
    assert again.start.state == start
    for worker in WORKERS[finished_before:]:
        record.finish(early, worker)
    assert record.start.state == start
    assert begun(record, "again", 1) is again
    for worker in WORKERS:
        record.finish(again.number, worker)
    assert record.start.state.place == (4, 0, 0)


def test_a_late_worker_begins_what_its_siblings_began() -> None:
    """Even if another epoch was set since."""
    record = at(3)
    first = begun(record, "pass", 0)
    record.set_epoch(9)
    assert begun(record, "pass", 1) is first


def test_workers_that_are_restored_again_with_the_same_seeds_begin_again() -> None:
    record = at(0)
    for number in (1, 2):
        for worker in WORKERS:
            item = begun(record, "pass", worker, LOADED)
            assert (item.number, item.start.state) == (number, LOADED)
        for worker in WORKERS:
            record.finish(number, worker)
        assert record.start.state.place == (4, 0, 0)


def test_the_record_does_not_grow() -> None:
    """A small corpus has a hundred thousand epochs in a week."""
    record, sizes = at(0), set()
    for epoch in range(1000, 1100):
        record.set_epoch(epoch)
        record.finish(begun(record, f"pass {epoch}", 0).number, 0)
        sizes.add(len(record.passes))
    assert max(sizes) <= 8
