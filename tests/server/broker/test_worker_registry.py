"""The table of workers: who has room, who must be left alone, who hangs and who is gone."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.messages import WorkerHello
from v2v_server.broker.leases import (
    ALONE_AFTER,
    MOST_WORKER_CREDIT,
    REST_SECONDS,
    SILENCE_SECONDS,
    LeaseBook,
    Request,
    Workers,
    runs_alone,
)

DEADLINE = 60.0


class Table:
    """A book and the workers in it."""

    def __init__(self, **credit: int) -> None:
        self.book = LeaseBook(DEADLINE)
        self.workers = Workers(self.book)
        self.requests = 0
        for name, offered in credit.items():
            self.add(name.encode(), offered, 0.0)

    def add(self, identity: bytes, credit: int, now: float) -> None:
        self.workers.add(identity, WorkerHello(identity.decode(), NUMERICS_VERSION, credit), now)

    def load(self, name: str, *, deaths: int = 0, session: bytes = b"c", now: float = 0.0) -> int:
        self.requests += 1
        return self.book.grant(Request(session, 0, self.requests, deaths=deaths), name.encode(), now)

    def next(self, *, keep_one_empty: bool = False, other_than: bytes | None = None) -> bytes | None:
        return self.workers.for_request(keep_one_empty=keep_one_empty, other_than=other_than)


def test_the_least_loaded_worker_is_next_until_all_are_full() -> None:
    table = Table(a=2, b=1, c=2)
    taken = []
    while (name := table.next()) is not None:
        taken.append(name.decode())
        table.load(taken[-1])
    assert taken == ["a", "b", "c", "a", "c"]


def test_credit_is_at_least_one_and_limited() -> None:
    table = Table(none=0, much=2**64 - 1)
    for name, room in (("none", 1), ("much", MOST_WORKER_CREDIT)):
        for _ in range(room):
            assert name.encode() in (table.next(), table.next(other_than=b"none"), table.next(other_than=b"much"))
            table.load(name)
    assert table.next() is None


def test_the_registry_starts_empty_and_forgets_removed_workers() -> None:
    table = Table()
    assert (len(table.workers), table.next(), table.workers.for_lone_request()) == (0, None, None)
    table.add(b"a", 1, 0.0)
    assert (len(table.workers), b"a" in table.workers, list(table.workers.members)) == (1, True, [b"a"])
    table.workers.remove(b"a")
    table.workers.remove(b"a")
    assert (len(table.workers), b"a" in table.workers, table.next()) == (0, False, None)
    assert not table.workers.mark_heard(b"a", 0.0)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(
                ("load", "load", "finish", "add", "remove", "load alone", "leave", "give up", "rest", "wake")
            ),
            st.integers(0, 3),
            st.integers(0, 3),
        ),
        min_size=20,
        max_size=100,
    )
)
@settings(max_examples=300)
def test_who_has_room_is_what_counting_everybody_says(moves: list[tuple[str, int, int]]) -> None:
    """The table looks only at workers whose load has changed: none is ever forgotten, nor kept in mind twice."""
    table, out = Table(), []
    for number in range(4):
        table.add(f"w{number}".encode(), 1 + number, 0.0)
    for what, which, how in moves:
        name, session = f"w{which}", b"cd"[how % 2 :][:1]
        identity = name.encode()
        if what == "add" and identity not in table.workers:
            table.add(identity, 1 + how, 0.0)
        elif what == "remove":
            table.workers.remove(identity)
            table.book.lost(identity)
        elif what in ("load", "load alone") and identity in table.workers and not lonely(table, identity):
            out.append((table.load(name, deaths=ALONE_AFTER * (what == "load alone"), session=session), identity))
        elif what == "finish" and out:
            table.book.finished(*out.pop(which % len(out)), 0.0)
        elif what == "leave":
            table.book.forget_session(session)
        elif what == "give up":
            table.workers.hanging(DEADLINE * 10)
        elif what == "rest":
            table.workers.rest(identity, float(how), "a.mp4: not there")
        elif what == "wake":
            table.workers.wake(how + REST_SECONDS)
        expected = sorted(
            (table.book.held_by(identity), identity)
            for identity, worker in table.workers.members.items()
            if not worker.given_up
            and not table.workers.is_resting(identity)
            and table.book.held_by(identity) < worker.credit
            and not lonely(table, identity)
        )
        assert table.workers.with_room() == expected
        names = [identity for _, identity in expected]
        assert table.workers.for_lone_request() == next((name for held, name in expected if not held), None)
        for kept in (False, True):
            assert table.next(keep_one_empty=kept) == next(iter(names[kept:]), None)
            others = [name for name in names[kept:] if name != identity]
            assert table.next(keep_one_empty=kept, other_than=identity) == next(iter(others), None)
    assert len(table.workers.with_room()) <= 4


def test_workers_that_left_are_not_remembered() -> None:
    """Behind some who are always there, and first in the order."""
    table = Table(**{f"a{number}": 2 for number in range(3)})
    for number in range(2000):
        name = f"b{number}".encode()
        table.add(name, 2, 0.0)
        assert table.next() == b"a0"
        table.workers.remove(name)
    assert table.next() == b"a0"
    assert len(table.workers.with_room()) == 3


def lonely(table: Table, identity: bytes) -> bool:
    return any(runs_alone(request) for request in table.book.requests_of(identity))


# --- requests that run alone ----------------------------------------------------------------------------------------


def test_a_lone_task_needs_a_worker_that_holds_nothing() -> None:
    table = Table(a=2, b=2)
    numbers = [table.load(name) for name in ("a", "b")]
    assert table.workers.for_lone_request() is None
    # Not even a lease whose consumer is gone: the worker still has to get through it.
    table.book.forget_session(b"c")
    assert table.workers.for_lone_request() is None
    table.book.finished(numbers[1], b"b", 1.0)
    assert table.workers.for_lone_request() == b"b"


def test_a_worker_at_a_lone_task_gets_nothing_else() -> None:
    table = Table(a=8)
    number = table.load("a", deaths=ALONE_AFTER)
    assert (table.next(), table.workers.for_lone_request()) == (None, None)
    table.book.finished(number, b"a", 1.0)
    assert (table.next(), table.workers.for_lone_request()) == (b"a", b"a")
    table.load("a", deaths=ALONE_AFTER - 1)
    assert table.next() == b"a"


def test_while_a_lone_task_waits_one_worker_works_itself_empty_and_the_others_go_on() -> None:
    """The worker with the fewest tasks is not refilled, so it ends empty."""
    table = Table(a=2, b=2)
    held: dict[str, list[int]] = {name: [table.load(name), table.load(name)] for name in "ab"}
    served = 0
    for turn in range(20):
        name = "ab"[turn % 2]
        if held[name]:
            table.book.finished(held[name].pop(0), name.encode(), 0.0)
            served += 1
        if table.workers.for_lone_request() is not None:
            break
        while (free := table.next(keep_one_empty=True)) is not None:
            held[free.decode()].append(table.load(free.decode()))
    assert table.workers.for_lone_request() is not None
    assert served <= 4


def test_a_single_worker_is_kept_for_the_lone_request() -> None:
    table = Table(a=2)
    number = table.load("a")
    assert (table.next(keep_one_empty=False), table.next(keep_one_empty=True)) == (b"a", None)
    table.book.finished(number, b"a", 0.0)
    assert table.workers.for_lone_request() == b"a"


# --- twins ----------------------------------------------------------------------------------------------------------


def test_a_twin_goes_to_somebody_else_with_room() -> None:
    table = Table(a=2, b=2)
    table.load("b")
    assert table.next(other_than=b"a") == b"b"
    assert table.next(other_than=b"b") == b"a"
    # Nor does a twin take the worker that a lone request waits for.
    assert table.next(other_than=b"b", keep_one_empty=True) is None
    table.load("b")
    assert table.next(other_than=b"a") is None


def test_a_request_that_runs_alone_gets_no_second_worker() -> None:
    table = Table(a=2, b=2)
    table.load("b", deaths=ALONE_AFTER)
    assert table.next(other_than=b"a") is None


# --- those whose storage fails --------------------------------------------------------------------------------------


def test_who_rests_gets_nothing_until_it_wakes() -> None:
    table = Table(a=2, b=2)
    table.workers.rest(b"a", 5.0, "a.mp4: not there")
    table.workers.rest(b"stranger", 5.0, "a.mp4: not there")
    assert (table.next(), table.next(other_than=b"b"), table.workers.for_lone_request()) == (b"b", None, b"b")
    table.workers.wake(5.0 + REST_SECONDS - 0.1)
    assert table.next(other_than=b"b") is None
    table.workers.wake(5.0 + REST_SECONDS)
    assert table.next() == b"a"
    # Another process of that name has not failed.
    table.workers.rest(b"a", 20.0, "a.mp4: not there")
    table.workers.remove(b"a")
    table.add(b"a", 2, 20.0)
    assert table.next() == b"a"


# --- the hopeless ---------------------------------------------------------------------------------------------------


def test_a_hanging_worker_is_reported_once_and_gets_nothing_more() -> None:
    table = Table(a=4, b=4)
    table.load("a")
    table.load("a")
    table.load("b", now=10.0)
    assert table.workers.hanging(DEADLINE) == []
    assert table.workers.hanging(DEADLINE + 0.1) == [b"a"]
    assert table.workers.hanging(DEADLINE + 0.2) == []
    assert table.next(other_than=b"b") is None
    assert table.workers.hanging(DEADLINE + 10.1) == [b"b"]
    # It said hello again: another process, from the beginning.
    table.workers.remove(b"a")
    table.book.lost(b"a")
    table.add(b"a", 4, 100.0)
    assert table.next() == b"a"
    table.load("a", now=100.0)
    assert table.workers.hanging(100.1 + DEADLINE) == [b"a"]


def test_leases_of_an_unknown_worker_report_no_worker() -> None:
    table = Table(a=1)
    table.load("stranger")
    assert table.workers.hanging(1000.0) == []


def test_the_silent_have_vanished_unless_they_are_at_work() -> None:
    table = Table(a=1, b=1, c=1)
    number = table.load("b")
    assert table.workers.mark_heard(b"c", 1.0)
    assert table.workers.vanished(SILENCE_SECONDS - 0.1) == []
    assert table.workers.vanished(SILENCE_SECONDS + 0.5) == [b"a"]
    assert table.workers.vanished(SILENCE_SECONDS + 0.6) == []
    assert table.workers.vanished(SILENCE_SECONDS + 1.5) == [b"c"]
    assert table.workers.for_lone_request() is None
    table.book.finished(number, b"b", 40.0)
    assert table.workers.mark_heard(b"b", 40.0)
    assert table.workers.vanished(39.9 + SILENCE_SECONDS) == []
    assert table.workers.vanished(40.5 + SILENCE_SECONDS) == [b"b"]
