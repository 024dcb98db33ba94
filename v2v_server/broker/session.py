"""Consumer sessions: what each consumer asked for, how much credit it has, whose turn it is. No I/O; time is passed in.

The server keeps no position: a consumer asks for indices, each of which is one unit of its credit until it is answered,
and an index that was answered is forgotten. So a session can be dropped and opened again at any time.

Worker time is shared by deficit round robin (Shreedhar and Varghese, "Efficient fair queuing using deficit round
robin", SIGCOMM 1995). What a sample costs is known only once it is made, so a session pays afterwards: it may be served
while its balance is positive, and when none is, all waiting sessions earn one quantum. A consumer whose samples take
ten times the work so gets a tenth of the samples, not ten times the time.

Hello again changes none of this: a session that is opened anew pays the debt of the one before it, and what that one
had asked for and nobody waits for any more counts as asked until the workers are through with it.

Memory: the server holds at most credit x sample bytes for a session in its queues, whatever the consumer does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from v2v_protocol.arena import Slot
from v2v_protocol.errors import LimitExceeded
from v2v_protocol.liveness import Liveness
from v2v_protocol.sample import Form, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.blame import runs_alone
from v2v_server.broker.leases import Request
from v2v_server.schedule.epoch import Schedule

_QUANTUM_SECONDS = 0.05
GONE_SECONDS = 10.0
"""After its connection ended a consumer has so long to come back to its session."""
SILENT_SECONDS = 60.0
_MOST_DEBTS = 4096
"""Debts remembered of consumers that are not there; the oldest goes first."""


@dataclass(slots=True)
class Session:
    """One consumer.

    Attributes:
        identity: its routing identity.
        spec, seed, arrays, batch_size: what it asked for.
        schedule: the order of its samples.
        credit: most indices it may have asked for and not yet been answered.
        liveness: when it was last heard.
        waiting: requests nobody works on yet, in the order asked.
        unanswered: every (epoch, index) asked for and not yet answered.
        balance_seconds: worker time it has earned and not used.
        served: samples sent.
        quarantine: number of the quarantine snapshot its samples are made under.
        left_at: when its connection ended; None while it has one, as far as is known.
        since: when it was opened.
        packed: whether it asks for compressed arrays.
        name, host: what it calls itself.
        epoch: that it last asked for samples of.
        position: index after the highest of that epoch that was answered.
        waited_seconds: for how long it has waited for samples since its Hello, as it says.
        user: name of the key that its connection has; empty without keys.
        owner: digest of that and of the secret of its Hello; empty without a secret.
        form: of one of its samples.
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
    balance_seconds: float = 0.0
    served: int = 0
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

    form: Form = field(init=False)

    def __post_init__(self) -> None:
        self.form = Form.of(array_layout(self.spec.recipe, self.spec.voxel_dtype, self.arrays))

    def mark_heard(self, now: float) -> None:
        """Its consumer said something."""
        self.liveness.mark_heard(now)
        self.left_at = None

    def add_wait(self, seconds: float, now: float) -> float:
        """Its consumer says how long it has waited in all; returns how much more than before that is, within reason."""
        more = min(seconds, now - self.since) - self.waited_seconds
        self.waited_seconds += max(0.0, more)
        return max(0.0, more)


class Sessions:
    """All consumers, and whose turn it is.

    Args:
        abandoned: how many samples workers still make that a consumer asked for in an earlier session.
    """

    def __init__(self, abandoned: Callable[[bytes], int] = lambda identity: 0) -> None:
        self._abandoned = abandoned
        self._debts: dict[bytes, float] = {}
        self._sessions: dict[bytes, Session] = {}
        self._turns: deque[bytes] = deque()

    def __len__(self) -> int:
        return len(self._sessions)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._sessions.values())

    def get(self, identity: bytes) -> Session | None:
        """The session of that consumer, if it has one."""
        return self._sessions.get(identity)

    def open(self, session: Session) -> None:
        """Add a session. One of the same routing id or owner is replaced: what it asked for is forgotten, its debt is
        not."""
        for before in {session.identity, *self.owned_by(session.owner)}:
            self.forget(before)
            session.balance_seconds -= self._debts.pop(before, 0.0)
        self._sessions[session.identity] = session
        self._turns.append(session.identity)

    def owned_by(self, owner: bytes) -> list[bytes]:
        """Return the routing ids of the sessions of an owner; none for an empty one."""
        return [each.identity for each in self if owner and each.owner == owner]

    def forget(self, identity: bytes) -> None:
        """Drop a session, if there is one; what it owes is remembered."""
        session = self._sessions.pop(identity, None)
        if session is not None:
            self._turns.remove(identity)
            if session.balance_seconds < 0.0:
                self.charge(identity, -session.balance_seconds)

    def charge(self, identity: bytes, seconds: float) -> None:
        """The consumer, there or not, owes worker time."""
        session = self._sessions.get(identity)
        if session is not None:
            session.balance_seconds -= seconds
            return
        self._debts[identity] = self._debts.pop(identity, 0.0) + seconds
        if len(self._debts) > _MOST_DEBTS:
            del self._debts[next(iter(self._debts))]

    def want(self, session: Session, epoch: int, indices: Sequence[int], slots: Sequence[Slot | None] = ()) -> None:
        """The consumer asks for samples. Those it is already waiting for are not made twice, and keep their slots.

        Args:
            session: of the consumer.
            epoch, indices: which samples.
            slots: where each may be put; empty: none of them anywhere.

        Raises:
            LimitExceeded: more than its credit would then be unanswered; none of them is taken.
            IndexError: an index outside the epoch; none of them is taken.
        """
        places: dict[int, Slot | None] = dict(zip(indices, slots, strict=True)) if slots else dict.fromkeys(indices)
        new = [index for index in places if (epoch, index) not in session.unanswered]
        for index in new:
            if index >= session.schedule.count:
                raise IndexError(f"index {index} of an epoch of {session.schedule.count} sequences")
        if len(session.unanswered) + len(new) > session.credit:
            raise LimitExceeded(
                f"{len(new)} more samples asked while {len(session.unanswered)} are unanswered; "
                f"the credit is {session.credit}"
            )
        if new and epoch != session.epoch:
            session.epoch, session.position = epoch, 0
        for index in new:
            session.unanswered.add((epoch, index))
            place = session.schedule.place(index)
            session.waiting.append(Request(session.identity, epoch, index, place=place, slot=places[index]))

    def next_request(self) -> Request | None:
        """The next request to give to a worker, by deficit round robin; None when nobody waits."""
        waiting = [identity for identity in self._turns if self._may_go_on(self._sessions[identity])]
        if not waiting:
            return None
        while True:
            for identity in waiting:
                session = self._sessions[identity]
                if session.balance_seconds >= 0.0:
                    self._turns.remove(identity)
                    self._turns.append(identity)
                    return session.waiting.popleft()
            # Everybody who waits is in debt: let time pass in steps of one quantum until the smallest debt is paid.
            debt = -max(self._sessions[identity].balance_seconds for identity in waiting)
            quanta = int(debt / _QUANTUM_SECONDS) + 1
            for identity in waiting:
                self._sessions[identity].balance_seconds += quanta * _QUANTUM_SECONDS

    def _may_go_on(self, session: Session) -> bool:
        """Whether it waits for something, and its credit is not spent on what it gave up."""
        at_work = len(session.unanswered) - len(session.waiting)
        return bool(session.waiting) and self._abandoned(session.identity) + at_work < session.credit

    def take_siblings(self, request: Request) -> list[Request]:
        """The waiting requests that are made from the same clip as ``request``; they wait no more."""
        session = self._sessions.get(request.session)
        if session is None or session.spec.samples_per_decode == 1:
            return []
        siblings = [other for other in session.waiting if other.clip == request.clip and not runs_alone(other)]
        for sibling in siblings:
            session.waiting.remove(sibling)
        return siblings

    def put_back(self, request: Request) -> None:
        """A request that comes back unanswered: it is next, because its consumer has waited longest for it."""
        session = self._sessions.get(request.session)
        if session is not None and (request.epoch, request.index) in session.unanswered:
            session.waiting.appendleft(request)

    def mark_answered(self, request: Request, worker_seconds: float) -> bool:
        """The request is answered; returns False when nobody waits for it (the session is gone, or had it already)."""
        session = self._sessions.get(request.session)
        if session is None or (request.epoch, request.index) not in session.unanswered:
            return False
        session.unanswered.remove((request.epoch, request.index))
        if request.epoch == session.epoch:
            session.position = max(session.position, request.index + 1)
        session.balance_seconds -= worker_seconds
        if not session.unanswered:
            # Nothing is saved up while idle. A debt stays, or asking for one sample at a time would be free of charge;
            # it is never more than the cost of what was in work at once.
            session.balance_seconds = min(session.balance_seconds, 0.0)
        session.served += 1
        return True

    def idle(self, now: float) -> list[bytes]:
        """Sessions to forget: silent for too long, or without a connection."""
        return [
            session.identity
            for session in self._sessions.values()
            if session.liveness.is_gone(now) or (session.left_at is not None and now - session.left_at >= GONE_SECONDS)
        ]

    def dispensable(self, now: float) -> list[bytes]:
        """Sessions to forget where others need their place: a consumer that is there says something every few
        seconds."""
        return [
            session.identity
            for session in self._sessions.values()
            if session.left_at is not None or session.liveness.silence(now) >= SILENT_SECONDS
        ]
