"""Decide what the server does: messages, lost peers and results of actions in, actions out. No I/O, no clock.

Consumers send Want, sessions queue requests, free workers get leases, and results are passed on unchanged. Every
message from a peer leads to an action or a counted fault, never to an exception: one bad peer must not stop the others.
Whatever may free a worker, or adds a request, ends with :func:`assign`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from v2v_protocol.errors import ProtocolError, V2VError
from v2v_protocol.messages import (
    LARGEST_REQUEST_BYTES,
    Begun,
    Buffer,
    Denied,
    ErrorCode,
    GetStatus,
    Goodbye,
    Hello,
    LeaseFailed,
    Ping,
    Pong,
    Result,
    Stop,
    Want,
    WorkerHello,
    decode,
    encode,
)
from v2v_server.broker import candidates, consumers, workers
from v2v_server.broker.assignment import assign, assign_slow, check_parked, take_back
from v2v_server.broker.leases import SILENCE_SECONDS, Cause, Loss, Stall
from v2v_server.broker.shared import answer_shared
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    Broker,
    CheckVideo,
    GiveUp,
    Grant,
    SendStatus,
    ToConsumer,
    ToWorker,
    denial,
    malformed,
)
from v2v_server.quarantine import QuarantineEntry


@dataclass(frozen=True)
class Dispatcher:
    """Change a broker by what happens outside of it.

    Attributes:
        broker: all that is known; others only read it.
    """

    broker: Broker

    def from_consumer(self, identity: bytes, frames: Sequence[Buffer], now: float, user: str = "") -> list[Action]:
        """Handle a message from the consumers' side.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys.
        """
        broker = self.broker
        try:
            message = decode(frames[0], LARGEST_REQUEST_BYTES) if len(frames) == 1 else None
        except ProtocolError as error:
            return [consumers.answer_fault(broker, identity, malformed(broker, error))]
        session = broker.sessions.get(identity)
        if session is not None and session.user != user:
            session = None  # a session belongs to one key
        if session is not None:
            session.mark_heard(now)
            if isinstance(message, Want | Goodbye):
                broker.counters.waited_seconds += session.add_wait(message.waited_seconds, now)
        match message:
            case Hello():
                return [consumers.open_session(broker, identity, message, now, user)]
            case Ping():
                return [ToConsumer(identity, encode(Pong(consumers.trouble_of(broker, identity))))]
            case GetStatus():
                return [SendStatus(identity)]
            case Goodbye():
                if session is not None:
                    consumers.forget(broker, identity)
                return []
            case Want():
                if session is None:
                    return [ToConsumer(identity, denial(ErrorCode.UNKNOWN_SESSION, "no session: say Hello (again)"))]
                return [*consumers.queue_requests(broker, session, message), *assign(broker, now)]
            case None:
                text = f"message with {len(frames)} frames; this kind has one"
            case WorkerHello():
                text = "this is the consumers' port: connect to the address of --worker-bind"
            case _:
                text = f"consumers cannot send {type(message).__name__}"
        return [consumers.answer_fault(broker, identity, malformed(broker, ProtocolError(text)))]

    def in_flight(self, identity: bytes, nbytes: int, now: float) -> list[Action]:
        """Note how many bytes are on their way to a consumer, and serve the requests that waited for it to read."""
        session = self.broker.sessions.set_in_flight(identity, nbytes)
        return [] if session is None else [*answer_shared(self.broker, session), *assign(self.broker, now)]

    def consumer_gone(self, identity: bytes, now: float) -> None:
        """Note that a consumer's connection has ended. The consumer may reconnect at once and find its session."""
        self.broker.faults.pop(identity, None)
        session = self.broker.sessions.get(identity)
        if session is not None:
            session.left_at = now

    def consumer_lost(self, identity: bytes) -> None:
        """Forget a consumer that cannot be reached any more."""
        consumers.forget(self.broker, identity)

    def from_worker(self, identity: bytes, frames: Sequence[Any], now: float, user: str = "") -> list[Action]:
        """Handle a message from the workers' side. The frames behind a Result are passed on unchanged.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys, and for a worker of this host.
        """
        broker = self.broker
        try:
            message = decode(frames[0] if frames else b"")
        except ProtocolError as error:
            # Our workers end when they hear this. What it was about is not known, so others get the leases.
            return [ToWorker(identity, malformed(broker, error)), *self.worker_gone(identity, now)]
        match message:
            case WorkerHello():
                return [*workers.register(broker, identity, message, now, user), *assign(broker, now)]
            case GetStatus():
                return [SendStatus(identity, is_worker_side=True)]
            case Hello():
                text = "this is the workers' port: connect to the address of --bind"
                return [ToWorker(identity, denial(ErrorCode.MALFORMED, text))]
            case _ if not broker.registry.mark_heard(identity, now):
                text = "unknown worker: say WorkerHello"
                return [ToWorker(identity, encode(Denied(ErrorCode.UNKNOWN_SESSION, text)))]
            case Begun(lease):
                broker.leases.mark_begun(lease, identity, now)
            case Result():
                return [*workers.accept_result(broker, identity, message, frames[1:], now), *assign(broker, now)]
            case LeaseFailed():
                failure = workers.close_failed(broker, identity, message, now)
                if failure is None:
                    return assign(broker, now)
                # The catalogue lists this host's files: if the file is here, other workers can probably read it.
                return [failure] if message.here else self.video_checked(failure, False, now)
            case Ping():
                broker.registry.set_credit(identity, message.notes.credit)
                return [ToWorker(identity, encode(workers.pong(broker, identity))), *assign(broker, now)]
            case Goodbye():
                broker.registry.note_unfit(message.notes.reason)
                return [*workers.remove(broker, identity, Loss(Cause.KILLED, "left")), *assign(broker, now)]
            case _:
                broker.counters.malformed += 1
        return []

    def worker_lost(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        """Reassign the leases of a worker that died, was given up, or is unreachable."""
        return [*workers.lose(self.broker, identity, loss), *assign(self.broker, now)]

    def worker_gone(self, identity: bytes, now: float) -> list[Action]:
        """Take back the leases of a worker that is not there any more for reasons outside of its work, if it said
        hello.
        """
        gone = Loss(Cause.KILLED, "is gone")
        return self.worker_lost(identity, gone, now) if identity in self.broker.registry.members else []

    def worker_stalled(self, identity: bytes, stalled: Stall) -> None:
        """Extend the deadlines of a worker by the time in which it could not run."""
        self.broker.counters.queued_seconds += stalled.queued_seconds
        self.broker.leases.extend_deadlines(identity, stalled)

    def stop_workers(self) -> list[ToWorker]:
        """Tell every worker to finish and leave."""
        return [ToWorker(identity, encode(Stop())) for identity in self.broker.registry.members]

    # --- what comes of actions, and of time ---------------------------------------------------------------------------

    def not_granted(self, grants: Sequence[Grant], error: V2VError, now: float) -> list[Action]:
        """Continue after :class:`Grant` actions whose leases were not sent; see :func:`assignment.take_back`."""
        return [*take_back(self.broker, grants, error), *assign(self.broker, now)]

    def quarantine_recorded(
        self, record: AddToQuarantine, written: Sequence[QuarantineEntry], now: float
    ) -> list[Action]:
        """Continue after an :class:`AddToQuarantine`; see :func:`candidates.extend_quarantine`."""
        return [*candidates.extend_quarantine(self.broker, record, written), *assign(self.broker, now)]

    def video_checked(self, missing: CheckVideo, found: bool, now: float) -> list[Action]:
        """Continue after a :class:`CheckVideo`: blame the video, or the worker's host.

        Args:
            missing: the action.
            found: whether this host has the video as catalogued.
            now: monotonic time, seconds.
        """
        broker, actions = self.broker, list[Action]()
        if found:
            broker.counters.missing_videos += 1
            broker.registry.rest(missing.identity, now, f"{missing.video}: {missing.reason}")
            broker.sessions.put_back(missing.request)
        else:
            actions = candidates.blame(broker, missing)
        return [*actions, *assign(broker, now)]

    def tick(self, now: float) -> list[Action]:
        """Apply deadlines, lease slow samples to a second worker, and forget silent peers. Call a few times a
        second.
        """
        broker = self.broker
        for identity in broker.sessions.idle(now):
            consumers.forget(broker, identity)
        broker.blocked_reason = ""  # cleared so that the next lease is tried
        broker.registry.wake(now)
        waited = {each: broker.leases.limit_seconds(each) for each in broker.registry.hanging(now)}
        return [
            *(GiveUp(each, f"gave no answer for {seconds:g} s") for each, seconds in waited.items()),
            *(GiveUp(each, f"was silent for {SILENCE_SECONDS:g} s") for each in broker.registry.vanished(now)),
            *check_parked(broker, now),
            *assign_slow(broker, now),
            # A consumer that left may have freed a worker that was reserved for its requests.
            *assign(broker, now),
        ]
