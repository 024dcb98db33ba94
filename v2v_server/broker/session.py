"""Track what each consumer asked for, its credit, and the order of service. No I/O; time is passed in.

The server keeps no position: a consumer asks for indices, each of which is one unit of its credit until it is answered,
and an index that was answered is forgotten. So a session can be dropped and opened again at any time.

Worker time is shared by deficit round robin (:class:`FairQueue`). A repeated Hello changes none of
this: the new session takes over the debt of the old one, and its abandoned requests count against its credit until the
workers have finished them.

Memory: a session's samples in work and those that its consumer has not read are together at most its credit. Its
unread bytes are at most an equal share of MOST_IN_FLIGHT_BYTES, or one sample. So a consumer that never reads holds at
most its credit, all of them together hold about MOST_IN_FLIGHT_BYTES, and none delays the others.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TypeAlias

from v2v_protocol.arena import Slot
from v2v_protocol.errors import LimitExceeded
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import MOST_IN_FLIGHT_BYTES
from v2v_protocol.sample import Form, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import LeaseBook, Request, runs_alone
from v2v_server.schedule import Schedule, VideoSequence

GONE_SECONDS = 10.0
"""Time that a consumer has to return to its session after its connection ended."""
SILENT_SECONDS = 60.0
AWAY_SECONDS = 2.0
"""Between two epochs a consumer is away for a shorter time."""
RETURN_SECONDS = 60.0
"""A consumer that says Hello within this time of the last message of one with the same name continues its totals."""
_MOST_DEPARTED = 1024
"""Number of departed consumers whose totals are remembered; the oldest is dropped first."""
_SECOND_NS = 1_000_000_000
_QUANTUM_NS = _SECOND_NS // 20
_MOST_DEBTS = 4096
"""Number of debts remembered for absent consumers; the oldest is dropped first."""

_Entry: TypeAlias = tuple[bool, int]  # (whether in debt, key among such consumers)


@dataclass(slots=True)
class _Balance:
    turn: int
    balance_ns: int = 0  # without what a waiting debtor has earned
    entry: _Entry | None = None  # None: does not wait


class FairQueue:
    """Order in which waiting consumers are served: deficit round robin.

    Shreedhar and Varghese, "Efficient fair queuing using deficit round robin", SIGCOMM 1995. The cost of a sample is
    known only once it is made, so a consumer pays afterwards. Consumers that wait are served in turn while their
    balance is not negative. If all of them are in debt, each earns the same number of quanta, so that the smallest debt
    is paid. A consumer whose samples take ten times the work therefore gets a tenth of the samples, not ten times the
    time.

        waiting, balance >= 0     sorted by turn: the consumer that was served longest ago comes first
        waiting, balance < 0      sorted by the earnings that pay the debt: ``earned`` of the queue minus the balance
        not waiting               in neither list; earns nothing

    Quanta are not added to every balance: the queue counts what each waiting debtor has earned. Balances are whole
    nanoseconds, so that this sum is exact.

    Attributes:
        debts_ns: of absent consumers.
        waiting: (key, consumer) of the solvent ones, and of those in debt, each sorted.
    """

    def __init__(self) -> None:
        self._accounts: dict[bytes, _Balance] = {}
        self.debts_ns: dict[bytes, int] = {}
        self._turns = count()
        self._earned_ns = 0
        self.waiting: tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]] = [], []

    def add(self, identity: bytes, debtors: Iterable[bytes] = ()) -> None:
        """Add a consumer, which does not wait yet.

        Args:
            identity: the consumer.
            debtors: absent consumers whose debts it takes over.
        """
        debt_ns = sum(self.debts_ns.pop(each, 0) for each in debtors)
        self._accounts[identity] = _Balance(next(self._turns), -debt_ns)

    def remove(self, identity: bytes) -> None:
        """Remove a consumer; its debt is remembered."""
        self.set_waiting(identity, waits=False)
        balance_ns = self._accounts.pop(identity).balance_ns
        if balance_ns < 0:
            self._remember(identity, -balance_ns)

    def charge(self, identity: bytes, seconds: float) -> None:
        """Charge worker time to a consumer, whether it is present or not."""
        cost_ns = round(seconds * _SECOND_NS)
        account = self._accounts.get(identity)
        if account is None:
            self._remember(identity, cost_ns)
        else:
            self._settle(identity, self.balance_ns(identity) - cost_ns, waits=account.entry is not None)

    def balance_ns(self, identity: bytes) -> int:
        """Return what a consumer has earned and not used, nanoseconds; negative: its debt."""
        account = self._accounts[identity]
        in_debt, key = account.entry or (False, 0)
        return self._earned_ns - key if in_debt else account.balance_ns

    def drop_savings(self, identity: bytes) -> None:
        """Drop what an idle consumer has earned and not used.

        A debt stays; otherwise asking for one sample at a time would be free. The debt is at most the cost of the
        samples that were in work at the same time.
        """
        account = self._accounts[identity]
        account.balance_ns = min(account.balance_ns, 0)

    def set_waiting(self, identity: bytes, *, waits: bool) -> None:
        """Note whether a consumer waits for a worker."""
        if waits != (self._accounts[identity].entry is not None):
            self._settle(identity, self.balance_ns(identity), waits=waits)

    def next(self) -> bytes | None:
        """Return the consumer to serve, and put its next turn behind those of all others; None if none waits."""
        solvent, debtors = self.waiting
        if not solvent:
            if not debtors:
                return None
            smallest_ns = debtors[0][0] - self._earned_ns
            self._earned_ns += (smallest_ns // _QUANTUM_NS + 1) * _QUANTUM_NS
            while debtors and debtors[0][0] <= self._earned_ns:
                debtor = debtors[0][1]
                self._settle(debtor, self.balance_ns(debtor), waits=True)
        identity = solvent[0][1]
        self._accounts[identity].turn = next(self._turns)
        self._settle(identity, self.balance_ns(identity), waits=True)
        return identity

    def _settle(self, identity: bytes, balance_ns: int, *, waits: bool) -> None:
        """Set a balance, and move the consumer to where it belongs."""
        account = self._accounts[identity]
        if account.entry is not None:
            in_debt, key = account.entry
            queue = self.waiting[in_debt]
            del queue[bisect_left(queue, (key, identity))]
        account.balance_ns, account.entry = balance_ns, None
        if waits:
            account.entry = (True, self._earned_ns - balance_ns) if balance_ns < 0 else (False, account.turn)
            insort(self.waiting[account.entry[0]], (account.entry[1], identity))

    def _remember(self, identity: bytes, debt_ns: int) -> None:
        self.debts_ns[identity] = self.debts_ns.pop(identity, 0) + debt_ns
        if len(self.debts_ns) > _MOST_DEBTS:
            del self.debts_ns[next(iter(self.debts_ns))]


@dataclass(slots=True)
class ConsumerTotals:
    """What a consumer got in all of its sessions: a trainer opens one for each epoch, and after each reconnect.

    Attributes:
        number: of the consumer, from 0; no other one has it.
        since: when it came, or returned after :data:`AWAY_SECONDS` or more.
        left_at: when its last session ended; None while it has one.
        present_seconds: for how long it was there before ``since``.
        served: samples sent.
        waited_seconds: time that it waited for samples, as it reports.
        passed: by how many indices its position advanced, over all epochs.
    """

    number: int
    since: float
    left_at: float | None = None
    present_seconds: float = 0.0
    served: int = 0
    waited_seconds: float = 0.0
    passed: int = 0

    def present(self, now: float) -> float:
        """Return for how long it was there until now; pauses shorter than :data:`AWAY_SECONDS` count."""
        return self.present_seconds + (now if self.left_at is None else self.left_at) - self.since

    def resume(self, now: float) -> None:
        """Note a new session of the consumer."""
        if self.left_at is not None and now - self.left_at >= AWAY_SECONDS:
            self.present_seconds, self.since = self.present(now), now
        self.left_at = None


@dataclass(slots=True)
class Session:
    """One consumer.

    Attributes:
        identity: its routing id.
        spec, seed, arrays, batch_size: what it asked for.
        schedule: the order of its samples.
        credit: largest number of indices that it may have requested and not yet received.
        liveness: when it was last heard.
        waiting: requests without a worker, in the order of the request.
        unanswered: every requested (epoch, index) that is not yet answered.
        totals: what it got, this session and earlier ones.
        quarantine: number of the quarantine snapshot that its samples are made under.
        left_at: when its connection ended; None while it is connected, as far as is known.
        since: when it was opened.
        packed: whether it asks for compressed arrays.
        name, host: names that the consumer gives for itself.
        epoch: the epoch that it last requested samples of.
        position: index after the highest answered index of that epoch; before the first answer, the lowest requested.
        waited_seconds: time that it has waited for samples since its Hello, as it reports.
        user: name of its connection's key; empty without keys.
        owner: digest of that key and of the secret of its Hello; empty without a secret.
        form: the form of one of its samples.
    """

    identity: bytes
    spec: StreamSpec
    seed: int
    arrays: tuple[str, ...]
    batch_size: int
    schedule: Schedule
    credit: int
    liveness: Liveness
    waiting: deque[Request] = field(default_factory=deque)
    unanswered: set[tuple[int, int]] = field(default_factory=set)
    quarantine: int = 0
    left_at: float | None = None
    since: float = 0.0
    packed: bool = False
    name: str = ""
    host: str = ""
    epoch: int = 0
    position: int = 0
    waited_seconds: float = 0.0
    user: str = ""
    owner: bytes = b""

    totals: ConsumerTotals = field(init=False)
    form: Form = field(init=False)

    def __post_init__(self) -> None:
        self.totals = ConsumerTotals(0, self.since)
        self.form = Form.of(array_layout(self.spec.recipe, self.spec.voxel_dtype, self.arrays))

    def mark_heard(self, now: float) -> None:
        """Note a message from the consumer."""
        self.liveness.mark_heard(now)
        self.left_at = None

    def add_wait(self, seconds: float, now: float) -> float:
        """Update the consumer's total waiting time.

        Args:
            seconds: the new total as the consumer reports it.
            now: monotonic time, seconds.

        Returns:
            the increase, bounded by the age of the session.
        """
        more = max(0.0, min(seconds, now - self.since) - self.waited_seconds)
        self.waited_seconds += more
        self.totals.waited_seconds += more
        return more

    def current(self, request: Request) -> Request:
        """Return the request under the session's quarantine snapshot.

        Another snapshot may refuse other candidates. So the request starts again at the first candidate, as a later
        remake of the sample does.
        """
        if request.snapshot == self.quarantine:
            return request
        deaths = 0 if request.candidate else request.deaths
        return replace(request, snapshot=self.quarantine, candidate=0, refusals=(), deaths=deaths)

    def sequence(self, request: Request) -> VideoSequence:
        """Return the sequence of the request's candidate."""
        return self.schedule.candidate(self.seed, request.epoch, request.index, request.candidate)

    @property
    def display(self) -> tuple[object, ...]:
        """Return what identifies the consumer in the status. Its secret does not: it changes with each epoch."""
        return self.user, self.name, self.host, self.spec.digest, self.seed


class Sessions:
    """All consumers, and the order in which they are served.

    Args:
        leases: the leases that are out. They say how many samples workers still make that a consumer abandoned in an
            earlier session.

    Attributes:
        queue: the order; it keeps the consumers' accounts of worker time.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self._leases = leases
        self._sessions: dict[bytes, Session] = {}
        self._in_flight: dict[bytes, int] = {}
        self._departed: deque[tuple[tuple[object, ...], ConsumerTotals]] = deque(maxlen=_MOST_DEPARTED)
        self._numbers = count()
        self.queue = FairQueue()

    def __len__(self) -> int:
        return len(self._sessions)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._sessions.values())

    def get(self, identity: bytes) -> Session | None:
        """Return the session of a consumer; None if it has none."""
        return self._sessions.get(identity)

    def open(self, session: Session) -> None:
        """Add a session. It replaces a session with the same routing id or owner: old requests are dropped, the debt
        stays.
        """
        replaced = {session.identity, *self.owned_by(session.owner)}
        for before in replaced:
            self.forget(before)
        session.totals = self._totals_of(session)
        self._sessions[session.identity] = session
        self.queue.add(session.identity, replaced)

    def totals(self) -> Iterator[ConsumerTotals]:
        """Yield the totals of all consumers, and of those that left and may return."""
        yield from (session.totals for session in self)
        yield from (totals for _, totals in self._departed)

    def _totals_of(self, session: Session) -> ConsumerTotals:
        """Return the totals of the consumer that opens a session: those of its last one, if it left a moment ago."""
        wanted, earliest = session.display, session.since - RETURN_SECONDS
        for number in range(len(self._departed) - 1, -1, -1):
            display, totals = self._departed[number]
            if display == wanted and (totals.left_at or 0.0) > earliest:
                del self._departed[number]
                totals.resume(session.since)
                return totals
        return ConsumerTotals(next(self._numbers), session.since)

    def owned_by(self, owner: bytes) -> list[bytes]:
        """Return the routing ids of an owner's sessions; an empty list for an empty owner."""
        return [each.identity for each in self if owner and each.owner == owner]

    def forget(self, identity: bytes) -> None:
        """Drop a session, if there is one; its debt is remembered."""
        session = self._sessions.pop(identity, None)
        if session is not None:
            session.totals.left_at = session.liveness.heard_at
            self._departed.append((session.display, session.totals))
            self.queue.remove(identity)

    def want(self, session: Session, epoch: int, indices: Sequence[int], slots: Sequence[Slot | None] = ()) -> None:
        """Queue requests of a consumer. Samples that it already waits for are not made twice, and keep their slots.

        Args:
            session: of the consumer.
            epoch, indices: which samples.
            slots: where each may be put, in the order of ``indices``; empty: no slots.

        Raises:
            LimitExceeded: the credit would be exceeded; nothing is queued.
            IndexError: an index is outside the epoch; nothing is queued.
        """
        slot_of: dict[int, Slot | None] = dict(zip(indices, slots, strict=True)) if slots else dict.fromkeys(indices)
        new = [index for index in slot_of if (epoch, index) not in session.unanswered]
        for index in new:
            if index >= session.schedule.count:
                raise IndexError(f"index {index} of an epoch of {session.schedule.count} sequences")
        if len(session.unanswered) + len(new) > session.credit:
            raise LimitExceeded(
                f"{len(new)} more samples asked while {len(session.unanswered)} are unanswered; "
                f"the credit is {session.credit}"
            )
        is_first = not (session.unanswered or session.position)
        if new and (is_first or epoch != session.epoch):
            session.epoch, session.position = epoch, min(new)
        for index in new:
            session.unanswered.add((epoch, index))
            place = session.schedule.place(index)
            session.waiting.append(Request(session.identity, epoch, index, place=place, slot=slot_of[index]))
        self._requeue(session)

    def take_waiting(self, session: Session, requests: Collection[Request]) -> None:
        """Take waiting requests of a session that are answered without a worker of their own."""
        session.waiting = deque(request for request in session.waiting if request not in requests)
        self._requeue(session)

    def next_request(self) -> Request | None:
        """Take the next request to give to a worker; None if no session waits."""
        for identity in self._leases.take_released():
            if (session := self._sessions.get(identity)) is not None:
                self._requeue(session)
        if (first := self.queue.next()) is None:
            return None
        session = self._sessions[first]
        request = session.waiting.popleft()
        self._requeue(session)
        return request

    def set_in_flight(self, identity: bytes, nbytes: int) -> Session | None:
        """Note how many bytes are in flight to a peer; return its session if there were more before."""
        before = self._in_flight.pop(identity, 0)
        if nbytes:
            self._in_flight[identity] = nbytes
        if (session := self._sessions.get(identity)) is not None:
            self._requeue(session)
        return session if nbytes < before else None

    def room(self, session: Session) -> int:
        """Return how many more requests of a session may be served now, which may be negative.

        One sample, or 64 KiB of small ones, may have been read although it still counts.
        """
        sample, unread = sum(session.form.sizes), self._in_flight.get(session.identity, 0)
        if unread and unread >= max(sample, MOST_IN_FLIGHT_BYTES // len(self._in_flight)):
            return 0
        at_work = len(session.unanswered) - len(session.waiting) + self._leases.abandoned(session.identity)
        return session.credit - at_work - max(0, unread - max(sample, 1 << 16)) // sample

    def _requeue(self, session: Session) -> None:
        """Queue a session if it has waiting requests and room for them; else dequeue it."""
        self.queue.set_waiting(session.identity, waits=bool(session.waiting) and self.room(session) > 0)

    def take_siblings(self, request: Request) -> list[Request]:
        """Take the waiting requests that are made from the same clip as ``request``."""
        session = self._sessions.get(request.session)
        if session is None or session.spec.samples_per_decode == 1:
            return []
        # Under another snapshot a request returns to its first candidate, and so to another clip.
        clip, waiting = session.current(request).clip, session.waiting
        siblings = [other for other in waiting if session.current(other).clip == clip and not runs_alone(other)]
        for sibling in siblings:
            session.waiting.remove(sibling)
        self._requeue(session)
        return siblings

    def put_back(self, request: Request) -> None:
        """Put a request back that was not answered. It is served next, because its consumer has waited longest for
        it.
        """
        session = self._sessions.get(request.session)
        if session is not None and (request.epoch, request.index) in session.unanswered:
            session.waiting.appendleft(request)
            self._requeue(session)

    def mark_answered(self, request: Request, worker_seconds: float) -> bool:
        """Close a request; return False if it is not wanted: the session is gone, or the request was answered
        before.
        """
        session = self._sessions.get(request.session)
        if session is None or (request.epoch, request.index) not in session.unanswered:
            return False
        session.unanswered.remove((request.epoch, request.index))
        if request.epoch == session.epoch:
            before, session.position = session.position, max(session.position, request.index + 1)
            session.totals.passed += session.position - before
        self.queue.charge(request.session, worker_seconds)
        self._requeue(session)
        if not session.unanswered:
            self.queue.drop_savings(request.session)
        session.totals.served += 1
        return True

    def idle(self, now: float) -> list[bytes]:
        """Return the sessions to forget: silent for too long, or without a connection."""
        return [
            session.identity
            for session in self._sessions.values()
            if session.liveness.is_gone(now) or (session.left_at is not None and now - session.left_at >= GONE_SECONDS)
        ]

    def dispensable(self, now: float) -> list[bytes]:
        """Return the sessions to forget if others need to connect. A live consumer sends a message every few
        seconds.
        """
        return [
            session.identity
            for session in self._sessions.values()
            if session.left_at is not None or session.liveness.silence(now) >= SILENT_SECONDS
        ]
