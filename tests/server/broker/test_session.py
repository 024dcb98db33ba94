"""Sessions: credit, duplicates, and the fair sharing of worker time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import cast

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from v2v_protocol.errors import LimitExceeded
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import MOST_IN_FLIGHT_BYTES
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import LeaseBook, Request
from v2v_server.broker.session import Session, Sessions
from v2v_server.schedule import Schedule

COUNT = 1000


class Counted:
    """Stands in for a schedule: sessions only ask how long an epoch is, and which indices share a clip."""

    count = COUNT

    def place(self, index: int) -> int:
        return index


def session(identity: bytes = b"a", credit: int = 8, last_heard: float = 0.0) -> Session:
    schedule = cast(Schedule, Counted())
    return Session(
        identity, StreamSpec(), 0, ("voxels",), 4, schedule, credit, Liveness(last_heard, gone_seconds=600.0)
    )


def opened(*sessions: Session) -> Sessions:
    table = Sessions(LeaseBook(60.0))
    for each in sessions:
        table.open(each)
    return table


def take(sessions: Sessions) -> Request:
    request = sessions.next_request()
    if request is None:
        raise AssertionError("no request waits")
    return request


# --- what is not read yet ---------------------------------------------------------------------------------------------


def test_samples_that_are_not_read_yet_count_against_the_credit() -> None:
    a, b = session(b"a", credit=8), session(b"b", credit=8)
    sessions = opened(a, b)
    for each in (a, b):
        sessions.want(each, 0, range(8))
    sample = sum(a.form.sizes)
    assert sessions.room(a) == 8
    for unread, room in ((1, 8), (sample, 8), (3 * sample + 1000, 6), (9 * sample, 0), (20 * sample, -11), (0, 8)):
        assert sessions.set_in_flight(b"a", unread) is (None if room < 8 or unread else a)
        assert sessions.room(a) == room
    take(sessions), take(sessions)
    assert sessions.room(a) == sessions.room(b) == 7


def test_a_consumer_that_does_not_read_is_passed_over_until_it_does() -> None:
    a, b = session(b"a", credit=2), session(b"b", credit=2)
    sessions = opened(a, b)
    for each in (a, b):
        sessions.want(each, 0, [0, 1])
    sessions.set_in_flight(b"a", 3 * sum(a.form.sizes))
    assert [take(sessions).session for _ in range(2)] == [b"b", b"b"]
    assert sessions.next_request() is None
    assert sessions.set_in_flight(b"a", 0) is a
    assert [take(sessions).session for _ in range(2)] == [b"a", b"a"]


def test_what_is_in_flight_outlives_a_hello() -> None:
    """It lies in the same connection's queue, whatever the consumer says."""
    sessions = opened(session(b"a"))
    sessions.set_in_flight(b"a", 1 << 40)
    sessions.open(again := session(b"a"))
    sessions.want(again, 0, [0])
    assert sessions.next_request() is None


@given(st.integers(1, 400))
def test_all_consumers_that_do_not_read_share_one_limit(count: int) -> None:
    """Each may hold one sample, and the next ones as long as all of them hold less than the limit."""
    everyone = [session(b"%d" % number, credit=400) for number in range(count)]
    sessions, sample = opened(*everyone), sum(everyone[0].form.sizes)
    held = dict.fromkeys(everyone_names := [each.identity for each in everyone], 0)
    for identity in everyone_names:
        held[identity] = sample
        sessions.set_in_flight(identity, sample)
    while growing := [each for each in everyone if held[each.identity] < 100 * sample and sessions.room(each) > 0]:
        for each in growing:
            held[each.identity] += sample
            sessions.set_in_flight(each.identity, held[each.identity])
    assert sum(held.values()) <= max(MOST_IN_FLIGHT_BYTES, count * sample) + count * sample
    assert all(held.values())


# --- asking -----------------------------------------------------------------------------------------------------------


def test_samples_are_handed_out_in_the_order_asked() -> None:
    a = session()
    sessions = opened(a)
    sessions.want(a, 3, [5, 2, 9])
    assert [take(sessions).index for _ in range(3)] == [5, 2, 9]
    assert sessions.next_request() is None


def test_what_is_waited_for_already_is_not_made_twice() -> None:
    a = session()
    sessions = opened(a)
    sessions.want(a, 0, [1, 1, 2])
    taken = take(sessions)
    sessions.want(a, 0, [2, 1, 3, 3])
    assert [request.index for request in a.waiting] == [2, 3]
    sessions.want(a, 1, [1])
    assert len(a.unanswered) == 4
    assert sessions.mark_answered(taken, 0.0)
    sessions.want(a, 0, [1])
    assert [(request.epoch, request.index) for request in a.waiting] == [(0, 2), (0, 3), (1, 1), (0, 1)]


def test_a_request_beyond_the_credit_takes_nothing() -> None:
    a = session(credit=4)
    sessions = opened(a)
    sessions.want(a, 0, [0, 1, 2])
    with pytest.raises(LimitExceeded, match="2 more samples asked while 3 are unanswered; the credit is 4"):
        sessions.want(a, 0, [3, 4])
    assert len(a.waiting) == len(a.unanswered) == 3
    # Those it is waiting for cost nothing more.
    sessions.want(a, 0, [0, 1, 2, 3])
    assert len(a.unanswered) == 4


def test_a_request_outside_the_epoch_takes_nothing() -> None:
    a = session()
    sessions = opened(a)
    with pytest.raises(IndexError, match=f"index {COUNT} of an epoch of {COUNT} sequences"):
        sessions.want(a, 0, [0, COUNT])
    assert not a.waiting
    assert not a.unanswered
    sessions.want(a, 0, [COUNT - 1])


def test_credit_is_free_again_after_the_answer_and_not_before() -> None:
    a = session(credit=1)
    sessions = opened(a)
    sessions.want(a, 0, [0])
    request = take(sessions)
    with pytest.raises(LimitExceeded):
        sessions.want(a, 0, [1])
    sessions.put_back(request)
    with pytest.raises(LimitExceeded):
        sessions.want(a, 0, [1])
    assert take(sessions) == request
    assert sessions.mark_answered(request, 0.1)
    assert not sessions.mark_answered(request, 0.1)
    sessions.want(a, 0, [1])


# --- coming and going -------------------------------------------------------------------------------------------------


def test_a_returned_task_is_next() -> None:
    a = session()
    sessions = opened(a)
    sessions.want(a, 0, [0, 1, 2])
    first = take(sessions)
    sessions.put_back(first)
    assert take(sessions) == first


def test_nothing_comes_back_to_a_session_that_is_gone_or_was_opened_again() -> None:
    old = session()
    sessions = opened(old)
    sessions.want(old, 0, [0])
    request = take(sessions)
    sessions.forget(b"a")
    sessions.forget(b"a")
    assert sessions.get(b"a") is None
    assert not sessions.mark_answered(request, 1.0)
    sessions.put_back(request)
    assert sessions.next_request() is None
    new = session()
    sessions.open(new)
    sessions.put_back(request)
    assert not sessions.mark_answered(request, 1.0)
    assert sessions.next_request() is None
    assert len(sessions) == 1


def test_opening_again_replaces() -> None:
    sessions = opened(session(), session(), session(b"b"))
    assert len(sessions) == 2
    assert sorted(each.identity for each in sessions) == [b"a", b"b"]


def test_the_silent_are_idle() -> None:
    a, b = session(b"a", last_heard=0.0), session(b"b", last_heard=100.0)
    sessions = opened(a, b)
    assert sessions.idle(599.5) == []
    assert sessions.idle(600.0) == [b"a"]
    b.liveness.mark_heard(0.0)
    assert sorted(sessions.idle(601.0)) == [b"a", b"b"]


# --- sharing ----------------------------------------------------------------------------------------------------------


def serve(
    costs: Mapping[bytes, float], samples: int, workers: int = 1, credits: Mapping[bytes, int] | None = None
) -> Counter[bytes]:
    """Serves consumers that always ask for as much as they may, ``workers`` samples being in work at a time.

    Returns:
        samples that each consumer got.
    """
    sessions = opened(*(session(identity, (credits or {}).get(identity, 16)) for identity in costs))
    asked = dict.fromkeys(costs, 0)
    in_work: list[Request] = []
    got: Counter[bytes] = Counter()
    for _ in range(samples):
        for each in sessions:
            room = each.credit - len(each.unanswered)
            first = asked[each.identity]
            sessions.want(each, 0, [(first + number) % COUNT for number in range(room)])
            asked[each.identity] += room
        while len(in_work) < workers:
            in_work.append(take(sessions))
        request = in_work.pop(0)
        assert sessions.mark_answered(request, costs[request.session])
        got[request.session] += 1
    return got


@pytest.mark.parametrize("workers", [1, 4])
def test_equals_get_equal_shares(workers: int) -> None:
    got = serve({b"a": 0.1, b"b": 0.1, b"c": 0.1}, 900, workers)
    assert max(got.values()) - min(got.values()) <= workers


@pytest.mark.parametrize("workers", [1, 4])
@pytest.mark.parametrize("unit", [0.001, 0.1, 7.0])
def test_tenfold_work_gets_a_tenth_of_the_samples(workers: int, unit: float) -> None:
    got = serve({b"cheap": unit, b"dear": 10 * unit}, 2200, workers)
    assert got[b"cheap"] / got[b"dear"] == pytest.approx(10.0, rel=0.1)


@given(
    st.dictionaries(st.binary(min_size=1, max_size=2), st.sampled_from((0.02, 0.1, 0.5, 3.0)), min_size=1, max_size=5)
)
@settings(max_examples=25, deadline=None)
def test_no_session_starves_and_time_is_shared_evenly(costs: dict[bytes, float]) -> None:
    samples = 600
    got = serve(costs, samples)
    assert set(got) == set(costs)
    spent = {identity: got[identity] * costs[identity] for identity in costs}
    # Deficit round robin keeps accounts level up to one sample each and the quantum.
    assert max(spent.values()) - min(spent.values()) <= 2 * max(costs.values()) + 0.1


def test_turns_alternate_before_any_cost_is_known() -> None:
    """All workers are free and nothing is finished yet: the first to ask must not get them all."""
    sessions = opened(*(session(identity) for identity in (b"a", b"b", b"c")))
    for each in sessions:
        sessions.want(each, 0, range(4))
    taken = [take(sessions).session for _ in range(12)]
    assert [Counter(taken[first : first + 3]) for first in (0, 3, 6, 9)] == [Counter((b"a", b"b", b"c"))] * 4


def test_a_consumer_in_debt_that_waits_alone_is_served_at_once() -> None:
    a, b = session(b"a"), session(b"b")
    sessions = opened(a, b)
    sessions.want(a, 0, [0, 1, 2])
    for cost in (1e-9, 0.05, 1e6):
        request = take(sessions)
        assert request.session == b"a"
        sessions.want(a, 1, [request.index])
        assert sessions.mark_answered(request, cost)


def test_the_largest_debt_that_is_accepted_does_not_stall() -> None:
    a, b = session(b"a", credit=4), session(b"b", credit=4)
    sessions = opened(a, b)
    sessions.want(a, 0, [0, 1, 2, 3])
    for _ in range(3):
        assert sessions.mark_answered(take(sessions), 86_400.0)
    assert take(sessions).index == 3


@pytest.mark.parametrize("credit", [1, 2])
def test_asking_for_one_sample_at_a_time_is_not_free_of_charge(credit: int) -> None:
    """A consumer whose queue runs empty with every answer still pays for it, and starves no other."""
    got = serve({b"cheap": 0.1, b"dear": 1.0}, 2200, credits={b"dear": credit})
    assert got[b"cheap"] / got[b"dear"] == pytest.approx(10.0, rel=0.1)


def test_a_debt_outlives_the_session() -> None:
    sessions = opened(session(b"a"))
    sessions.queue.charge(b"a", 3.0)
    sessions.open(session(b"a"))
    sessions.forget(b"a")
    sessions.queue.charge(b"a", 1.0)  # for what was under way
    again = session(b"a")
    sessions.open(again)
    assert sessions.queue.balance_ns(b"a") == -4_000_000_000
    sessions.forget(b"a")
    for number in range(5000):
        sessions.queue.charge(str(number).encode(), 1.0)
    assert len(sessions.queue.debts_ns) < 5000


def test_nothing_is_saved_up_while_idle() -> None:
    a, b = session(b"a"), session(b"b")
    sessions = opened(a, b)
    sessions.queue.charge(b"a", -1000.0)
    sessions.want(a, 0, [0])
    assert sessions.mark_answered(take(sessions), 0.1)
    assert sessions.queue.balance_ns(b"a") == 0


# --- any order --------------------------------------------------------------------------------------------------------


class SessionModel(RuleBasedStateMachine):
    """Every unanswered index is in exactly one place: in its session's queue, or in work."""

    identities = st.sampled_from((b"a", b"b", b"c"))

    def __init__(self) -> None:
        super().__init__()
        self.sessions = Sessions(LeaseBook(60.0))
        self.in_work: list[tuple[Request, Session]] = []

    @rule(identity=identities, credit=st.integers(1, 6))
    def open(self, identity: bytes, credit: int) -> None:
        self.sessions.open(session(identity, credit))

    @rule(identity=identities)
    def forget(self, identity: bytes) -> None:
        self.sessions.forget(identity)

    @rule(
        identity=identities,
        epoch=st.integers(0, 1),
        indices=st.lists(st.integers(0, 9) | st.just(COUNT), max_size=5),
    )
    def want(self, identity: bytes, epoch: int, indices: list[int]) -> None:
        asking = self.sessions.get(identity)
        if asking is None:
            return
        before, queue = set(asking.unanswered), list(asking.waiting)
        after = before | {(epoch, index) for index in indices}
        if COUNT in indices or len(after) > asking.credit:
            with pytest.raises((LimitExceeded, IndexError)):
                self.sessions.want(asking, epoch, indices)
            assert (asking.unanswered, list(asking.waiting)) == (before, queue)
        else:
            self.sessions.want(asking, epoch, indices)
            assert asking.unanswered == after
            assert len(asking.waiting) == len(queue) + len(after) - len(before)

    @rule()
    def next_request(self) -> None:
        waiting = {each.identity for each in self.sessions if each.waiting}
        request = self.sessions.next_request()
        assert (request is None) == (not waiting)
        if request is not None:
            owner = self.sessions.get(request.session)
            assert owner is not None
            assert request.session in waiting
            self.in_work.append((request, owner))

    @precondition(lambda self: self.in_work)
    @rule(which=st.integers(0, 100), cost=st.floats(0.0, 86_400.0))
    def answered(self, which: int, cost: float) -> None:
        request, owner = self.in_work.pop(which % len(self.in_work))
        alive = self.sessions.get(request.session) is owner
        if alive:
            assert self.sessions.mark_answered(request, cost)
            assert not self.sessions.mark_answered(request, cost)

    @precondition(lambda self: self.in_work)
    @rule(which=st.integers(0, 100))
    def put_back(self, which: int) -> None:
        request, owner = self.in_work.pop(which % len(self.in_work))
        if self.sessions.get(request.session) is owner:
            self.sessions.put_back(request)
            assert owner.waiting[0] == request

    @invariant()
    def one_place_each(self) -> None:
        for each in self.sessions:
            queued = [(request.epoch, request.index) for request in each.waiting]
            working = [(request.epoch, request.index) for request, owner in self.in_work if owner is each]
            assert sorted(queued + working) == sorted(each.unanswered)
            assert len(each.unanswered) <= each.credit


TestSessionModel = SessionModel.TestCase
TestSessionModel.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
