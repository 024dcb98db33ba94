"""Leases: which worker is making which sample. A state machine without I/O; time is passed in.

    pending (in its session's queue) --grant--> leased --begun--> working --finished--> gone
                 ^                                 |                 |
                 `------- returned to its session -+-----------------'   worker lost, deadline passed

A task is one asked sample. Every grant gets a new number, so an answer to a lease that was taken away is recognised by
its number and dropped. Only the lease a worker announced as begun can be blamed for the worker's death.
"""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.sample import Refusal


@dataclass(frozen=True, slots=True)
class Task:
    """One asked sample on its way.

    Attributes:
        session: routing identity of the consumer.
        epoch, index: which sample.
        candidate: which candidate sequence is being tried.
        refusals: the candidates that failed before it.
        deaths: workers that died by their own doing (a crash, a hang) while they were at this candidate.
    """

    session: bytes
    epoch: int
    index: int
    candidate: int = 0
    refusals: tuple[Refusal, ...] = ()
    deaths: int = 0


@dataclass(slots=True)
class _Lease:
    task: Task | None  # None: its consumer is gone, but the worker still has to get through it
    worker: bytes
    deadline: float
    begun: bool = False


@dataclass(frozen=True, slots=True)
class Overdue:
    """A lease whose worker has been silent for longer than the deadline."""

    lease: int
    worker: bytes


class LeaseBook:
    """All leases that are out.

    Args:
        deadline_seconds: longest time from the grant, or from the beginning of the work, to the answer.
    """

    def __init__(self, deadline_seconds: float) -> None:
        self.deadline_seconds = deadline_seconds
        self._leases: dict[int, _Lease] = {}
        self._held: dict[bytes, list[int]] = {}
        self._next = 1

    def __len__(self) -> int:
        return len(self._leases)

    def held_by(self, worker: bytes) -> int:
        """Leases that are out to this worker."""
        return len(self._held.get(worker, ()))

    def grant(self, task: Task, worker: bytes, now: float) -> int:
        """Gives the task to a worker; returns the number of the lease."""
        number = self._next
        self._next += 1
        self._leases[number] = _Lease(task, worker, now + self.deadline_seconds)
        self._held.setdefault(worker, []).append(number)
        return number

    def begun(self, number: int, worker: bytes, now: float) -> None:
        """The worker started on it. The clock of those queued behind it starts again: they wait through no fault."""
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker:
            return
        lease.begun = True
        for other in self._held[worker]:
            self._leases[other].deadline = now + self.deadline_seconds

    def finished(self, number: int, worker: bytes) -> Task | None:
        """The worker answered; returns the task, or None when the lease had been taken away from it before, or its
        consumer is gone."""
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker:
            return None
        self._drop(number)
        return lease.task

    def lost(self, worker: bytes) -> list[tuple[Task, bool]]:
        """The worker is gone: its tasks, oldest first, each with whether it had been begun (and so may be blamed)."""
        returned = []
        for number in self._held.pop(worker, []):
            lease = self._leases.pop(number)
            if lease.task is not None:
                returned.append((lease.task, lease.begun))
        return returned

    def overdue(self, now: float) -> list[Overdue]:
        """Leases past their deadline, oldest first. They stay out until their worker is given up (:meth:`lost`)."""
        return [Overdue(number, lease.worker) for number, lease in self._leases.items() if now > lease.deadline]

    def forget_session(self, session: bytes) -> None:
        """The consumer is gone: answers to its leases will find nothing.

        The leases stay with their workers, which do not know and work through them: that is room they do not have for
        others, and time for which those queued behind must not be called overdue.
        """
        for lease in self._leases.values():
            if lease.task is not None and lease.task.session == session:
                lease.task = None

    def _drop(self, number: int) -> None:
        lease = self._leases.pop(number)
        held = self._held[lease.worker]
        held.remove(number)
        if not held:
            del self._held[lease.worker]
