"""The lease book against a model that keeps, for every request, the one place where it is; who is to blame; and the
table of workers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, multiple, rule

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.messages import WorkerHello
from v2v_server.broker.leases import (
    ALONE_AFTER,
    MOST_WORKER_CREDIT,
    REST_SECONDS,
    Cause,
    LeaseBook,
    Loss,
    Request,
    Stall,
    Workers,
    judge,
    runs_alone,
)

DEADLINE = 60.0
A, B = b"worker a", b"worker b"
REQUEST = Request(b"consumer", 0, 0)


def numbered(index: int, session: bytes = b"consumer") -> Request:
    return Request(session, 0, index)


def overdue_workers(book: LeaseBook, now: float) -> list[bytes]:
    return sorted(book.overdue(now))


# --- single steps -----------------------------------------------------------------------------------------------------


def test_a_deadline_scales_with_the_work_also_of_what_is_in_front() -> None:
    book = LeaseBook(DEADLINE)
    long = book.grant(numbered(0), A, 0.0, work_seconds=100.0)
    book.grant(numbered(1), A, 0.0)
    assert book.limit_seconds(A) == DEADLINE + 100.0
    assert overdue_workers(book, DEADLINE + 100.0) == []
    assert overdue_workers(book, DEADLINE + 100.5) == [A]
    book.mark_begun(long, A, 10.0)
    assert overdue_workers(book, DEADLINE + 110.0) == []


def test_time_stopped_is_not_time_worked() -> None:
    book = LeaseBook(DEADLINE)
    book.mark_begun(book.grant(REQUEST, A, 0.0), A, 0.0)
    book.grant(numbered(1), B, 0.0)
    book.extend_deadlines(A, Stall(stopped_seconds=DEADLINE / 2))
    assert overdue_workers(book, 1.5 * DEADLINE) == [B]
    assert overdue_workers(book, 1.5 * DEADLINE + 0.5) == [A, B]


@pytest.mark.parametrize(
    ("stall", "deadlines"),
    [
        (Stall(queued_seconds=0.75), 4),  # when it has worked for its time
        (Stall(stopped_seconds=1.0), 2),  # after twice its time
    ],
)
def test_one_that_cannot_run_is_overdue_later_and_slow_at_once(stall: Stall, deadlines: int) -> None:
    """Others took a tenth of a second each."""
    book = practised(0.1)
    book.mark_begun(book.grant(REQUEST, A, 0.0), A, 0.0)
    for second in range(10 * int(DEADLINE)):
        book.extend_deadlines(A, stall)
        assert (overdue_workers(book, second + 1.0) == [A]) is (second + 1.0 > deadlines * DEADLINE)
        assert bool(book.slow(second + 1.0)) is (second + 1.0 > 1.0)


def test_the_wait_of_one_sample_is_no_time_of_the_next() -> None:
    book = LeaseBook(DEADLINE)
    first, second = (book.grant(numbered(index), A, 0.0) for index in range(2))
    book.mark_begun(first, A, 0.0)
    book.extend_deadlines(A, Stall(queued_seconds=100.0))
    book.mark_begun(second, A, 50.0)
    assert overdue_workers(book, 50.5 + DEADLINE) == [A]


def test_what_a_consumer_gave_up_is_counted_until_the_workers_are_through_with_it() -> None:
    book = LeaseBook(DEADLINE)
    numbers = [book.grant(numbered(index), A, 0.0) for index in range(3)]
    book.mark_begun(numbers[0], A, 1.0)
    assert book.abandoned(b"consumer") == 0
    book.forget_session(b"consumer")
    assert book.abandoned(b"consumer") == 3
    assert book.debt(numbers[0], A, 5.0) == (b"consumer", 4.0)
    assert book.debt(numbers[0], B, 5.0) is None
    assert book.debt(numbers[1], A, 5.0) is None  # not begun
    assert book.finished(numbers[0], A, 5.0) is None
    assert book.abandoned(b"consumer") == 2
    book.lost(A)
    assert book.abandoned(b"consumer") == 0


# --- the slow ---------------------------------------------------------------------------------------------------------


def practised(seconds: float, samples: int = 8, book: LeaseBook | None = None) -> LeaseBook:
    """A book that has seen that many samples of a consumer take that long."""
    book = book or LeaseBook(DEADLINE)
    for index in range(samples):
        number = book.grant(numbered(1000 + index), B, 0.0)
        book.mark_begun(number, B, 0.0)
        assert book.finished(number, B, seconds) is not None
    return book


@pytest.mark.parametrize(
    ("seconds", "samples", "limit"),
    [
        (1.0, 8, 3.0),
        (4.0, 8, 12.0),
        (0.01, 8, 1.0),  # never before a second
        (1.0, 7, None),  # too few to know what is usual
        (1.0, 0, None),
    ],
)
def test_slow_is_three_times_the_median_and_a_second(seconds: float, samples: int, limit: float | None) -> None:
    book = practised(seconds, samples)
    book.mark_begun(book.grant(REQUEST, A, 100.0), A, 100.0)
    if limit is None:
        assert book.slow(100.0 + DEADLINE) == []
    else:
        assert book.slow(100.0 + limit) == []
        assert book.slow(100.001 + limit) == [(REQUEST, A)]


def test_the_median_is_of_the_last_samples_and_of_the_consumer_itself() -> None:
    book = practised(10.0, 64, practised(1.0, 8))
    book.mark_begun(book.grant(REQUEST, A, 100.0), A, 100.0)
    assert book.slow(130.0) == []
    assert book.slow(130.5) == [(REQUEST, A)]
    book.grant(numbered(0, b"a consumer of one sample"), b"worker c", 100.0)
    assert book.slow(130.5) == [(REQUEST, A)]


def test_only_the_oldest_of_a_consumer_is_slow_and_only_while_one_is_at_it() -> None:
    book = practised(1.0)
    book.grant(numbered(0), A, 0.0)
    book.grant(numbered(1), B, 0.0)
    assert book.slow(5.0) == [(numbered(0), A)]
    twin = book.grant(numbered(0), b"worker c", 5.0)
    assert book.slow(20.0) == []
    assert book.lost(A) == []
    # The twin is alone now, and not the oldest: the other has waited longer.
    assert book.slow(20.0) == [(numbered(1), B)]
    assert book.finished(twin, b"worker c", 21.0) == numbered(0)


def test_a_task_queued_behind_one_that_hangs_is_slow() -> None:
    """Its consumer waits for it, though the one in work is another's; but not while the worker gets on."""
    book = practised(1.0)
    hanging = book.grant(numbered(0, b"other"), A, 0.0)
    between = book.grant(numbered(1, b"other"), A, 0.0)
    book.grant(numbered(2), A, 0.0)
    book.mark_begun(hanging, A, 0.0)
    assert book.slow(3.5) == [(numbered(2), A)]
    book.finished(hanging, A, 3.5)
    book.mark_begun(between, A, 3.5)
    assert book.slow(6.5) == []
    assert book.slow(6.6) == [(numbered(2), A)]


# --- any order --------------------------------------------------------------------------------------------------------


@dataclass
class Place:
    request: Request
    worker: bytes
    begun: bool
    deadline: float
    retired: bool


class LeaseModel(RuleBasedStateMachine):
    """Every lease is with one worker until that answers or is lost. A request may be out twice: it comes back once, by
    the first answer, or when the last worker at it is lost; a forgotten one never."""

    numbers = Bundle("numbers")
    workers = st.sampled_from((A, B, b"worker c"))
    speakers = st.sampled_from((None, None, None, A, B, b"worker c"))  # None: the worker that has the lease
    sessions = st.sampled_from((b"s1", b"s2"))

    def __init__(self) -> None:
        super().__init__()
        self.book = LeaseBook(DEADLINE)
        self.out: dict[int, Place] = {}
        self.now = 0.0
        self.requests = 0
        self.ever: set[int] = set()

    def _speaker(self, number: int, worker: bytes | None) -> bytes:
        return worker or (self.out[number].worker if number in self.out else A)

    def _granted(self, request: Request, worker: bytes) -> int:
        number = self.book.grant(request, worker, self.now)
        assert number not in self.ever
        self.ever.add(number)
        self.out[number] = Place(request, worker, False, self.now + DEADLINE, False)
        return number

    def _retire(self, request: Request) -> None:
        for place in self.out.values():
            place.retired |= place.request == request

    @rule(target=numbers, workers=st.lists(workers, min_size=1, max_size=2, unique=True), session=sessions)
    def grant(self, workers: list[bytes], session: bytes) -> object:
        self.requests += 1
        return multiple(*(self._granted(Request(session, 0, self.requests), worker) for worker in workers))

    @rule(target=numbers, number=numbers, worker=workers)
    def twin(self, number: int, worker: bytes) -> object:
        place = self.out.get(number)
        if place is None or place.retired:
            return multiple()
        if worker in {other.worker for other in self.out.values() if other.request == place.request}:
            return multiple()  # no worker is given a request that it has
        return self._granted(place.request, worker)

    @rule(number=numbers, speaker=speakers)
    def begun(self, number: int, speaker: bytes | None) -> None:
        worker = self._speaker(number, speaker)
        self.book.mark_begun(number, worker, self.now)
        place = self.out.get(number)
        if place is not None and place.worker == worker and not place.begun:
            place.begun = True
            for other in self.out.values():
                if other.worker == worker:
                    other.deadline = self.now + DEADLINE

    @rule(number=numbers, speaker=speakers)
    def finished(self, number: int, speaker: bytes | None) -> None:
        worker, place = self._speaker(number, speaker), self.out.get(number)
        asked = self.book.request(number, worker)
        request = self.book.finished(number, worker, self.now)
        assert request == asked
        if place is None or place.worker != worker:
            assert request is None
            return
        assert request == (None if place.retired else place.request)
        del self.out[number]
        self._retire(place.request)

    @rule(worker=workers)
    def lost(self, worker: bytes) -> None:
        mine = [place for place in self.out.values() if place.worker == worker]
        self.out = {number: place for number, place in self.out.items() if place.worker != worker}
        elsewhere = {place.request for place in self.out.values()}
        expected: dict[Request, bool] = {}
        for place in mine:
            if not place.retired and place.request not in elsewhere:
                expected[place.request] = place.begun
        assert self.book.lost(worker) == list(expected.items())

    @rule(session=sessions)
    def forget(self, session: bytes) -> None:
        self.book.forget_session(session)
        for place in self.out.values():
            place.retired |= place.request.session == session

    @rule(seconds=st.floats(0.0, 2 * DEADLINE))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds

    @invariant()
    def every_lease_is_in_one_place(self) -> None:
        assert len(self.book) == len(self.out)
        for worker in (A, B, b"worker c"):
            mine = [place for place in self.out.values() if place.worker == worker]
            clips = {place.request.clip for place in mine if not place.retired}
            assert self.book.held_by(worker) == len(clips) + sum(place.retired for place in mine)
            assert list(self.book.requests_of(worker)) == [place.request for place in mine if not place.retired]

    @invariant()
    def overdue_is_what_the_clock_says(self) -> None:
        assert self.book.overdue(self.now) == {p.worker for p in self.out.values() if self.now > p.deadline}

    @invariant()
    def the_slow_are_out_once(self) -> None:
        for request, worker in self.book.slow(self.now):
            assert [place.worker for place in self.out.values() if place.request == request] == [worker]


TestLeaseModel = LeaseModel.TestCase
TestLeaseModel.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)


# --- blame: every cause, with every number of deaths before it --------------------------------------------------------


JUDGED = Request(b"consumer", 3, 7, candidate=2)


def after(deaths: int) -> Request:
    return replace(JUDGED, deaths=deaths)


REFUSED = "a worker did something over it"


@pytest.mark.parametrize(
    ("cause", "deaths", "verdict"),
    [
        (Cause.CRASHED, 0, REFUSED),
        (Cause.CRASHED, 1, REFUSED),
        (Cause.CRASHED, 2, REFUSED),
        (Cause.HUNG, 0, REFUSED),
        (Cause.HUNG, 1, REFUSED),
        (Cause.HUNG, 2, REFUSED),
        (Cause.UNEXPLAINED, 0, after(1)),
        (Cause.UNEXPLAINED, 1, after(2)),
        (Cause.UNEXPLAINED, 2, REFUSED),
        (Cause.MEMORY, 0, after(1)),
        (Cause.MEMORY, 2, after(3)),
        (Cause.KILLED, 0, after(0)),
        (Cause.KILLED, 1, after(1)),
        (Cause.KILLED, 2, after(2)),
    ],
)
def test_verdicts(cause: Cause, deaths: int, verdict: Request | str) -> None:
    assert judge(after(deaths), Loss(cause, "did something")) == verdict


def test_a_task_runs_alone_after_two_unexplained_deaths_until_its_candidate_changes() -> None:
    assert [runs_alone(after(deaths)) for deaths in range(4)] == [False, False, True, True]


# --- the table of workers: who has room, who must be left alone, who hangs and who is gone ----------------------------


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
        return self.workers.for_request(kept_bytes=0 if keep_one_empty else None, other_than=other_than)


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
    assert (len(table.workers.members), b"a" in table.workers.members, table.next()) == (0, False, None)
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
        if what == "add" and identity not in table.workers.members:
            table.add(identity, 1 + how, 0.0)
        elif what == "remove":
            table.workers.remove(identity)
            table.book.lost(identity)
        elif what in ("load", "load alone") and identity in table.workers.members and not lonely(table, identity):
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
            and identity not in table.workers.resting
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
