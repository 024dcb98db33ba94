import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from v2v_client.delivery import ReorderWindow
from v2v_protocol.errors import LimitExceeded


class Arrivals(RuleBasedStateMachine):
    """Deliver samples in any order, twice, or unrequested. The model is the set of samples under way."""

    @initialize(batch_size=st.integers(1, 5), batches=st.integers(0, 12), credit=st.integers(1, 14))
    def open(self, batch_size, batches, credit):
        self.batch_size, self.credit = batch_size, credit
        self.numbers = list(range(1, 2 * batches, 2))  # as the second of two loader workers
        self.window = ReorderWindow(self.numbers, self.indices, batch_size, credit)
        self.under_way: list[int] = []
        self.asked: list[int] = []
        self.rows: dict[int, dict[int, int]] = {}
        self.received: set[int] = set()
        self.taken: list[int] = []

    def indices(self, batch):
        return tuple(3 * position + 1 for position in range(batch * self.batch_size, (batch + 1) * self.batch_size))

    @rule()
    def ask(self):
        asked = self.window.ask()
        self.asked += asked
        self.under_way += asked

    @precondition(lambda self: self.under_way)
    @rule(data=st.data())
    def arrive(self, data):
        index = self.under_way.pop(data.draw(st.integers(0, len(self.under_way) - 1)))
        slot = self.window.receive(index)
        assert slot is not None
        self.received.add(index)
        self.rows.setdefault(slot.batch, {})[slot.row] = index

    @precondition(lambda self: self.received)
    @rule(data=st.data())
    def arrive_again(self, data):
        assert self.window.receive(data.draw(st.sampled_from(sorted(self.received)))) is None

    @rule(index=st.integers(0, 100).map(lambda n: 3 * n))
    def arrive_unasked(self, index):
        assert self.window.receive(index) is None

    @rule()
    def take(self):
        batch = self.window.take()
        if batch is not None:
            # Every row was filled, each with the sample of its place.
            assert self.rows.pop(batch) == dict(enumerate(self.indices(batch)))
            self.taken.append(batch)
        elif not self.window.finished:
            missing = set(self.indices(self.numbers[len(self.taken)])) - self.received
            assert missing, "a complete batch was withheld"

    @invariant()
    def limits_hold(self):
        if not hasattr(self, "window"):
            return
        assert sorted(self.window.outstanding) == sorted(self.under_way)
        assert len(self.under_way) <= self.credit
        assert len(self.asked) - len(self.taken) * self.batch_size <= self.credit + self.batch_size
        assert self.taken == self.numbers[: len(self.taken)]
        assert self.window.finished == (self.taken == self.numbers)
        expected = [index for number in self.numbers for index in self.indices(number)]
        assert self.asked == expected[: len(self.asked)], "asked out of order"

    def teardown(self):
        """Whatever happened, it can be brought to its end: no state is stuck."""
        if not hasattr(self, "window"):
            return
        while not self.window.finished:
            self.ask()
            moved = bool(self.under_way)
            while self.under_way:
                self.window.receive(self.under_way.pop())
            assert moved or self.window.take() is not None, "nothing is under way, and nothing can be taken"


TestArrivals = Arrivals.TestCase
TestArrivals.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_a_credit_of_zero_is_refused():
    with pytest.raises(LimitExceeded, match="credit = 0 samples"):
        ReorderWindow([0], lambda _: (0,), 1, 0)
