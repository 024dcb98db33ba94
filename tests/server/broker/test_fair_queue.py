"""The queue of waiting consumers against a slow oracle: a scan of all consumers for each request."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from v2v_server.broker.session import FairQueue

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
TestSameOrder.settings = settings(max_examples=150, stateful_step_count=60, deadline=None)


def test_consumers_that_come_and_go_while_no_worker_is_there_leave_nothing() -> None:
    queue = FairQueue()
    for number in range(1000):
        identity = b"%d" % number
        queue.add(identity)
        queue.set_waiting(identity, waits=True)
        queue.charge(identity, 1.0)
        queue.charge(identity, -1.0)
        queue.remove(identity)
    assert queue.waiting == ([], [])
    assert queue.next() is None
