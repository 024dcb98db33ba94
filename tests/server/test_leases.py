"""The lease book against a model that keeps, for every task, the one place where it is."""

from __future__ import annotations

from dataclasses import dataclass

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, multiple, rule

from v2v_server.leases import LeaseBook, Task

DEADLINE = 60.0
A, B = b"worker a", b"worker b"
TASK = Task(b"consumer", 0, 0)


def numbered(index: int, session: bytes = b"consumer") -> Task:
    return Task(session, 0, index)


def overdue_workers(book: LeaseBook, now: float) -> list[bytes]:
    return [overdue.worker for overdue in book.overdue(now)]


# --- single steps -----------------------------------------------------------------------------------------------------


def test_an_answer_returns_the_task_once() -> None:
    book = LeaseBook(DEADLINE)
    number = book.grant(TASK, A, 0.0)
    assert (len(book), book.held_by(A), book.held_by(B)) == (1, 1, 0)
    assert book.finished(number, B) is None
    assert book.finished(number + 1, A) is None
    assert book.finished(number, A) is TASK
    assert book.finished(number, A) is None
    assert (len(book), book.held_by(A)) == (0, 0)


def test_a_lost_worker_returns_its_tasks_oldest_first_and_only_the_begun_is_suspect() -> None:
    book = LeaseBook(DEADLINE)
    numbers = [book.grant(numbered(index), A, 0.0) for index in range(3)]
    other = book.grant(numbered(9), B, 0.0)
    assert book.finished(numbers[0], A) == numbered(0)
    book.begun(numbers[1], A, 1.0)
    book.begun(numbers[2], B, 1.0)
    assert book.lost(A) == [(numbered(1), True), (numbered(2), False)]
    assert book.lost(A) == []
    assert book.finished(numbers[1], A) is None
    assert book.finished(other, B) == numbered(9)


def test_a_late_answer_finds_nothing_even_when_the_task_went_back_to_the_same_worker() -> None:
    book = LeaseBook(DEADLINE)
    first = book.grant(TASK, A, 0.0)
    book.lost(A)
    second = book.grant(TASK, A, 1.0)
    assert second != first
    book.begun(first, A, 2.0)
    assert book.finished(first, A) is None
    assert book.lost(A) == [(TASK, False)]


def test_the_deadline_counts_from_the_grant_and_from_each_beginning() -> None:
    book = LeaseBook(DEADLINE)
    first, second = book.grant(numbered(0), A, 0.0), book.grant(numbered(1), A, 0.0)
    assert overdue_workers(book, DEADLINE) == []
    assert overdue_workers(book, DEADLINE + 0.5) == [A, A]
    book.begun(first, A, 50.0)
    assert overdue_workers(book, 50.0 + DEADLINE) == []
    book.finished(first, A)
    book.begun(second, A, 100.0)
    assert overdue_workers(book, 100.0 + DEADLINE) == []
    assert overdue_workers(book, 100.5 + DEADLINE) == [A]
    assert book.held_by(A) == 1


def test_a_forgotten_consumer_gets_no_answer_but_its_leases_still_fill_the_worker() -> None:
    """The worker does not know: it has to get through them, so it has no room for others, and may still hang."""
    book = LeaseBook(DEADLINE)
    gone, stays = book.grant(numbered(0, b"gone"), A, 0.0), book.grant(numbered(1, b"stays"), A, 0.0)
    book.forget_session(b"gone")
    assert book.held_by(A) == 2
    assert overdue_workers(book, DEADLINE + 1) == [A, A]
    book.begun(gone, A, 50.0)
    assert overdue_workers(book, 50.0 + DEADLINE) == []
    assert book.finished(gone, A) is None
    assert book.held_by(A) == 1
    assert book.finished(stays, A) == numbered(1, b"stays")
    assert len(book) == 0


def test_a_worker_lost_over_forgotten_leases_returns_nothing() -> None:
    book = LeaseBook(DEADLINE)
    number = book.grant(numbered(0, b"gone"), A, 0.0)
    book.begun(number, A, 0.0)
    book.forget_session(b"gone")
    assert book.lost(A) == []
    assert len(book) == 0
    assert overdue_workers(book, 1000.0) == []


# --- any order --------------------------------------------------------------------------------------------------------


@dataclass
class Place:
    task: Task
    worker: bytes
    begun: bool
    deadline: float
    forgotten: bool


class LeaseModel(RuleBasedStateMachine):
    """Every granted task is with one worker until it is answered, returned or forgotten; then its number is dead."""

    numbers = Bundle("numbers")
    workers = st.sampled_from((A, B, b"worker c"))
    sessions = st.sampled_from((b"s1", b"s2"))

    def __init__(self) -> None:
        super().__init__()
        self.book = LeaseBook(DEADLINE)
        self.out: dict[int, Place] = {}
        self.now = 0.0
        self.tasks = 0
        self.ever: set[int] = set()

    @rule(target=numbers, worker=workers, session=sessions)
    def grant(self, worker: bytes, session: bytes) -> int:
        task = Task(session, 0, self.tasks)
        self.tasks += 1
        number = self.book.grant(task, worker, self.now)
        assert number not in self.ever
        self.ever.add(number)
        self.out[number] = Place(task, worker, False, self.now + DEADLINE, False)
        return number

    @rule(number=numbers, worker=workers)
    def begun(self, number: int, worker: bytes) -> None:
        self.book.begun(number, worker, self.now)
        place = self.out.get(number)
        if place is not None and place.worker == worker:
            place.begun = True
            for other in self.out.values():
                if other.worker == worker:
                    other.deadline = self.now + DEADLINE

    @rule(number=numbers, worker=workers)
    def finished(self, number: int, worker: bytes) -> None:
        place = self.out.get(number)
        task = self.book.finished(number, worker)
        if place is None or place.worker != worker:
            assert task is None
            return
        assert task == (None if place.forgotten else place.task)
        del self.out[number]

    @rule(target=numbers, worker=workers)
    def lost(self, worker: bytes) -> object:
        mine = [number for number, place in self.out.items() if place.worker == worker]
        expected = [
            (self.out[number].task, self.out[number].begun) for number in mine if not self.out[number].forgotten
        ]
        assert self.book.lost(worker) == expected
        for number in mine:
            del self.out[number]
        return multiple()

    @rule(session=sessions)
    def forget(self, session: bytes) -> None:
        self.book.forget_session(session)
        for place in self.out.values():
            place.forgotten |= place.task.session == session

    @rule(seconds=st.floats(0.0, 2 * DEADLINE))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds

    @invariant()
    def every_lease_is_in_one_place(self) -> None:
        assert len(self.book) == len(self.out)
        for worker in (A, B, b"worker c"):
            assert self.book.held_by(worker) == sum(place.worker == worker for place in self.out.values())

    @invariant()
    def overdue_is_what_the_clock_says(self) -> None:
        late = {number for number, place in self.out.items() if self.now > place.deadline}
        assert {overdue.lease for overdue in self.book.overdue(self.now)} == late


TestLeaseModel = LeaseModel.TestCase
TestLeaseModel.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
