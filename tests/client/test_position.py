"""Test which samples a consumer gets, and the states that it saves."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.passes import Iteration
from v2v_client.position import Consumer, EpochPlan, LoaderShare, ResumeState, StreamIdentity
from v2v_protocol.errors import StateMismatch, UsageError

SEQUENCES = st.integers(0, 300)
RANKS = st.integers(1, 5)
BATCH = st.integers(1, 7)


def consumed(plans: list[EpochPlan]) -> list[int]:
    return [index for plan in plans for batch in range(plan.batches) for index in plan.indices(batch)]


def ranks(sequences: int, world: int, batch: int, origin: int = 0, position: int = 0) -> list[EpochPlan]:
    return [EpochPlan(sequences, world, rank, batch, origin, position) for rank in range(world)]


def test_index_of_a_local_position_is_that_of_the_definition():
    plan = EpochPlan(sequences=100, world_size=3, rank=2, batch_size=4)
    assert plan.indices(1) == tuple(position * 3 + 2 for position in (4, 5, 6, 7))


@given(SEQUENCES, RANKS, BATCH, st.integers(1, 4))
def test_ranks_and_loader_workers_take_the_prefix_once(sequences, world, batch, workers):
    plans = ranks(sequences, world, batch)
    assert len({plan.batches for plan in plans}) == 1
    everything = sorted(consumed(plans))
    assert everything == list(range(sequences - sequences % (world * batch)))
    for plan in plans:
        state = ResumeState(None, 0, 0, 0, 0, world)
        shares = [list(Iteration(1, state, worker, workers).batches(plan)) for worker in range(workers)]
        assert sorted(number for share in shares for number in share) == list(range(plan.batches))


@given(SEQUENCES, RANKS, RANKS, BATCH, BATCH, st.integers(0, 40))
def test_another_world_size_goes_on_at_a_global_batch_boundary(sequences, world, other_world, batch, other, taken):
    plans = ranks(sequences, world, batch)
    taken = min(taken, plans[0].batches)
    before = [index for plan in plans for number in range(taken) for index in plan.indices(number)]
    saved = ResumeState(None, 0, 0, 0, taken * batch, world)
    state = Consumer(other, 0, other_world).adopt(saved)
    after = consumed(ranks(sequences, other_world, other, state.origin, state.position))
    both = sorted(before + after)
    assert both == list(range(len(both)))
    assert sequences - len(both) < other_world * other


@given(SEQUENCES, RANKS, BATCH)
def test_the_state_after_a_batch_is_where_the_rest_begins(sequences, world, batch):
    consumer, stream = Consumer(batch, world - 1, world), StreamIdentity({}, "spec", "catalogue", 1, sequences)
    plan, state = EpochPlan(sequences, world, world - 1, batch), ResumeState(stream, 3, 7, 0, 0, world)
    every = [plan.indices(number) for number in range(plan.batches)]
    for number in range(1, plan.batches):
        after = consumer.after(state, plan, number - 1, 2)
        rest = consumer.plan(stream, after)
        assert [rest.indices(place) for place in range(rest.batches)] == every[number:]
        assert (after.seed, after.epoch, after.quarantine) == (3, 7, 2)
    if every:
        assert consumer.after(state, plan, plan.batches - 1, 2).place == (8, 0, 0)


def test_an_epoch_smaller_than_a_global_batch_says_so_with_the_numbers():
    with pytest.raises(UsageError, match=r"23 sequences .* 3 x 8 = 24"):
        EpochPlan(23, 3, 0, 8).require_batches()
    EpochPlan(24, 3, 0, 8).require_batches()


@pytest.mark.parametrize(
    "bad",
    [
        {"rank": 2, "world_size": 2},
        {"world_size": 0},
        {"batch_size": 0},
        {"position": 11},
        {"origin": -1},
        {"origin": 8, "position": 3},
    ],
)
def test_impossible_plans_are_refused(bad):
    with pytest.raises(UsageError):
        EpochPlan(**({"sequences": 10} | bad))


STATE = ResumeState(
    StreamIdentity({"recipe": {"gamma": 2.2}}, "s" * 64, "c" * 64, 1, 100), 3, 1, 0, 40, 2, LoaderShare(0, 2, 4, 5), 7
).to_dict()
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text() | st.integers(), inner, max_size=3),
    max_leaves=4,  # small ones have every shape, and larger ones take most of the time
)


def test_only_a_stream_with_sidecars_pins_them() -> None:
    assert "sidecars" not in STATE
    with_sidecars = STATE | {"sidecars": "d" * 32}
    assert ResumeState.from_dict(with_sidecars).to_dict() == with_sidecars
    one, other = (ResumeState.from_dict(state).stream for state in (STATE, with_sidecars))
    assert one is not None
    assert other is not None
    with pytest.raises(StateMismatch, match=r"sidecars: the state has d+, the server has ;"):
        other.require_same(one, ours="the state", theirs="the server")


@given(
    st.dictionaries(st.sampled_from([*STATE, "more"]), VALUES, max_size=2),
    st.sets(st.sampled_from(list(STATE)), max_size=2),
)
def test_a_hostile_state_is_taken_or_refused_in_words(changed: dict[str, Any], missing: set[str]) -> None:
    state = {name: value for name, value in (STATE | changed).items() if name not in missing}
    with suppress(UsageError):
        assert ResumeState.from_dict(state).to_dict().keys() == STATE.keys()


@given(VALUES)
def test_what_is_no_state_is_refused(value: Any) -> None:
    with suppress(UsageError):
        ResumeState.from_dict(value)
        raise AssertionError(value)
