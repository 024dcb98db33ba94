"""Leases: which worker is making which sample. A state machine without I/O; time is passed in.

    pending (in its session's queue) --grant--> leased --begun--> working --finished--> gone
                 ^                                 |                 |
                 `------- returned to its session -+-----------------'   worker lost

A request is one sample that a consumer asked for. Every grant gives it a lease with a new number, so an answer to a
lease that was taken away is recognised by its number and dropped. A request that takes much longer than its consumer's
others is given to a second worker as well; the first answer retires its twin.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from v2v_protocol.arena import Slot
from v2v_protocol.refusal import Refusal

SLOW_FACTOR = 3.0
"""A lease in work for this many times the median of its session's decoded clips is slow."""
_LEAST_SLOW_SECONDS = 1.0
_REMEMBERED = 64
_LEAST_REMEMBERED = 8


@dataclass(frozen=True, slots=True)
class Request:
    """One sample that a consumer asked for, until it is answered.

    Attributes:
        session: routing identity of the consumer.
        epoch, index: which sample.
        candidate: which candidate sequence is being tried.
        refusals: the candidates that failed before it.
        deaths: unexplained deaths of workers that were at this candidate.
        snapshot: number of the quarantine snapshot under which those candidates were passed over.
        place: of the index in the epoch's order (:mod:`v2v_server.schedule.epoch`); None: the index itself.
        slot: where its consumer lets it be put; given to one worker only.
    """

    session: bytes
    epoch: int
    index: int
    candidate: int = 0
    refusals: tuple[Refusal, ...] = ()
    deaths: int = 0
    snapshot: int = 0
    place: int | None = None
    slot: Slot | None = None

    @property
    def clip(self) -> tuple[bytes, int, int, int]:
        """What it is made from: requests of equal clip are made from the same decoded frames."""
        return self.session, self.epoch, self.index if self.place is None else self.place, self.candidate

    @property
    def sample(self) -> tuple[bytes, int, int]:
        """What is asked, whichever candidate it will be made from."""
        return self.session, self.epoch, self.index


@dataclass(slots=True)
class _Grant:
    request: Request | None  # None: answered, or its consumer is gone; but the worker still has to get through it
    worker: bytes
    since: float  # when it was granted, or its worker last began something
    limit_seconds: float  # from then to the answer
    begun_at: float | None = None
    stopped_seconds: float = 0.0  # of them, in which its worker was stopped from outside
    queued_seconds: float = 0.0  # and in which it waited for a core
    debtor: bytes | None = None  # who asked for it and waits no more, which does not make it less work


@dataclass(frozen=True, slots=True)
class Stall:
    """Time in which a worker could not work, and not for anything that it is at.

    Attributes:
        stopped_seconds: stopped from outside, by a signal or a debugger.
        queued_seconds: waiting for a core that other processes had.
    """

    stopped_seconds: float = 0.0
    queued_seconds: float = 0.0


class LeaseBook:
    """All leases that are out.

    Args:
        deadline_seconds: longest time from the grant, or from the beginning of the work, to the answer, besides what
            the work itself may take.
    """

    def __init__(self, deadline_seconds: float) -> None:
        self.deadline_seconds = deadline_seconds
        self._leases: dict[int, _Grant] = {}
        self._held: dict[bytes, list[int]] = {}
        self._out: dict[tuple[bytes, int, int], list[int]] = {}
        self._durations: dict[bytes, deque[float]] = {}
        self._abandoned: dict[bytes, int] = {}
        self._next = 1
        self._changed: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._leases)

    def held_by(self, worker: bytes) -> int:
        """Clips that this worker has to decode for the leases that are out to it.

        Of those that nobody waits for any more each counts, lest a clip that is asked for anew hides behind an old one.
        """
        requests = [self._leases[number].request for number in self._held.get(worker, ())]
        return len({request.clip for request in requests if request is not None}) + requests.count(None)

    def holds(self, worker: bytes) -> bool:
        """Whether this worker holds any lease."""
        return worker in self._held

    @property
    def holders(self) -> int:
        """Workers that hold any lease."""
        return len(self._held)

    def take_changed(self) -> set[bytes]:
        """Workers that hold more or less than at the last call, or something that nobody waits for any more."""
        changed, self._changed = self._changed, set()
        return changed

    def requests_of(self, worker: bytes) -> Iterator[Request]:
        """The requests that this worker holds and somebody still waits for."""
        for number in self._held.get(worker, ()):
            request = self._leases[number].request
            if request is not None:
                yield request

    def in_work(self, worker: bytes) -> tuple[Request | None, float] | None:
        """What this worker is at, as far as it said, and since when. The request is None where nobody waits for it any
        more; None where the worker has begun nothing."""
        for number in self._held.get(worker, ()):
            lease = self._leases[number]
            if lease.begun_at is not None:
                return lease.request, lease.begun_at
        return None

    def request(self, number: int, worker: bytes) -> Request | None:
        """What this worker's lease asks for; None when nobody waits for its answer."""
        lease = self._leases.get(number)
        return None if lease is None or lease.worker != worker else lease.request

    def grant(self, request: Request, worker: bytes, now: float, work_seconds: float = 0.0) -> int:
        """Give the request to a worker.

        Args:
            request, worker: who makes what.
            now: the time.
            work_seconds: what the work may take; the deadline is so much later.

        Returns:
            the number of the lease.
        """
        number = self._next
        self._next += 1
        # It waits behind the others.
        limit = max(
            [self.deadline_seconds + work_seconds, *(self._leases[n].limit_seconds for n in self._held.get(worker, ()))]
        )
        self._leases[number] = _Grant(request, worker, now, limit)
        self._held.setdefault(worker, []).append(number)
        self._out.setdefault(request.sample, []).append(number)
        self._changed.add(worker)
        return number

    def mark_begun(self, number: int, worker: bytes, now: float) -> None:
        """The worker started on it. The clock of those queued behind it starts again: they wait through no fault.

        A lease begins once: said again it would put off the deadline for ever.
        """
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker or lease.begun_at is not None:
            return
        lease.begun_at = now
        for other in map(self._leases.__getitem__, self._held[worker]):
            other.since, other.stopped_seconds, other.queued_seconds = now, 0.0, 0.0
            other.limit_seconds = max(other.limit_seconds, lease.limit_seconds)

    def extend_deadlines(self, worker: bytes, stalled: Stall) -> None:
        """The worker was kept from working for so long, which counts as no time.

        One that stays stopped is overdue all the same, after twice its time: somebody waits for its samples. One that
        waits for a core gets one in the end; to end it would only cost more of them. Meanwhile its samples may be given
        to a second worker (:meth:`slow`).
        """
        for number in self._held.get(worker, ()):
            lease = self._leases[number]
            lease.stopped_seconds = min(lease.stopped_seconds + stalled.stopped_seconds, lease.limit_seconds)
            lease.queued_seconds += stalled.queued_seconds
            if lease.begun_at is not None:
                lease.begun_at += stalled.stopped_seconds

    def limit_seconds(self, worker: bytes) -> float:
        """How long the worker may be silent over what it holds."""
        return max((self._leases[n].limit_seconds for n in self._held.get(worker, ())), default=self.deadline_seconds)

    def abandoned(self, session: bytes) -> int:
        """Leases out for samples that this consumer asked for and gave up before they were made."""
        return self._abandoned.get(session, 0)

    def debt(self, number: int, worker: bytes, now: float) -> tuple[bytes, float] | None:
        """Who gave up the sample of this lease before it was made, and the seconds that it took all the same."""
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker or lease.debtor is None or lease.begun_at is None:
            return None
        return lease.debtor, now - lease.begun_at

    def finished(self, number: int, worker: bytes, now: float, *, decoded: bool = True) -> Request | None:
        """The worker answered, well or badly.

        Args:
            number, worker: of the lease.
            now: the time.
            decoded: whether a clip was decoded for it. What a sibling of a decoded one takes says nothing of how long
                a clip may take.

        Returns:
            the request, or None when nobody waits for this answer: the lease had been taken away from the worker, the
            consumer is gone, or the twin was faster.
        """
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker:
            return None
        request = lease.request
        if request is not None:
            if lease.begun_at is not None and decoded:
                remembered = self._durations.setdefault(request.session, deque(maxlen=_REMEMBERED))
                remembered.append(now - lease.begun_at)
            self._retire(request.sample)
        self._drop(number)
        return request

    def lost(self, worker: bytes, at: int | None = None) -> list[tuple[Request, bool]]:
        """The worker is gone.

        Args:
            worker: which one.
            at: number of the lease it was at by its own record; None goes by what it announced.

        Returns:
            those of its requests that nobody else is at, oldest first, each with whether it had been begun;
            without their slots, where this worker may still write.
        """
        returned = []
        for number in list(self._held.get(worker, ())):
            lease = self._leases[number]
            self._drop(number)
            if lease.request is not None and lease.request.sample not in self._out:
                begun = lease.begun_at is not None if at is None else number == at
                returned.append((replace(lease.request, slot=None), begun))
        return returned

    def overdue(self, now: float) -> set[bytes]:
        """Workers with a lease past its deadline. Their leases stay out until they are given up (:meth:`lost`)."""
        return {
            lease.worker
            for lease in self._leases.values()
            if now > lease.since + lease.limit_seconds + lease.stopped_seconds + lease.queued_seconds
        }

    def slow(self, now: float) -> list[tuple[Request, bytes]]:
        """For each session its oldest request, with its worker, if it is slow and nobody else is at it.

        Counted from when its worker last began something, so that a request queued behind one that hangs is slow too.
        """
        oldest: dict[bytes, _Grant] = {}
        for lease in self._leases.values():
            if lease.request is not None:
                oldest.setdefault(lease.request.session, lease)
        found = []
        for session, lease in oldest.items():
            durations = self._durations.get(session, ())
            if lease.request is None or len(durations) < _LEAST_REMEMBERED:
                continue
            limit = max(_LEAST_SLOW_SECONDS, SLOW_FACTOR * statistics.median(durations))
            if now - lease.since > limit and len(self._out[lease.request.sample]) == 1:
                found.append((lease.request, lease.worker))
        return found

    def forget_session(self, session: bytes) -> None:
        """The consumer is gone: answers to its leases will find nothing.

        The leases stay with their workers, which do not know and work through them: that is room they do not have for
        others, and time for which those queued behind must not be called overdue.
        """
        self._durations.pop(session, None)
        for sample in [sample for sample in self._out if sample[0] == session]:
            for number in self._out[sample]:
                self._leases[number].debtor = session
                self._abandoned[session] = self._abandoned.get(session, 0) + 1
            self._retire(sample)

    def _retire(self, sample: tuple[bytes, int, int]) -> None:
        for number in self._out.pop(sample, ()):
            self._leases[number].request = None
            self._changed.add(self._leases[number].worker)

    def _drop(self, number: int) -> None:
        lease = self._leases.pop(number)
        if lease.debtor is not None:
            self._abandoned[lease.debtor] -= 1
            if not self._abandoned[lease.debtor]:
                del self._abandoned[lease.debtor]
        self._changed.add(lease.worker)
        held = self._held[lease.worker]
        held.remove(number)
        if not held:
            del self._held[lease.worker]
        if lease.request is not None:
            out = self._out[lease.request.sample]
            out.remove(number)
            if not out:
                del self._out[lease.request.sample]
