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


def test_credit_is_at_least_one_and_limited() -> None:
    table = Table(none=0, much=2**64 - 1)
    for name, room in (("none", 1), ("much", MOST_WORKER_CREDIT)):
        for _ in range(room):
            assert name.encode() in (table.next(), table.next(other_than=b"none"), table.next(other_than=b"much"))
            table.load(name)
    assert table.next() is None


def test_the_registry_forgets_removed_workers() -> None:
    table = Table()
    table.add(b"a", 1, 0.0)
    table.workers.rest(b"a", 0.0, "a.mp4: not there")
    table.workers.remove(b"a")
    table.workers.remove(b"a")
    assert (len(table.workers), b"a" in table.workers, table.next()) == (0, False, None)
    assert not table.workers.mark_heard(b"a", 0.0)
    table.add(b"a", 1, 0.0)  # another process of that name, which has not failed
    assert table.next() == b"a"


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


def lonely(table: Table, identity: bytes) -> bool:
    return any(runs_alone(request) for request in table.book.requests_of(identity))


def test_leases_of_an_unknown_worker_report_no_worker() -> None:
    table = Table(a=1)
    table.load("stranger")
    assert table.workers.hanging(1000.0) == []
