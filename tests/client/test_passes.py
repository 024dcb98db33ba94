"""Test the table of passes, in the orders in which processes may change it."""

from __future__ import annotations

import pytest

from v2v_client.passes import Start, Table
from v2v_client.position import ResumeState

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
