"""Sessions: credit, duplicates, and the fair sharing of worker time, whose queue meets a slow oracle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import cast

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import MOST_IN_FLIGHT_BYTES
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import LeaseBook, Request
from v2v_server.broker.session import FairQueue, Session, Sessions
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


def two(credit: int) -> tuple[Sessions, Session, Session]:
    """Two consumers that have asked for as much as they may."""
    a, b = session(b"a", credit), session(b"b", credit)
    sessions = opened(a, b)
    for each in (a, b):
        sessions.want(each, 0, range(credit))
    return sessions, a, b


# --- what is not read yet ---------------------------------------------------------------------------------------------


def test_samples_that_are_not_read_yet_count_against_the_credit() -> None:
    sessions, a, b = two(8)
    sample = sum(a.form.sizes)
    assert sessions.room(a) == 8
    for unread, room in ((1, 8), (sample, 8), (3 * sample + 1000, 6), (9 * sample, 0), (20 * sample, -11), (0, 8)):
        assert sessions.set_in_flight(b"a", unread) is (None if room < 8 or unread else a)
        assert sessions.room(a) == room
    take(sessions), take(sessions)
    assert sessions.room(a) == sessions.room(b) == 7


def test_what_is_in_flight_outlives_a_hello() -> None:
    """It lies in the same connection's queue, whatever the consumer says."""
    sessions = opened(session(b"a"))
    sessions.set_in_flight(b"a", 1 << 40)
    sessions.open(again := session(b"a"))
    sessions.want(again, 0, [0])
    assert sessions.next_request() is None


@settings(max_examples=25)  # the count, above and below the 160 samples of the limit, is all that differs
@given(st.integers(1, 250))
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


# --- coming and going -------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("unit", "workers", "credit"), [(0.1, 1, 1), (0.1, 1, 2), (0.001, 4, 16), (7.0, 1, 16), (0.1, 4, 16)]
)
def test_tenfold_work_gets_a_tenth_of_the_samples(unit: float, workers: int, credit: int) -> None:
    """A consumer whose queue runs empty with every answer still pays for it, and starves no other."""
    got = serve({b"cheap": unit, b"dear": 10 * unit}, 2200, workers, {b"dear": credit})
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


# --- the queue of waiting consumers against a scan of all of them for each request ------------------------------------


QUANTUM_NS = 50_000_000


class Scan:
    """Deficit round robin as its paper describes it: every consumer is looked at, every balance is changed."""

    def __init__(self) -> None:
        self.balances_ns: dict[bytes, int] = {}
        self.waiting: set[bytes] = set()
        self.turns: list[bytes] = []

    def next(self) -> bytes | None:
        waiting = [identity for identity in self.turns if identity in self.waiting]
        if not waiting:
            return None
        while True:
            for identity in waiting:
                if self.balances_ns[identity] >= 0:
                    self.turns.remove(identity)
                    self.turns.append(identity)
                    return identity
            debt = -max(self.balances_ns[identity] for identity in waiting)
            for identity in waiting:
                self.balances_ns[identity] += (debt // QUANTUM_NS + 1) * QUANTUM_NS


class SameOrder(RuleBasedStateMachine):
    """Queue and scan serve the same consumers in the same order, and agree on every balance."""

    identities = st.integers(0, 7).map(lambda number: b"%d" % number)

    def __init__(self) -> None:
        super().__init__()
        self.queue, self.scan = FairQueue(), Scan()
        self.debts_ns: dict[bytes, int] = {}

    @rule(identity=identities)
    def add(self, identity: bytes) -> None:
        if identity not in self.scan.balances_ns:
            self.queue.add(identity, [identity])
            self.scan.balances_ns[identity] = -self.debts_ns.pop(identity, 0)
            self.scan.turns.append(identity)

    @rule(identity=identities)
    def remove(self, identity: bytes) -> None:
        if identity in self.scan.balances_ns:
            self.queue.remove(identity)
            self.scan.turns.remove(identity)
            self.scan.waiting.discard(identity)
            if (balance_ns := self.scan.balances_ns.pop(identity)) < 0:
                self.debts_ns[identity] = -balance_ns

    @rule(identity=identities, cost_ns=st.integers(0, 10**9) | st.sampled_from((QUANTUM_NS, 86_400 * 10**9)))
    def charge(self, identity: bytes, cost_ns: int) -> None:
        self.queue.charge(identity, cost_ns / 10**9)
        if identity in self.scan.balances_ns:
            self.scan.balances_ns[identity] -= cost_ns
        else:
            self.debts_ns[identity] = self.debts_ns.get(identity, 0) + cost_ns

    @rule(identities=st.sets(identities), waits=st.booleans())
    def wait(self, identities: set[bytes], waits: bool) -> None:
        for identity in identities & self.scan.balances_ns.keys():
            self.queue.set_waiting(identity, waits=waits)
            (self.scan.waiting.add if waits else self.scan.waiting.discard)(identity)

    @rule(identity=identities)
    def drop_savings(self, identity: bytes) -> None:
        if identity in self.scan.balances_ns.keys() - self.scan.waiting:
            self.queue.drop_savings(identity)
            self.scan.balances_ns[identity] = min(0, self.scan.balances_ns[identity])

    @rule(times=st.integers(1, 12), cost_ns=st.integers(0, 10**8))
    def serve(self, times: int, cost_ns: int) -> None:
        for _ in range(times):
            served = self.queue.next()
            assert served == self.scan.next()
            if served is not None:
                self.charge(served, cost_ns)

    @invariant()
    def same_balances(self) -> None:
        for identity, balance_ns in self.scan.balances_ns.items():
            assert self.queue.balance_ns(identity) == balance_ns


TestSameOrder = SameOrder.TestCase
TestSameOrder.settings = settings(max_examples=60, stateful_step_count=60, deadline=None)
