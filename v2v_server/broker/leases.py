"""Track which worker makes which sample, and which workers there are, have free credit, or are silent. State machines
without I/O; time is passed in.

    pending (in its session's queue) --grant--> leased --begun--> working --finished--> gone
                 ^                                 |                 |
                 `------- returned to its session -+-----------------'   worker lost

A request is one sample that a consumer asked for. Every grant gives it a lease with a new number, so an answer to a
lease that was taken away is recognised by its number and dropped. A request that takes much longer than its consumer's
others is given to a second worker as well; the first answer ends both leases.

What the loss of a worker says about the sample in work:

    crashed, hung                the sample is the cause: its candidate is refused at once and quarantined
    unexplained                  an exception, a lost connection, storage that does not answer: the sample is tried
                                 again; after two such losses it runs alone on its worker, and a third one counts
                                 like a crash, for its spec only: the spec may be the cause
    memory                       killed by the kernel at a limit of memory: the same, but the third one says that the
                                 sample needs more memory than its worker had. A larger worker may make it
    killed                       from outside (pre-emption, an operator): says nothing about any sample

Only the lease that the worker had begun is judged. The leases queued behind it go back unchanged.
"""

from __future__ import annotations

import statistics
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

from v2v_protocol.arena import Slot
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import Notes, Result, WorkerHello
from v2v_protocol.sample import Refusal
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES

ALONE_AFTER = 2
"""Number of unexplained losses after which a sample runs alone."""
SLOW_FACTOR = 3.0
"""A lease in work for this many times the median of its session's decoded clips is slow."""
_LEAST_SLOW_SECONDS = 1.0
_REMEMBERED = 64
_LEAST_REMEMBERED = 8
MOST_WORKERS = 4096
MOST_WORKER_CREDIT = 64
SILENCE_SECONDS = 30.0
"""An idle worker pings every five seconds; after this time without a message it is treated as gone."""
REST_SECONDS = 10.0
"""Time without work for a worker whose host cannot read a video that the server's host can; storage may return."""
LONGEST_NAME = 100
"""Characters kept of the name that a peer gives itself or its host."""
_LONGEST_UNFIT = 600
_MOST_SECONDS = 86_400.0


class Cause(StrEnum):
    """Reason why a worker is gone."""

    CRASHED = "crashed"
    HUNG = "hung"
    UNEXPLAINED = "unexplained"
    MEMORY = "memory"
    KILLED = "killed"


@dataclass(frozen=True, slots=True)
class Loss:
    """Loss of a worker.

    Attributes:
        cause: what it says about the sample in work.
        text: what happened, in words: "was ended by SIGSEGV".
        lease: the lease in work by the worker's own record, 0 for no lease; None without a record. Then the last lease
            that the worker announced counts.
        for_all: whether the video is refused under every spec: only if it was being decoded, or nothing is known, and
            the loss is not unexplained. Otherwise the cause may be what its spec asks for.
    """

    cause: Cause
    text: str
    lease: int | None = None
    for_all: bool = True


def runs_alone(request: Request) -> bool:
    """Return whether the request needs a worker without other leases."""
    return request.deaths >= ALONE_AFTER


def judge(request: Request, loss: Loss) -> Request | str:
    """Judge a request that was begun when its worker was lost.

    Returns:
        the request to try again, or the reason why its candidate is refused.
    """
    if loss.cause is Cause.KILLED:
        return request
    if loss.cause is Cause.MEMORY or (loss.cause is Cause.UNEXPLAINED and not runs_alone(request)):
        return replace(request, deaths=request.deaths + 1)
    return f"a worker {loss.text} over it"


@dataclass(frozen=True, slots=True)
class Request:
    """One sample that a consumer asked for, until it is answered.

    Attributes:
        session: routing id of the consumer.
        epoch, index: which sample.
        candidate: number of the candidate sequence that is being tried, from 0.
        refusals: the candidates that failed before it.
        deaths: unexplained losses of workers over this candidate.
        snapshot: number of the quarantine snapshot under which those candidates were passed over.
        place: position of the index in the epoch's order (:mod:`v2v_server.schedule`); None: the index itself.
        slot: where its consumer lets the sample be put; given to one worker only.
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
        """Key of the decoded clip: requests with equal keys are made from the same frames."""
        return self.session, self.epoch, self.index if self.place is None else self.place, self.candidate

    @property
    def sample(self) -> tuple[bytes, int, int]:
        """Key of the requested sample, independent of the candidate it is made from."""
        return self.session, self.epoch, self.index


@dataclass(slots=True)
class _Lease:
    request: Request | None  # None: answered, or its consumer is gone; the worker still works on it
    worker: bytes
    since: float  # when it was granted, or its worker last began something
    limit_seconds: float  # from ``since`` to the answer
    begun_at: float | None = None
    stopped_seconds: float = 0.0  # time in which its worker was stopped from outside
    queued_seconds: float = 0.0  # time in which its worker waited for a core
    debtor: bytes | None = None  # the consumer that abandoned it; the work is charged to it


@dataclass(frozen=True, slots=True)
class Stall:
    """Time in which a worker could not run, for reasons other than its work.

    Attributes:
        stopped_seconds: stopped from outside, by a signal or a debugger.
        queued_seconds: waiting for a core that ran other processes.
    """

    stopped_seconds: float = 0.0
    queued_seconds: float = 0.0


class LeaseBook:
    """All leases that are out.

    Args:
        deadline_seconds: longest time from the grant, or from the beginning of the work, to the answer, in addition to
            the time that the work itself may take.

    Attributes:
        held: numbers of the leases that each worker holds, in the order of the work.
        out: numbers of the leases of each sample (:attr:`Request.sample`) that is still wanted.
        durations: times that the last decoded clips of each session took, seconds.
    """

    def __init__(self, deadline_seconds: float) -> None:
        self.deadline_seconds = deadline_seconds
        self._leases: dict[int, _Lease] = {}
        self.held: dict[bytes, list[int]] = {}
        self.out: dict[tuple[bytes, int, int], list[int]] = {}
        self.durations: dict[bytes, deque[float]] = {}
        self._abandoned: dict[bytes, int] = {}
        self._released: set[bytes] = set()
        self._next = 1
        self._changed: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._leases)

    def __contains__(self, number: object) -> bool:
        return number in self._leases

    def held_by(self, worker: bytes) -> int:
        """Return the number of clips that this worker has to decode for its leases.

        Abandoned leases count individually; otherwise a repeated request could hide behind an old lease for the same
        clip.
        """
        requests = [self._leases[number].request for number in self.held.get(worker, ())]
        return len({request.clip for request in requests if request is not None}) + requests.count(None)

    def take_changed(self) -> set[bytes]:
        """Return and clear the workers whose leases have changed since the last call, including leases that were
        abandoned.
        """
        changed, self._changed = self._changed, set()
        return changed

    def requests_of(self, worker: bytes) -> Iterator[Request]:
        """Yield the requests that this worker holds and that are still wanted."""
        for number in self.held.get(worker, ()):
            request = self._leases[number].request
            if request is not None:
                yield request

    def in_work(self, worker: bytes) -> tuple[Request | None, float] | None:
        """Return what this worker works on, as far as it said, and since when. The request is None if it was abandoned.
        The result is None if the worker has begun nothing.
        """
        for number in self.held.get(worker, ()):
            lease = self._leases[number]
            if lease.begun_at is not None:
                return lease.request, lease.begun_at
        return None

    def request(self, number: int, worker: bytes) -> Request | None:
        """Return the request behind this worker's lease; None if its answer is no longer wanted."""
        lease = self._leases.get(number)
        return None if lease is None or lease.worker != worker else lease.request

    def grant(self, request: Request, worker: bytes, now: float, work_seconds: float = 0.0) -> int:
        """Give a request to a worker.

        Args:
            request: the sample to make.
            worker: routing id.
            now: monotonic time, seconds.
            work_seconds: longest time that the work may take; added to the deadline.

        Returns:
            the number of the lease.
        """
        number = self._next
        self._next += 1
        # It waits behind the others.
        limit = max(
            [self.deadline_seconds + work_seconds, *(self._leases[n].limit_seconds for n in self.held.get(worker, ()))]
        )
        self._leases[number] = _Lease(request, worker, now, limit)
        self.held.setdefault(worker, []).append(number)
        self.out.setdefault(request.sample, []).append(number)
        self._changed.add(worker)
        return number

    def mark_begun(self, number: int, worker: bytes, now: float) -> None:
        """Note that the worker has begun this lease, and restart the clock of the leases queued behind it.

        A lease begins once: otherwise a worker could extend its deadline without end by repeating the message.
        """
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker or lease.begun_at is not None:
            return
        lease.begun_at = now
        for other in map(self._leases.__getitem__, self.held[worker]):
            other.since, other.stopped_seconds, other.queued_seconds = now, 0.0, 0.0
            other.limit_seconds = max(other.limit_seconds, lease.limit_seconds)

    def extend_deadlines(self, worker: bytes, stalled: Stall) -> None:
        """Exclude the time in which a worker could not run from its deadlines.

        A worker that stays stopped is overdue after twice its time, because a consumer waits for its samples. A worker
        that waits for a core is not: it gets one eventually, and replacing it would use more cores. Meanwhile its
        samples may be given to a second worker (:meth:`slow`).
        """
        for number in self.held.get(worker, ()):
            lease = self._leases[number]
            lease.stopped_seconds = min(lease.stopped_seconds + stalled.stopped_seconds, lease.limit_seconds)
            lease.queued_seconds += stalled.queued_seconds
            if lease.begun_at is not None:
                lease.begun_at += stalled.stopped_seconds

    def limit_seconds(self, worker: bytes) -> float:
        """Return how long the worker may be silent over its current leases, seconds."""
        return max((self._leases[n].limit_seconds for n in self.held.get(worker, ())), default=self.deadline_seconds)

    def abandoned(self, session: bytes) -> int:
        """Return the number of leases out for samples that this consumer asked for and then abandoned."""
        return self._abandoned.get(session, 0)

    def take_released(self) -> set[bytes]:
        """Return and clear the consumers that have fewer abandoned leases than at the last call."""
        released, self._released = self._released, set()
        return released

    def debt(self, number: int, worker: bytes, now: float) -> tuple[bytes, float] | None:
        """Return the consumer that abandoned this lease's sample, and the seconds of work on it; None if it is still
        wanted.
        """
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker or lease.debtor is None or lease.begun_at is None:
            return None
        return lease.debtor, now - lease.begun_at

    def finished(self, number: int, worker: bytes, now: float, *, decoded: bool = True) -> Request | None:
        """Close a lease that the worker answered with a sample or a failure.

        Args:
            number, worker: the lease and its holder.
            now: monotonic time, seconds.
            decoded: whether a clip was decoded for it. Samples that reuse a decoded clip are too fast to estimate
                decode time from.

        Returns:
            the request; None if the answer is not wanted: the lease was taken away from the worker, the consumer is
            gone, or a second worker was faster.
        """
        lease = self._leases.get(number)
        if lease is None or lease.worker != worker:
            return None
        request = lease.request
        if request is not None:
            if lease.begun_at is not None and decoded:
                remembered = self.durations.setdefault(request.session, deque(maxlen=_REMEMBERED))
                remembered.append(now - lease.begun_at)
            self._retire(request.sample)
        self._drop(number)
        return request

    def lost(self, worker: bytes, at: int | None = None) -> list[tuple[Request, bool]]:
        """Take back all leases of a worker that is gone.

        Args:
            worker: routing id.
            at: number of the lease in work by the worker's own record; None: the lease that it last announced.

        Returns:
            its requests that no other worker holds, oldest first, each with whether it had been begun. They lose their
            slots, because this worker may still write to them.
        """
        returned = []
        for number in list(self.held.get(worker, ())):
            begun = self._leases[number].begun_at is not None if at is None else number == at
            request = self.recall(number)
            if request is not None and request.sample not in self.out:
                returned.append((replace(request, slot=None), begun))
        return returned

    def recall(self, number: int) -> Request | None:
        """Drop a lease, and return its request, which a second worker may still hold; None if it is not wanted or the
        lease has ended.
        """
        lease = self._leases.get(number)
        if lease is None:
            return None
        self._drop(number)
        return lease.request

    def overdue(self, now: float) -> set[bytes]:
        """Return the workers with a lease past its deadline. Their leases stay out until the workers are given up
        (:meth:`lost`).
        """
        return {
            lease.worker
            for lease in self._leases.values()
            if now > lease.since + lease.limit_seconds + lease.stopped_seconds + lease.queued_seconds
        }

    def slow(self, now: float) -> list[tuple[Request, bytes]]:
        """Return each session's oldest request, with its worker, if it is slow and no second worker has it.

        The time counts from when its worker last began something, so a request queued behind a hanging one is slow too.
        """
        oldest: dict[bytes, _Lease] = {}
        for lease in self._leases.values():
            if lease.request is not None:
                oldest.setdefault(lease.request.session, lease)
        found = []
        for session, lease in oldest.items():
            durations = self.durations.get(session, ())
            if lease.request is None or len(durations) < _LEAST_REMEMBERED:
                continue
            limit = max(_LEAST_SLOW_SECONDS, SLOW_FACTOR * statistics.median(durations))
            if now - lease.since > limit and len(self.out[lease.request.sample]) == 1:
                found.append((lease.request, lease.worker))
        return found

    def forget_session(self, session: bytes) -> None:
        """Abandon the requests of a consumer that is gone.

        Their leases stay with the workers, which do not know and finish them. Until then they occupy the workers, and
        the leases queued behind them must not become overdue.
        """
        self.durations.pop(session, None)
        for sample in [sample for sample in self.out if sample[0] == session]:
            for number in self.out[sample]:
                self._leases[number].debtor = session
                self._abandoned[session] = self._abandoned.get(session, 0) + 1
            self._retire(sample)

    def _retire(self, sample: tuple[bytes, int, int]) -> None:
        for number in self.out.pop(sample, ()):
            self._leases[number].request = None
            self._changed.add(self._leases[number].worker)

    def _drop(self, number: int) -> None:
        lease = self._leases.pop(number)
        if lease.debtor is not None:
            self._released.add(lease.debtor)
            self._abandoned[lease.debtor] -= 1
            if not self._abandoned[lease.debtor]:
                del self._abandoned[lease.debtor]
        self._changed.add(lease.worker)
        held = self.held[lease.worker]
        held.remove(number)
        if not held:
            del self.held[lease.worker]
        if lease.request is not None:
            out = self.out[lease.request.sample]
            out.remove(number)
            if not out:
                del self.out[lease.request.sample]


@dataclass(slots=True)
class WorkDone:
    """Totals of the time that samples took, as reported by the workers.

    Attributes:
        samples: number of samples.
        cpu_seconds: processor time.
        decode_seconds, simulate_seconds, handover_seconds: wall-clock time for decoding clips, for building the arrays,
            and for delivering them to their consumers.
    """

    samples: int = 0
    cpu_seconds: float = 0.0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0

    def add(self, result: Result, cpu_seconds: float) -> None:
        """Add one sample."""
        self.samples += 1
        self.cpu_seconds += bounded_seconds(cpu_seconds)
        self.decode_seconds += bounded_seconds(result.decode_seconds)
        self.simulate_seconds += bounded_seconds(result.simulate_seconds)
        self.handover_seconds += bounded_seconds(result.handover_seconds)

    @property
    def busy_seconds(self) -> float:
        """Wall-clock time of all three parts."""
        return self.decode_seconds + self.simulate_seconds + self.handover_seconds


def bounded_seconds(said: float) -> float:
    """Clip a duration that a worker reported to a plausible range: 0 to one day, seconds."""
    return min(max(said, 0.0), _MOST_SECONDS)


@dataclass(slots=True)
class Member:
    """A worker that said hello.

    Attributes:
        name: name from its hello, by which its supervisor knows it.
        credit: number of leases that it accepts at a time.
        liveness: when it was last heard.
        host: the host that it names.
        user: name of the key of its connection; empty without keys, and for a worker of this host.
        owner: digest of user and secret of its hello; empty without a secret.
        given_up: whether it hangs or is silent; then it gets no more work.
        unreadable: why its host could not read the last video; empty once it has made a sample since.
        work: totals of its samples that were wanted.
        memory_bytes: memory of its process as last reported; 0: not known.
        limit_bytes: limit of its memory, its own or that of its host.
        takes_notes: whether its hello has notes; a worker of a release before them refuses a message that has any.
    """

    name: str
    credit: int
    liveness: Liveness
    host: str = ""
    user: str = ""
    owner: bytes = b""
    given_up: bool = False
    unreadable: str = ""
    work: WorkDone = field(default_factory=WorkDone)
    memory_bytes: int = 0
    limit_bytes: int = LARGEST_MEMORY_BYTES
    takes_notes: bool = False


def _bounded_credit(stated: int) -> int:
    return max(1, min(stated, MOST_WORKER_CREDIT))


def clean_name(text: str, most: int = LONGEST_NAME) -> str:
    """Make a name, or another text that a peer sent, safe to display: short, and without control characters."""
    return "".join(filter(str.isprintable, text[:most]))


class Workers:
    """Workers that said hello and are alive as far as is known.

    Args:
        leases: the leases that they hold.

    Attributes:
        members: all of them by routing id.
        resting: time at which the rest of those ends that get no work for a while.
        least_memory, most_memory: smallest and largest limit of a worker's memory, bytes; 0 without workers.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self.least_memory = self.most_memory = 0
        self._leases = leases
        self.members: dict[bytes, Member] = {}
        self._names: dict[str, bytes] = {}
        self._unfit = ""  # why the last worker left that cannot work for this server, until a worker makes a sample
        self.resting: dict[bytes, float] = {}
        # With a thousand workers, only those whose load has changed are examined.
        self._changed: set[bytes] = set()
        self._held: dict[bytes, int] = {}  # leases of each worker with free credit
        self._room: list[tuple[int, bytes]] = []  # the same, sorted

    def name_of(self, identity: bytes) -> str:
        """Return the name of a worker; empty if it has not said hello."""
        worker = self.members.get(identity)
        return "" if worker is None else worker.name

    def named(self, name: str) -> bytes | None:
        """Return the routing id of the worker of that name; None if there is none."""
        return self._names.get(name)

    def add(self, identity: bytes, hello: WorkerHello, now: float, user: str = "", owner: bytes = b"") -> None:
        """Add a worker that said hello; none of that routing id or name is there."""
        liveness = Liveness(now, gone_seconds=SILENCE_SECONDS)
        limit_bytes = min(hello.notes.memory_bytes or LARGEST_MEMORY_BYTES, LARGEST_MEMORY_BYTES)
        self.members[identity] = Member(
            hello.name, _bounded_credit(hello.credit), liveness, clean_name(hello.host), user, owner,
            limit_bytes=limit_bytes, takes_notes=hello.notes != Notes(),
        )  # fmt: skip
        self._names[hello.name] = identity
        self._weigh()
        self._changed.add(identity)

    def note_unfit(self, reason: str) -> None:
        """Note why a worker leaves that cannot work for this server; "": it leaves for another reason."""
        self._unfit = clean_name(reason, _LONGEST_UNFIT) or self._unfit

    def remove(self, identity: bytes) -> None:
        """Remove a worker that is gone."""
        worker = self.members.pop(identity, None)
        if worker is not None:
            del self._names[worker.name]
            self._weigh()
        self.resting.pop(identity, None)
        self._changed.add(identity)

    def mark_heard(self, identity: bytes, now: float) -> bool:
        """Note a message from a worker; return False if it has not said hello."""
        worker = self.members.get(identity)
        if worker is None:
            return False
        worker.liveness.mark_heard(now)
        return True

    def set_credit(self, identity: bytes, credit: int) -> None:
        """Set how many leases a worker takes at a time; 0: no change. Those that it holds stay."""
        if credit:
            self.members[identity].credit = _bounded_credit(credit)
            self._changed.add(identity)

    def worked(self, identity: bytes, result: Result, cpu_seconds: float) -> None:
        """Add a wanted sample to the worker's totals."""
        worker = self.members.get(identity)
        if worker is not None:
            worker.work.add(result, cpu_seconds)
            worker.memory_bytes = result.memory_bytes

    def can_work(self, identity: bytes) -> None:
        """Note that a worker has made a sample, so its host can read videos."""
        if identity in self.members:
            self.members[identity].unreadable = self._unfit = ""

    def trouble(self, expected: int) -> str:
        """Return why no worker can make a sample, and what to do about it; empty if one can, as far as is known.

        Args:
            expected: number of workers expected.
        """
        if self._unfit and not self._leases.held:
            return f"a worker left: it {self._unfit}"
        if not self.members:
            start = f"{expected} should come; see what v2v-serve says of them" if expected else "start v2v-worker"
            return f"no worker is connected to the server: {start}, or v2v-serve with --workers N"
        reasons = [worker.unreadable for worker in self.members.values()]
        if not all(reasons):
            return ""
        return (
            f"none of the server's workers ({len(reasons)}) can read its videos: {reasons[0]:.300}; give v2v-worker "
            "the folder that v2v-serve has (--videos)"
        )

    def rest(self, identity: bytes, now: float, unreadable: str) -> None:
        """Give a worker no work for a while, because its host could not read a video."""
        if identity in self.members:
            self.members[identity].unreadable = unreadable
            self.resting[identity] = now + REST_SECONDS
            self._changed.add(identity)

    def wake(self, now: float) -> None:
        """Give work again to workers whose rest is over."""
        rested = [identity for identity, until in self.resting.items() if now >= until]
        for identity in rested:
            del self.resting[identity]
        self._changed.update(rested)

    def hanging(self, now: float) -> list[bytes]:
        """Return workers with an overdue lease. Each is returned once, and gets no more work."""
        return self._give_up(identity for identity in self._leases.overdue(now) if identity in self.members)

    def vanished(self, now: float) -> list[bytes]:
        """Return workers without leases that have been silent for too long. Each is returned once, and gets no more
        work.
        """
        return self._give_up(
            identity
            for identity, worker in self.members.items()
            if not self._leases.held_by(identity) and worker.liveness.is_gone(now)
        )

    def for_request(
        self, *, kept_bytes: int | None = None, other_than: bytes | None = None, needs_bytes: int = 0
    ) -> bytes | None:
        """Return the worker that holds the fewest leases and has free credit; None if there is none.

        Args:
            kept_bytes: a request that runs alone waits, so the worker with this much memory and the fewest leases gets
                no new ones; None: no request waits so.
            other_than: a worker to skip, because it is slow at this request.
            needs_bytes: memory that the worker must have.
        """
        kept = None if kept_bytes is None else self._lightest(kept_bytes)
        return self._lightest(needs_bytes, kept, other_than)

    def for_lone_request(self, needs_bytes: int = 0) -> bytes | None:
        """Return a worker that holds no lease and has that much memory; None if there is none."""
        lightest = self._lightest(needs_bytes)
        return None if lightest is None or self._held[lightest] else lightest

    def _lightest(self, needs_bytes: int, *others: bytes | None) -> bytes | None:
        """Return the worker with that much memory that holds the fewest leases and has free credit, except others."""
        suited = (each for _, each in self.with_room() if self.members[each].limit_bytes >= needs_bytes)
        return next((each for each in suited if each not in others), None)

    def _give_up(self, found: Iterable[bytes]) -> list[bytes]:
        given_up = [identity for identity in found if not self.members[identity].given_up]
        for identity in given_up:
            self.members[identity].given_up = True
        self._changed.update(given_up)
        self._weigh()
        return given_up

    def _weigh(self) -> None:
        limits = [member.limit_bytes for member in self.members.values() if not member.given_up]
        self.least_memory, self.most_memory = min(limits, default=0), max(limits, default=0)

    def with_room(self) -> list[tuple[int, bytes]]:
        """Return (leases held, routing id) of the workers with free credit, fewest leases first; ties by routing id."""
        changed, self._changed = self._changed | self._leases.take_changed(), set()
        for identity in changed:
            if (before := self._held.pop(identity, None)) is not None:
                del self._room[bisect_left(self._room, (before, identity))]
            worker, held = self.members.get(identity), self._leases.held_by(identity)
            if worker is None or worker.given_up or identity in self.resting:
                continue
            if held < worker.credit and not self._is_alone(identity):
                self._held[identity] = held
                insort(self._room, (held, identity))
        return self._room

    def _is_alone(self, identity: bytes) -> bool:
        """Return whether the worker holds a request that runs alone, which leaves no credit."""
        return any(runs_alone(request) for request in self._leases.requests_of(identity))
