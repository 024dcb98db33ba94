"""Handle the workers' messages and losses. No I/O; time is passed in."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import LimitExceeded, ProtocolError
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    GetStatus,
    Goodbye,
    Hello,
    LeaseFailed,
    Ping,
    Pong,
    Result,
    SampleHeader,
    Stop,
    WorkerHello,
)
from v2v_protocol.wire import Frames, decode, encode
from v2v_server.broker.actions import Action, CheckVideo, SendStatus, ToWorker, denial, malformed
from v2v_server.broker.blame import Cause, Loss, judge
from v2v_server.broker.candidates import Candidates
from v2v_server.broker.counters import Counters, bounded_seconds
from v2v_server.broker.grants import Grants, check_result
from v2v_server.broker.leases import LeaseBook, Request, Stall
from v2v_server.broker.session import Session, Sessions
from v2v_server.broker.worker_registry import MOST_WORKERS, Workers, clean_name
from v2v_server.corpus.videos import CorpusFacts

_LONGEST_SECRET_BYTES = 64
_LONGEST_NAME_BYTES = 255


class WorkerSide:
    """The dispatcher's half for workers."""

    def __init__(
        self,
        facts: CorpusFacts,
        sessions: Sessions,
        leases: LeaseBook,
        registry: Workers,
        candidates: Candidates,
        grants: Grants,
        counters: Counters,
    ) -> None:
        self._facts = facts
        self._sessions = sessions
        self._leases = leases
        self._registry = registry
        self._candidates = candidates
        self._grants = grants
        self._counters = counters

    def receive(self, identity: bytes, frames: Sequence[Any], now: float, user: str = "") -> list[Action]:
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
            return self._hello(identity, message, now, user)
        if isinstance(message, GetStatus):
            return [SendStatus(identity, is_worker_side=True)]
        if isinstance(message, Hello):
            text = "this is the workers' port: connect to the address of --bind"
            return [ToWorker(identity, denial(ErrorCode.MALFORMED, text))]
        if not self._registry.mark_heard(identity, now):
            return [ToWorker(identity, encode(Denied(ErrorCode.UNKNOWN_SESSION, "unknown worker: say WorkerHello")))]
        match message:
            case Begun(lease):
                self._leases.mark_begun(lease, identity, now)
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
                self._counters.malformed += 1
                return []

    def lost(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        """Reassign the leases of a worker that died, was given up, or is unreachable."""
        self._counters.workers_lost += 1
        return self._take_back(identity, loss, now)

    def stalled(self, identity: bytes, stalled: Stall) -> None:
        """Extend the deadlines of a worker by the time in which it could not run."""
        self._counters.queued_seconds += stalled.queued_seconds
        self._leases.extend_deadlines(identity, stalled)

    def unreachable(self, identity: bytes, now: float) -> list[Action]:
        """Take back the leases of a worker that a message did not reach and that no supervisor watches."""
        if identity not in self._registry:
            return []
        return self.lost(identity, Loss(Cause.KILLED, "is not connected any more"), now)

    def stop(self) -> list[ToWorker]:
        """Tell every worker to finish and leave."""
        return [ToWorker(identity, encode(Stop())) for identity in self._registry.identities()]

    def _hello(self, identity: bytes, hello: WorkerHello, now: float, user: str) -> list[Action]:
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
        if len(self._registry) >= MOST_WORKERS:
            text = f"this server has {MOST_WORKERS} workers, its limit"
            return [ToWorker(identity, denial(ErrorCode.BUSY, text)), *actions]
        self._registry.add(identity, hello, now, user, owner)
        return actions + self._grants.assign(now)

    def _replaced_by(self, identity: bytes, name: str, owner: bytes, user: str) -> list[bytes]:
        """Return the connections that a worker's hello replaces: its own ones.

        Raises:
            LimitExceeded: one of them is another worker's, or the name is too long.
        """
        if len(name.encode()) > _LONGEST_NAME_BYTES:
            raise LimitExceeded(f"the name has {len(name.encode())} bytes; the limit is {_LONGEST_NAME_BYTES}")
        members = self._registry.members()
        before = [each for each in {identity, self._registry.named(name)} if each is not None and each in members]
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
        request = self._leases.request(result.lease, identity)
        session = None if request is None else self._sessions.get(request.session)
        actions: list[Action] = []
        decoded = True
        if request is None or session is None:
            self._counters.late_results += 1
            self._charge(result.lease, identity, now)
        else:
            try:
                header = check_result(payload, self._grants.as_leased(request, result.lease), session.form)
            except ProtocolError as error:
                # Our workers never send such a result; a worker that sends one would send more.
                refused = ToWorker(identity, self._malformed(ProtocolError(f"malformed result: {error}")))
                return [refused, *self.lost(identity, Loss(Cause.KILLED, "answered nonsense"), now)]
            decoded = header.decoded
            if self._count(session, request, header, in_slot=len(payload) == 1):
                self._counters.add(result, header.cpu_seconds)
                self._registry.worked(identity, result, header.cpu_seconds)
                actions += self._grants.deliver(session, request, result.lease, header, payload)
        self._registry.can_work(identity)
        self._leases.finished(result.lease, identity, now, decoded=decoded)
        self._leases.mark_begun(result.begins, identity, now)
        return actions + self._grants.assign(now)

    def _lease_failed(self, identity: bytes, failed: LeaseFailed, now: float) -> list[Action]:
        self._charge(failed.lease, identity, now)
        request = self._leases.finished(failed.lease, identity, now)
        session = None if request is None else self._sessions.get(request.session)
        if request is None or session is None:
            return self._grants.assign(now)
        video, sidecar = self._candidates.sequence(session, request).video, failed.sidecar
        fingerprint = self._facts.sidecars_of(video.id, session.arrays).get(sidecar) if sidecar else video.fingerprint
        failure = CheckVideo(
            video.id, fingerprint or "", identity, failed.frame, failed.reason, request, sidecar if fingerprint else ""
        )
        if not failed.here:
            self._registry.can_work(identity)
            return [*self._candidates.blame(failure), *self._grants.assign(now)]
        # The catalogue lists this host's files: if the file is here, other workers can probably read it.
        return [failure]

    def _charge(self, lease: int, worker: bytes, now: float) -> None:
        """Charge a consumer for a sample that it asked for and then abandoned."""
        debt = self._leases.debt(lease, worker, now)
        if debt is not None:
            self._sessions.charge(*debt)

    def _count(self, session: Session, request: Request, header: SampleHeader, *, in_slot: bool) -> bool:
        """Count what was sent of a sample; return False if no session waits for it."""
        if not self._sessions.mark_answered(request, bounded_seconds(header.cpu_seconds)):
            self._counters.late_results += 1
            return False
        self._counters.decodes += header.decoded
        self._counters.count_cache(header.cache)
        self._counters.count_sent(session.batch_size, session.form.sizes, in_slot=in_slot)
        return True

    def _take_back(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        self._registry.remove(identity)
        actions: list[Action] = []
        returned = self._leases.lost(identity, loss.lease)
        self._counters.returned_leases += len(returned)
        for request, begun in reversed(returned):
            verdict = judge(request, loss) if begun else request
            if isinstance(verdict, Request):
                self._sessions.put_back(verdict)
            else:
                actions += self._candidates.quarantine_candidate(
                    request, verdict, for_all=loss.for_all and loss.cause is not Cause.UNEXPLAINED
                )
        return actions + self._grants.assign(now)

    def _malformed(self, error: ProtocolError) -> Frames:
        self._counters.malformed += 1
        return malformed(error)


def owner_digest(user: str, secret: bytes) -> bytes:
    """Return a digest of the owner of a session or worker name: its key, if there are keys, and its secret.

    Raises:
        LimitExceeded: the secret is too long.
    """
    if len(secret) > _LONGEST_SECRET_BYTES:
        raise LimitExceeded(f"the secret has {len(secret)} bytes; the limit is {_LONGEST_SECRET_BYTES}")
    return hashlib.blake2b(secret, key=hashlib.sha256(user.encode()).digest()).digest() if secret else b""
