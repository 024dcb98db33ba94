"""States of one rank and of its loader workers, without a server."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest

from v2v_client.position.plan import Consumer
from v2v_client.position.position import Iteration, Position
from v2v_client.position.state import ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError

STREAM = StreamIdentity({}, "spec", "catalogue", 1, sequences=24)
ALONE = Consumer(seed=3, batch_size=4, rank=0, world_size=1)
HALF = Consumer(seed=3, batch_size=4, rank=1, world_size=2)


def test_the_state_after_a_batch_is_where_the_rest_begins() -> None:
    plan = ALONE.plan(STREAM, None)
    every = [plan.indices(batch) for batch in range(plan.batches)]
    for batch in range(plan.batches - 1):
        state = ALONE.after(STREAM, 7, plan, batch, quarantine=2)
        rest = ALONE.plan(STREAM, state)
        assert [rest.indices(number) for number in range(rest.batches)] == every[batch + 1 :]
        assert (state.seed, state.epoch, state.quarantine) == (3, 7, 2)
    assert ALONE.after(STREAM, 7, plan, plan.batches - 1, quarantine=2) == ALONE.beginning(STREAM, 8)


def test_another_world_size_takes_up_what_nobody_consumed() -> None:
    saved = ALONE.after(STREAM, 0, ALONE.plan(STREAM, None), 0, None)
    taken = HALF.taken_up(saved)
    assert (taken.origin, taken.position, taken.world_size) == (4, 0, 2)
    assert HALF.plan(STREAM, taken).indices(0) == (5, 7, 9, 11)


def test_a_rest_without_a_global_batch_is_the_next_epoch() -> None:
    saved = ALONE.after(STREAM, 0, ALONE.plan(STREAM, None), 4, None)
    assert HALF.taken_up(saved) == HALF.beginning(STREAM, 1)


@pytest.mark.parametrize(
    "here", [None, SimpleNamespace(id=0, num_workers=2), SimpleNamespace(id=1, num_workers=3)], ids=str
)
def test_a_share_belongs_to_one_loader_worker(here: object) -> None:
    state = Iteration(1, 0, None, shared=1, worker=1, workers=2).after(ALONE, STREAM, done=2)
    ALONE.require_share(state, SimpleNamespace(id=1, num_workers=2))
    ALONE.require_share(ALONE.beginning(STREAM, 0), here)
    with pytest.raises(UsageError, match="loader worker 1 of 2"):
        ALONE.require_share(state, here)


def test_only_the_newest_iteration_says_where_we_are() -> None:
    position = Position(0)
    older, newer = position.begin(ALONE), position.begin(ALONE)
    first, second = (ALONE.after(STREAM, 0, ALONE.plan(STREAM, None), batch, None) for batch in (0, 1))
    position.reached(newer, first, count=1, last=False)
    position.reached(older, second, count=1, last=True)
    position.finish(older, ALONE)
    assert position.state(ALONE) == first
    position.finish(newer, ALONE)
    assert position.state(ALONE) == ALONE.beginning(None, 1)


def test_a_shallow_copy_moves_on_by_itself() -> None:
    position = Position(0)
    begun = position.begin(ALONE)
    here: ResumeState = ALONE.after(STREAM, 0, ALONE.plan(STREAM, None), 2, None)
    position.reached(begun, here, count=1, last=False)
    other = copy.copy(position)
    other.begin(ALONE)
    assert position.state(ALONE) == here
    assert other.state(ALONE) == ALONE.beginning(None, 0)
