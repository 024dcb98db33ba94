"""Decide what the server does: messages and lost peers in, actions out. No sockets, no processes, no clock.

Consumers send Want, sessions queue requests, free workers get leases, and results are passed on unchanged. Every
message from a peer leads to an action or a counted fault, never to an exception: one bad peer must not stop the others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import NO_SLOT, ArenaName, Slot
from v2v_protocol.errors import (
    CorpusError,
    LimitExceeded,
    ProtocolError,
    UsageError,
)
from v2v_protocol.messages import (
    LARGEST_REQUEST_BYTES,
    Begun,
    Buffer,
    Denied,
    ErrorCode,
    Frames,
    GetStatus,
    Goodbye,
    Hello,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    SampleHeader,
    Stop,
    Want,
    WorkerHello,
    decode,
    encode,
)
from v2v_protocol.sample import SampleId
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.actions import (
    Action,
    AddToQuarantine,
    CheckVideo,
    Disconnect,
    GiveUp,
    SendLease,
    SendStatus,
    ToConsumer,
    ToWorker,
    denial,
    malformed,
)
from v2v_server.broker.candidates import Candidates
from v2v_server.broker.counters import Counters, bounded_seconds
from v2v_server.broker.grants import Grants, check_result
from v2v_server.broker.leases import Cause, LeaseBook, Loss, Request, Stall, judge
from v2v_server.broker.session import Admission, Session, Sessions
from v2v_server.broker.worker_registry import MOST_WORKERS, SILENCE_SECONDS, Workers, clean_name
from v2v_server.corpus.videos import CorpusFacts
from v2v_server.quarantine.snapshots import Quarantine, QuarantineEntry
from v2v_server.sharing.ring import SampleRing

MOST_SESSIONS = 4096
MOST_FAULTS = 16
"""Malformed messages and refused specs after which a consumer is disconnected: an answer costs as much as a sample."""
_LONGEST_SECRET_BYTES = 64
_LONGEST_NAME_BYTES = 255


class Dispatcher:
    """Assign requests of consumers to workers.

    Args:
        facts: what is known of the videos, in memory.
        default_spec: the spec of a consumer that sends none.
        lease_deadline_seconds: a worker that is silent over one sample for longer than this, in addition to the time
            that the sample may take, is treated as hung.
        session_idle_seconds: a consumer that is silent for longer is forgotten; it can come back.
        max_credit_bytes: bound on the bytes in flight to one consumer.
        quarantine: the snapshots; new entries are added to it once they are on disk.
        wall_clock: returns the time for a quarantine entry, ISO 8601.
        expected_workers: total number of workers expected, including other hosts. It sets a consumer's credit when the
            consumer connects, which may be before the first worker says hello.
        share_bytes: size limit of the finished samples kept for other consumers; 0: keep none.

    Attributes:
        counters: totals since the start.
        sessions: the consumers.
        registry: the workers.
        leases: which worker makes what.
        candidates: which sequences were refused.
    """

    def __init__(
        self,
        facts: CorpusFacts,
        default_spec: StreamSpec,
        *,
        lease_deadline_seconds: float,
        session_idle_seconds: float,
        max_credit_bytes: int,
        quarantine: Quarantine,
        wall_clock: Callable[[], str],
        expected_workers: int = 0,
        share_bytes: int = 0,
    ) -> None:
        self.counters = Counters()
        self.leases = LeaseBook(lease_deadline_seconds)
        self.sessions = Sessions(self.leases)
        self._expected_workers = expected_workers
        self._facts = facts
        self._quarantine = quarantine
        self.candidates = Candidates(self.sessions, quarantine, self.counters, wall_clock)
        self._admission = Admission(facts, default_spec, max_credit_bytes, session_idle_seconds, quarantine)
        self.registry = Workers(self.leases)
        ring = SampleRing(share_bytes) if share_bytes else None
        self._grants = Grants(facts, self.sessions, self.leases, self.registry, self.candidates, self.counters, ring)
        self._faults: dict[bytes, int] = {}  # malformed messages and refused specs of connected consumers

    @property
    def blocked_reason(self) -> str:
        """Why no lease can be granted at the moment; empty if leases can be granted."""
        return self._grants.blocked_reason

    @property
    def workers(self) -> int:
        """Return the number of workers that said hello and are alive as far as is known."""
        return len(self.registry)

    @property
    def waiting(self) -> int:
        """Return the number of requested samples that are not leased to a worker yet."""
        return len(self._grants.lone) + sum(len(session.waiting) for session in self.sessions)

    @property
    def waiting_share(self) -> float:
        """Share of the connected consumers that have requests without a worker: 0 to 1."""
        connected = [session for session in self.sessions if session.left_at is None]
        return sum(bool(session.waiting) for session in connected) / max(len(connected), 1)

    @property
    def consumers(self) -> int:
        """Return the number of consumers that are connected, as far as is known."""
        return sum(session.left_at is None for session in self.sessions)

    def has_session(self, identity: bytes) -> bool:
        """Return whether a peer is a consumer with a session, or a worker that said hello."""
        return self.sessions.get(identity) is not None or identity in self.registry

    def identity_of(self, request: Request) -> SampleId | None:
        """Return the identity of the sample that a request asks for; None if its consumer is gone."""
        session = self.sessions.get(request.session)
        if session is None:
            return None
        catalogue = self._facts.digest_under(session.spec.scene)
        return SampleId(session.spec.digest, catalogue, NUMERICS_VERSION, session.seed, request.epoch, request.index)

    def clip_of(self, request: Request) -> tuple[str, int] | None:
        """Return the video and first frame of the request's current candidate; None if its consumer is gone."""
        session = self.sessions.get(request.session)
        if session is None:
            return None
        sequence = self.candidates.sequence(session, request)
        return sequence.video.id, sequence.start_frame

    @property
    def idle_share(self) -> float:
        """Share of the workers that hold no lease: 0 to 1."""
        return max(0.0, 1.0 - self.leases.holders / max(len(self.registry), 1)) if self.registry else 0.0

    # --- consumers ---------------------------------------------------------------------------------------------------

    def from_consumer(self, identity: bytes, frames: Sequence[Buffer], now: float, user: str = "") -> list[Action]:
        """Handle a message from the consumers' side.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys.
        """
        try:
            message = _only(frames)
        except ProtocolError as error:
            return [self._fault(identity, self._malformed(error))]
        session = self.sessions.get(identity)
        if session is not None and session.user != user:
            session = None  # a session belongs to one key
        if session is not None:
            session.mark_heard(now)
        match message:
            case Hello():
                return [self._hello(identity, message, now, user)]
            case Ping():
                return [
                    ToConsumer(
                        identity, encode(Pong(self.blocked_reason or self.registry.trouble(self._expected_workers)))
                    )
                ]
            case GetStatus():
                return [SendStatus(identity)]
            case Goodbye():
                if session is not None:
                    self.counters.waited_seconds += session.add_wait(message.waited_seconds, now)
                    self.consumer_lost(identity)
                return []
            case Want():
                if session is None:
                    return [_deny(identity, ErrorCode.UNKNOWN_SESSION, "no session: say Hello (again)")]
                self.counters.waited_seconds += session.add_wait(message.waited_seconds, now)
                denials = self._want(session, message)
                return denials or [*self._grants.answer_shared(session), *self._grants.assign(now)]
            case WorkerHello():
                stray = ProtocolError("this is the consumers' port: connect to the address of --worker-bind")
                return [self._fault(identity, self._malformed(stray))]
            case _:
                stray = ProtocolError(f"consumers cannot send {type(message).__name__}")
                return [self._fault(identity, self._malformed(stray))]

    def in_flight(self, identity: bytes, nbytes: int, now: float) -> list[Action]:
        """Note how many bytes are on their way to a consumer, and serve the requests that waited for it to read."""
        session = self.sessions.set_in_flight(identity, nbytes)
        return [] if session is None else [*self._grants.answer_shared(session), *self._grants.assign(now)]

    def consumer_gone(self, identity: bytes, now: float) -> None:
        """Note that a consumer's connection has ended. The consumer may reconnect at once and find its session."""
        self._faults.pop(identity, None)
        session = self.sessions.get(identity)
        if session is not None:
            session.left_at = now

    def consumer_lost(self, identity: bytes) -> None:
        """Forget a consumer that left or cannot be reached any more."""
        self.sessions.forget(identity)
        self._grants.forget_session(identity)

    def _hello(self, identity: bytes, hello: Hello, now: float, user: str) -> Action:
        try:
            owner = owner_digest(user, hello.secret)
        except LimitExceeded as error:
            return _deny(identity, ErrorCode.MALFORMED, str(error))
        present = self.sessions.get(identity)
        if present is not None and (present.owner, present.user) != (owner, user):
            text = "this routing id belongs to the session of another consumer: connect with a random one"
            return _deny(identity, ErrorCode.MALFORMED, text)
        if self.sessions.get(identity) is None and len(self.sessions) >= MOST_SESSIONS:
            for silent in self.sessions.dispensable(now):
                self.consumer_lost(silent)
        if self.sessions.get(identity) is None and len(self.sessions) >= MOST_SESSIONS:
            return _deny(identity, ErrorCode.BUSY, f"this server has {MOST_SESSIONS} consumers, its limit")
        try:
            workers = max(len(self.registry), self._expected_workers)
            session, welcome = self._admission.admit(identity, hello, workers, now)
            session.user, session.owner = user, owner
        except (UsageError, CorpusError) as error:
            return self._fault(identity, denial(ErrorCode.SPEC, str(error)))
        for before in {identity, *self.sessions.owned_by(owner)}:
            self._grants.forget_session(before)
        self.sessions.open(session)
        return ToConsumer(identity, encode(welcome))

    def _want(self, session: Session, want: Want) -> list[Action]:
        try:
            slots = _slots(want)
        except ProtocolError as error:
            return [self._fault(session.identity, self._malformed(error))]
        try:
            for index in want.indices[:1]:
                SampleId(session.spec.digest, self._facts.digest, NUMERICS_VERSION, session.seed, want.epoch, index)
            self.sessions.want(session, want.epoch, want.indices, slots)
        except LimitExceeded as error:
            return [_deny(session.identity, ErrorCode.CREDIT, str(error))]
        except (IndexError, UsageError) as error:
            return [_deny(session.identity, ErrorCode.RANGE, str(error))]
        return []

    def _fault(self, identity: bytes, answer: Frames) -> Action:
        """Answer a malformed message or a refused spec of a consumer; disconnect it after too many."""
        faults = self._faults[identity] = self._faults.pop(identity, 0) + 1
        if len(self._faults) > MOST_SESSIONS:
            del self._faults[next(iter(self._faults))]
        return ToConsumer(identity, answer) if faults <= MOST_FAULTS else Disconnect(identity)

    def _malformed(self, error: ProtocolError) -> Frames:
        self.counters.malformed += 1
        return malformed(error)

    # --- workers -----------------------------------------------------------------------------------------------------

    def from_worker(self, identity: bytes, frames: Sequence[Any], now: float, user: str = "") -> list[Action]:
        """Handle a message from the workers' side. The frames behind a Result are passed on unchanged.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys, and for a worker of this host.
        """
        try:
            message = decode(frames[0] if frames else b"")
        except ProtocolError as error:
            return [ToWorker(identity, self._malformed(error))]
        if isinstance(message, WorkerHello):
            return self._worker_hello(identity, message, now, user)
        if isinstance(message, GetStatus):
            return [SendStatus(identity, is_worker_side=True)]
        if isinstance(message, Hello):
            text = "this is the workers' port: connect to the address of --bind"
            return [ToWorker(identity, denial(ErrorCode.MALFORMED, text))]
        if not self.registry.mark_heard(identity, now):
            return [ToWorker(identity, encode(Denied(ErrorCode.UNKNOWN_SESSION, "unknown worker: say WorkerHello")))]
        match message:
            case Begun(lease):
                self.leases.mark_begun(lease, identity, now)
                return []
            case Result():
                return self._result(identity, message, frames[1:], now)
            case LeaseFailed():
                return self._lease_failed(identity, message, now)
            case Ping():
                return [ToWorker(identity, encode(Pong()))]
            case Goodbye():
                return self._take_back(identity, Loss(Cause.KILLED, "left"), now)
            case _:
                self.counters.malformed += 1
                return []

    def worker_lost(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        """Reassign the leases of a worker that died, was given up, or is unreachable."""
        self.counters.workers_lost += 1
        return self._take_back(identity, loss, now)

    def worker_stalled(self, identity: bytes, stalled: Stall) -> None:
        """Extend the deadlines of a worker by the time in which it could not run."""
        self.counters.queued_seconds += stalled.queued_seconds
        self.leases.extend_deadlines(identity, stalled)

    def worker_unreachable(self, identity: bytes, now: float) -> list[Action]:
        """Take back the leases of a worker that a message did not reach and that no supervisor watches."""
        if identity not in self.registry:
            return []
        return self.worker_lost(identity, Loss(Cause.KILLED, "is not connected any more"), now)

    def stop_workers(self) -> list[ToWorker]:
        """Tell every worker to finish and leave."""
        return [ToWorker(identity, encode(Stop())) for identity in self.registry.members()]

    def _worker_hello(self, identity: bytes, hello: WorkerHello, now: float, user: str) -> list[Action]:
        try:
            owner = owner_digest(user, hello.secret)
            before = self._replaced_by(identity, hello.name, owner, user)
        except LimitExceeded as error:
            return [ToWorker(identity, self._malformed(error))]
        again = Loss(Cause.KILLED, "started again")
        actions = [action for each in before for action in self._take_back(each, again, now)]
        if hello.numerics_version != NUMERICS_VERSION:
            text = f"worker numerics version {hello.numerics_version}, the server's is {NUMERICS_VERSION}"
            return [ToWorker(identity, encode(Denied(ErrorCode.VERSION, text))), *actions]
        if len(self.registry) >= MOST_WORKERS:
            text = f"this server has {MOST_WORKERS} workers, its limit"
            return [ToWorker(identity, denial(ErrorCode.BUSY, text)), *actions]
        self.registry.add(identity, hello, now, user, owner)
        return actions + self._grants.assign(now)

    def _replaced_by(self, identity: bytes, name: str, owner: bytes, user: str) -> list[bytes]:
        """Return the connections that a worker's hello replaces: its own ones.

        Raises:
            LimitExceeded: one of them is another worker's, or the name is too long.
        """
        if len(name.encode()) > _LONGEST_NAME_BYTES:
            raise LimitExceeded(f"the name has {len(name.encode())} bytes; the limit is {_LONGEST_NAME_BYTES}")
        members = self.registry.members()
        before = [each for each in {identity, self.registry.named(name)} if each is not None and each in members]
        for each in before:
            is_own = members[each].owner == owner and (bool(owner) or each == identity)
            # A worker of this host needs no key. Its supervisor knows it by its name, so no key can hold that.
            if not is_own and (user or not members[each].user):
                raise LimitExceeded(
                    f"a worker with the name or routing id of {clean_name(name)!r} is connected; both must be unique: "
                    "start this one with another --name"
                )
        return before

    def _result(self, identity: bytes, result: Result, payload: Sequence[Any], now: float) -> list[Action]:
        request = self.leases.request(result.lease, identity)
        session = None if request is None else self.sessions.get(request.session)
        actions: list[Action] = []
        decoded = True
        if request is None or session is None:
            self.counters.late_results += 1
            self._charge(result.lease, identity, now)
        else:
            try:
                header = check_result(payload, self._grants.as_leased(request, result.lease), session.form)
            except ProtocolError as error:
                # Our workers never send such a result; a worker that sends one would send more.
                refused = ToWorker(identity, self._malformed(ProtocolError(f"malformed result: {error}")))
                return [refused, *self.worker_lost(identity, Loss(Cause.KILLED, "sent a malformed result"), now)]
            decoded = header.decoded
            if self._count(session, request, header, in_slot=len(payload) == 1):
                self.counters.add(result, header.cpu_seconds)
                self.registry.worked(identity, result, header.cpu_seconds)
                actions += self._grants.deliver(session, request, result.lease, header, payload)
        self.registry.can_work(identity)
        self.leases.finished(result.lease, identity, now, decoded=decoded)
        self.leases.mark_begun(result.begins, identity, now)
        return actions + self._grants.assign(now)

    def _lease_failed(self, identity: bytes, failed: LeaseFailed, now: float) -> list[Action]:
        self._charge(failed.lease, identity, now)
        request = self.leases.finished(failed.lease, identity, now)
        session = None if request is None else self.sessions.get(request.session)
        if request is None or session is None:
            return self._grants.assign(now)
        video, sidecar = self.candidates.sequence(session, request).video, failed.sidecar
        fingerprint = self._facts.sidecars_of(video.id, session.arrays).get(sidecar) if sidecar else video.fingerprint
        failure = CheckVideo(
            video.id, fingerprint or "", identity, failed.frame, failed.reason, request, sidecar if fingerprint else ""
        )
        if not failed.here:
            self.registry.can_work(identity)
            return [*self.candidates.blame(failure), *self._grants.assign(now)]
        # The catalogue lists this host's files: if the file is here, other workers can probably read it.
        return [failure]

    def _charge(self, lease: int, worker: bytes, now: float) -> None:
        """Charge a consumer for a sample that it asked for and then abandoned."""
        debt = self.leases.debt(lease, worker, now)
        if debt is not None:
            self.sessions.charge(*debt)

    def _count(self, session: Session, request: Request, header: SampleHeader, *, in_slot: bool) -> bool:
        """Count what was sent of a sample; return False if no session waits for it."""
        if not self.sessions.mark_answered(request, bounded_seconds(header.cpu_seconds)):
            self.counters.late_results += 1
            return False
        self.counters.decodes += header.decoded
        self.counters.count_cache(header.cache)
        self.counters.count_sent(session.batch_size, session.form.sizes, in_slot=in_slot)
        return True

    def _take_back(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        self.registry.remove(identity)
        actions: list[Action] = []
        returned = self.leases.lost(identity, loss.lease)
        self.counters.returned_leases += len(returned)
        for request, begun in reversed(returned):
            verdict = judge(request, loss) if begun else request
            if isinstance(verdict, Request):
                self.sessions.put_back(verdict)
            else:
                actions += self.candidates.quarantine_candidate(
                    request, verdict, for_all=loss.for_all and loss.cause is not Cause.UNEXPLAINED
                )
        return actions + self._grants.assign(now)

    # --- what comes of actions, and of time ---------------------------------------------------------------------------

    def quarantine_recorded(
        self, record: AddToQuarantine, written: Sequence[QuarantineEntry], now: float
    ) -> list[Action]:
        """Continue after an :class:`AddToQuarantine`.

        Args:
            record: the action.
            written: the lines that the quarantine has gained, including those of other processes; empty if it cannot be
                written.
            now: monotonic time, seconds.
        """
        before = self._quarantine.latest
        self._quarantine.extend(written)
        # Consumers under the newest snapshot move on to the new one. A consumer that resumed an older snapshot keeps
        # it: entries cleared since must not return, and sequences that it refused must stay refused.
        for each in self.sessions:
            if each.quarantine == before:
                each.quarantine = self._quarantine.latest
        return [*self.candidates.refuse_quarantined(record.request, record.entry.reason), *self._grants.assign(now)]

    def index_unreadable(self, unsent: Sequence[SendLease], reason: str, now: float) -> None:
        """Continue after leases that cannot be completed, because the index cannot be read at the moment.

        No lease is granted until the next :meth:`tick`.

        Args:
            unsent: the actions, oldest first.
            reason: why it cannot be read.
            now: monotonic time, seconds.
        """
        self._grants.blocked_reason = f"{reason}; retried ten times a second"
        self._grants.take_back(unsent, now)

    def lease_refused(self, unsent: SendLease, reason: str, now: float) -> list[Action]:
        """Continue after a lease that can never be sent: the index of its video is damaged, belongs to another file, or
        is too large.
        """
        return [*self._grants.refuse(unsent, reason, now), *self._grants.assign(now)]

    def video_checked(self, missing: CheckVideo, found: bool, now: float) -> list[Action]:
        """Continue after a :class:`CheckVideo`: blame the video, or the worker's host.

        Args:
            missing: the action.
            found: whether this host has the video as catalogued.
            now: monotonic time, seconds.
        """
        if not found:
            return [*self.candidates.blame(missing), *self._grants.assign(now)]
        self.counters.missing_videos += 1
        self.registry.rest(missing.identity, now, f"{missing.video}: {missing.reason}")
        self.sessions.put_back(missing.request)
        return self._grants.assign(now)

    def tick(self, now: float) -> list[Action]:
        """Apply deadlines, lease slow samples to a second worker, and forget silent peers. Call a few times a
        second.
        """
        for identity in self.sessions.idle(now):
            self.consumer_lost(identity)
        actions: list[Action] = []
        self._grants.blocked_reason = ""  # cleared so that the next lease is tried
        self.registry.wake(now)
        for identity in self.registry.hanging(now):
            actions.append(GiveUp(identity, f"gave no answer for {self.leases.limit_seconds(identity):g} s"))
        for identity in self.registry.vanished(now):
            actions.append(GiveUp(identity, f"was silent for {SILENCE_SECONDS:g} s"))
        second = self._grants.assign_slow(now)
        self.counters.second_leases += len(second)
        actions += second
        # A consumer that left may have freed a worker that was reserved for its requests.
        return actions + self._grants.assign(now)


def _only(frames: Sequence[Buffer]) -> Message:
    if len(frames) != 1:
        raise ProtocolError(f"message with {len(frames)} frames; this kind has one")
    return decode(frames[0], LARGEST_REQUEST_BYTES)


def _slots(want: Want) -> list[Slot | None]:
    """Return where the samples may be put.

    Raises:
        ProtocolError: a slot does not exist, or the numbers of slots and indices differ.
    """
    if not len(want.arenas) == len(want.slots) in (0, len(want.indices)):
        raise ProtocolError(f"want: {len(want.arenas)} arenas, {len(want.slots)} slots for {len(want.indices)} indices")
    numbers = {arena: (1, ArenaName.parse(arena).slots) for arena in set(want.arenas) - {""}}
    numbers[""] = NO_SLOT, NO_SLOT
    for arena, number in zip(want.arenas, want.slots, strict=True):
        least, most = numbers[arena]
        if not least <= number <= most:
            raise ProtocolError(f"want.slots: {number} of arena {arena!r:.80}; it has {least} to {most}")
    return [Slot(arena, number) if arena else None for arena, number in zip(want.arenas, want.slots, strict=True)]


def _deny(identity: bytes, code: ErrorCode, text: str) -> ToConsumer:
    return ToConsumer(identity, denial(code, text))


def owner_digest(user: str, secret: bytes) -> bytes:
    """Return a digest of the owner of a session or worker name: its key, if there are keys, and its secret.

    Raises:
        LimitExceeded: the secret is too long.
    """
    if len(secret) > _LONGEST_SECRET_BYTES:
        raise LimitExceeded(f"the secret has {len(secret)} bytes; the limit is {_LONGEST_SECRET_BYTES}")
    return hashlib.blake2b(secret, key=hashlib.sha256(user.encode()).digest()).digest() if secret else b""
