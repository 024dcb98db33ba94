"""The worker's side of the conversation with its brokers: a state machine without I/O. Time is passed in.

    start, on_messages, on_inspected, on_kernels_loaded, on_sample, on_failure ──► [Send, Say ...] and one step

Every event returns a list of actions. The last action is the next step, and the result of that step is the next event.
So the caller, which has the socket and the kernels (:mod:`v2v_server.worker.process`), takes no decisions:

    Listen     receive the available messages, waiting for the first       ──► on_messages
    Inspect    see what the work on this lease needs                       ──► on_inspected
    Load       load the kernels of this lease, and fetch its video         ──► on_kernels_loaded
    Make       make this lease's sample                                    ──► on_sample, or on_failure
    Leave      end

The worker holds the leases of two clips at a time, so the next one is available as soon as a sample is done. With
several brokers it takes turns, clip by clip. Each of them may always give one lease, and so states that it has work;
the only one with work may give two. The worker states this credit whenever it changes, in a note that a broker of an
earlier release ignores. A broker that is gone, stops or is refused costs only its own leases, and is tried again.

After each sample the worker receives its messages. Then it reports the sample together with the lease that it begins
next. Siblings that are made quickly and lie in slots are reported together, so server and consumer wake once for all of
them.

A worker that cannot read a message, such as a lease of a later release, says so in its Goodbye and leaves that broker.
It leaves one that differs from the others in the same way. Without a broker left, it ends.

Only the lease that was last announced as begun can be blamed for the end of a worker. The server sends everything else
again or gives it to other workers; nothing here has to be undone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from v2v_protocol.errors import (
    ProtocolError,
    RemoteError,
    SidecarError,
    V2VError,
    VersionMismatch,
    VideoChanged,
    VideoError,
    VideoUnreadable,
)
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    Frames,
    Goodbye,
    Lease,
    LeaseFailed,
    Message,
    Notes,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
    decode,
    encode,
)

CREDIT = 2
"""Leases that the only broker with work may give; one of several with work may give one."""
_PING_SECONDS = 5.0
_LONGEST_PING_SECONDS = 320.0
"""A server that is away needs no new connection every few seconds: the waits double."""
_TOLD_SECONDS = 20.0
"""Silence of the server after which the worker logs it."""
_TOGETHER_SECONDS = 0.1
"""A result waits for its sibling's if less than this has passed since the first of them was begun. The time does not
count from the result: if samples take long, the server's clocks, which run between results, must see each one."""


@dataclass(frozen=True, slots=True)
class Send:
    """Send this message to a broker, by its number."""

    frames: Frames
    broker: int = 0


@dataclass(frozen=True, slots=True)
class Reconnect:
    """Replace the connection to a broker by a new one, and drop what the old one has not sent."""

    broker: int = 0


@dataclass(frozen=True, slots=True)
class Say:
    """Write this line to the worker's log."""

    text: str


@dataclass(frozen=True, slots=True)
class Listen:
    """Receive every available message; wait at most this long for the first."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Inspect:
    """See what the work on this lease needs, and change nothing."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class Load:
    """Load the kernels that this lease needs, and fetch its video."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class Make:
    """Make the sample of this lease of a broker."""

    lease: Lease
    broker: int = 0


@dataclass(frozen=True, slots=True)
class Leave:
    """End the conversation.

    Attributes:
        reason: why this worker cannot work for its brokers; "": it was told to leave.
    """

    reason: str = ""


WorkerAction: TypeAlias = Send | Reconnect | Say | Listen | Inspect | Load | Make | Leave


@dataclass(frozen=True, slots=True)
class Readiness:
    """What the work on a lease needs.

    Attributes:
        is_ready: nothing: its kernels are loaded, and its video is on this host.
        is_soon_ready: a moment: its kernels need no compiling, and its video is small.
        is_decoded: whether its sample needs no decoding, because a sibling's clip is available.
    """

    is_ready: bool
    is_soon_ready: bool
    is_decoded: bool


@dataclass(slots=True, eq=False)
class KnownBroker:
    """What a worker knows of one of its brokers.

    Attributes:
        address: for log lines.
        number: its place in the worker's list.
        credit: leases that it may give, as last stated.
        silence: since its last message.
        leases: that it gave and that are not begun, in the order of the work.
        begun: number of the lease last announced as begun.
        is_unheard: it has not yet confirmed our last hello.
        is_asked: our last ping is not answered.
        is_reported: its silence is in the log.
        is_there: whether it has answered within the last interval between pings.
        is_left: we said goodbye to it; a new connection to it is tried later.
        reason: why we could not work for it when we left it last.
        serves: digests of its catalogue and of its default spec; empty: not known.
    """

    address: str
    number: int
    credit: int
    silence: Liveness
    leases: deque[Lease] = field(default_factory=deque)
    begun: int = 0
    is_unheard: bool = False
    is_asked: bool = False
    is_reported: bool = False
    is_there: bool = False
    is_left: bool = False
    reason: str = ""
    serves: tuple[str, str] = ("", "")

    def restart_silence(self, now: float) -> None:
        """Restart the measurement of silence: the broker was heard, or could not be."""
        self.silence = Liveness(now, ping_seconds=_PING_SECONDS, longest_ping_seconds=_LONGEST_PING_SECONDS)
        self.is_asked = self.is_reported = False

    def difference(self, other: KnownBroker) -> str:
        """Return what this broker serves unlike another one, and what to do; "" if nothing differs."""
        differs = [
            f"its {what} is {mine}, that of {other.address} is {theirs}"
            for what, mine, theirs in zip(("catalogue", "default recipe"), self.serves, other.serves, strict=True)
            if mine != theirs
        ]
        hint = "; start all brokers of a pool with the same videos, --rows and recipe"
        return " and ".join(differs) + hint if differs else ""


class WorkerConversation:
    """Conversation of one worker.

    Args:
        hello: its first message.
        addresses: of the brokers that it works for, for log lines.
        is_watched: whether the only broker sees the lease in work in the worker's logbook.

    Attributes:
        brokers: those that it works for.
    """

    def __init__(self, hello: WorkerHello, addresses: Sequence[str], *, is_watched: bool) -> None:
        self._hello = hello
        self._is_watched = is_watched
        self._has_several = len(addresses) > 1
        self.brokers = [
            KnownBroker(address, number, 1 if self._has_several else CREDIT, Liveness(0.0))
            for number, address in enumerate(addresses)
        ]
        self._turn = self.brokers[-1]  # the broker of the lease in work, else of the last one
        self._at: Lease | None = None  # in work
        self._siblings: tuple[int, ...] = ()  # of the last lease, which come next
        self._away = False  # we said goodbye to compile
        self._unsent: list[tuple[Result, Frames]] = []  # finished leases with their messages
        self._unsent_since = 0.0
        self._may_wait = False  # the latest of them may wait for its sibling's
        self._stopping = False
        self._reason = ""  # why it stops by itself

    def stop(self) -> None:
        """Finish the current sample, return the other leases, and leave."""
        self._stopping = True

    # --- events -------------------------------------------------------------------------------------------------------

    def start(self, now: float) -> list[WorkerAction]:
        """Begin the conversation; call it when the worker is ready."""
        for broker in self.brokers:
            broker.restart_silence(now)
        return [*self._say_hello(*self.brokers), *self._next_actions(now)]

    def on_messages(self, messages: Sequence[tuple[int, Any]], now: float) -> list[WorkerAction]:
        """Handle the received messages, oldest first; empty after a wait without messages.

        Args:
            messages: of each, the number of its broker, and its first frame or why the connection is refused.
            now: monotonic time, seconds.

        Raises:
            RemoteError: the only broker rejects this worker (another numerics version).
            VersionMismatch: the only broker speaks another version of the protocol.
            UsageError: the connection to the only broker is refused.
        """
        actions: list[WorkerAction] = []
        for number, frame in messages:
            if not (broker := self.brokers[number]).is_left:
                actions += self._handle(broker, frame, now)
        heard = {number for number, _ in messages}
        for broker in self.brokers:
            if broker.is_left or broker.number not in heard:
                actions += self._handle_silence(broker, now)
        if self._away:
            self._away = False
            actions += self._say_hello(*(broker for broker in self.brokers if not broker.is_left))
        return actions + self._next_actions(now)

    def on_inspected(self, readiness: Readiness, now: float) -> list[WorkerAction]:
        """Report finished samples together with the lease that is begun next, and begin it."""
        broker = self._next_broker()
        if self._stopping or broker is None:
            return self._next_actions(now)
        lease = broker.leases[0]
        if self._may_wait:
            self._may_wait = False
            if not readiness.is_decoded:
                return [Listen(0.0)]
            broker.begun = lease.lease
            return [self._make(broker, now)]
        actions = self._results(lease.lease if readiness.is_ready and broker is self._turn else 0)
        if not readiness.is_ready:
            # Compiling takes seconds, more on hosts with few cores. Meanwhile other workers get our leases, and neither
            # a video nor this worker is blamed for the delay.
            self._away = not readiness.is_soon_ready
            return [*actions, *(self._say_goodbye() if self._away else []), Load(lease)]
        if broker.begun != lease.lease:
            broker.begun = lease.lease
            actions.append(Send(encode(Begun(lease.lease)), broker.number))
        return [*actions, self._make(broker, now)]

    def on_kernels_loaded(self, now: float) -> list[WorkerAction]:
        """Continue after the kernels of the next lease are loaded."""
        for broker in self.brokers:
            if not broker.is_left:
                broker.restart_silence(now)
        return [Listen(0.0)] if self._away else self._next_actions(now)

    def on_sample(self, frames: Frames, now: float, work: Result) -> list[WorkerAction]:
        """Report a sample that is made.

        Args:
            frames: its SampleHeader message.
            now: monotonic time, seconds.
            work: what the sample took; its numbers of leases do not count.
        """
        lease = self._done(now)
        self._unsent.append((replace(work, lease=lease.lease), frames))
        self._may_wait = (
            len(frames) == 1  # arrays in the message should be sent at once
            and self._is_watched  # without a logbook the server blames the lease last announced
            and bool(self._turn.leases)
            and not self._stopping
            and now - self._unsent_since < _TOGETHER_SECONDS
        )
        return [Inspect(self._turn.leases[0]) if self._may_wait else Listen(0.0)]

    def on_failure(self, error: VideoError | SidecarError, now: float) -> list[WorkerAction]:
        """Report at once that the video, or its sidecar, could not be used."""
        lease = self._done(now)
        if isinstance(error, SidecarError):
            failed = LeaseFailed(lease.lease, None, error.reason, error.here, error.ending)
        else:
            here = isinstance(error, VideoChanged | VideoUnreadable)
            failed = LeaseFailed(lease.lease, error.frame, error.reason, here)
        return [Send(encode(failed), self._turn.number), Listen(0.0)]

    # --- what a broker says -------------------------------------------------------------------------------------------

    def _handle(self, broker: KnownBroker, frame: Any, now: float) -> list[WorkerAction]:
        try:
            if isinstance(frame, V2VError):
                raise frame
            broker.restart_silence(now)
            broker.is_there = True
            message: Message = decode(frame)
            if isinstance(message, Denied) and message.code != ErrorCode.UNKNOWN_SESSION:
                raise RemoteError(message.code, message.text)
        except V2VError as error:
            is_unread = isinstance(error, ProtocolError) and not isinstance(error, VersionMismatch)
            if not self._has_several and not is_unread:  # a denial may have the format of another protocol version
                raise
            # It may be a lease: to ignore it would be to hang, to make it without what it says would be another sample.
            return self._refuse(
                broker, f"cannot read a message of the server: {error}" if is_unread else str(error), now
            )
        match message:
            case Lease():
                broker.is_unheard = False
                broker.leases.append(message)
            case Pong(notes=notes):
                broker.is_unheard, broker.serves = False, (notes.catalogue, notes.spec)
                return self._compare(now)
            case Stop():
                return [
                    *self._leave(broker, "", _PING_SECONDS, now),
                    *([Say(f"{broker.address} stops; working for the others")] if self._has_several else []),
                ]
            case Denied() if not broker.is_unheard:
                # The server was restarted or had given us up: our leases, finished or not, belong to others now. While
                # our hello is unheard, this answers an older message: another hello would revoke the leases that this
                # one brings.
                if broker is self._turn:
                    self._unsent.clear()
                return self._say_hello(broker)
            case _:
                pass
        return []

    def _compare(self, now: float) -> list[WorkerAction]:
        """Refuse brokers that differ from the first one of the list that is there, so that all workers choose alike."""
        first, *others = [each for each in self.brokers if each.is_there and all(each.serves)] or self.brokers[:1]
        return [
            action
            for other in others
            if (difference := other.difference(first))
            for action in self._refuse(other, difference, now)
        ]

    def _handle_silence(self, broker: KnownBroker, now: float) -> list[WorkerAction]:
        actions: list[WorkerAction] = []
        if broker.is_asked and not broker.is_reported and broker.silence.silence(now) >= _TOLD_SECONDS:
            broker.is_reported = True
            if not self._is_watched:  # a server sees the state of its own workers
                actions.append(
                    Say(
                        f"{broker.address} has not answered for {_TOLD_SECONDS:g} s; waiting. Is v2v-serve running "
                        "there? Without keys it serves only root and its own user"
                    )
                )
        if broker.silence.ping_due(now):
            broker.is_there = False
            if broker.is_asked:
                # The server may hold the old connection after the network dropped it, and then ignores what ZeroMQ
                # sends under the same routing id after it connected again.
                broker.is_left = False
                actions += [Reconnect(broker.number), *self._say_hello(broker)]
            else:
                broker.is_asked, broker.is_unheard = True, False  # the hello may be lost
            actions.append(Send(encode(Ping()), broker.number))
        return actions

    def _refuse(self, broker: KnownBroker, reason: str, now: float) -> list[WorkerAction]:
        """Leave a broker that this worker cannot work for, and say why unless that is said already."""
        text = f"{broker.address}: {reason}; left, tried again in {_LONGEST_PING_SECONDS:g} s"
        said = [Say(text)] if self._has_several and reason != broker.reason else []
        return [*said, *self._leave(broker, reason, _LONGEST_PING_SECONDS, now)]

    def _leave(self, broker: KnownBroker, reason: str, seconds: float, now: float) -> list[WorkerAction]:
        """Leave a broker, and try a new connection to it after some seconds; stop if it was the last one."""
        actions = [*self._results(), *self._say_goodbye(broker, reason=reason)]
        broker.leases.clear()
        broker.silence = Liveness(now, ping_seconds=seconds, longest_ping_seconds=_LONGEST_PING_SECONDS)
        broker.is_left = broker.is_asked = broker.is_reported = True
        broker.is_there, broker.reason = False, reason
        if all(each.is_left for each in self.brokers):
            self._stopping, self._reason = True, "; ".join(each.reason for each in self.brokers if each.reason)
        return actions

    # --- what the worker does -----------------------------------------------------------------------------------------

    def _say_hello(self, *brokers: KnownBroker) -> list[WorkerAction]:
        actions: list[WorkerAction] = []
        for broker in brokers:
            broker.leases.clear()  # the server gives them to others when it receives our hello or goodbye
            broker.begun = 0  # a server that does not know us numbers its leases from the start
            broker.is_unheard = True
            actions.append(Send(encode(replace(self._hello, credit=broker.credit)), broker.number))
            if self._has_several:
                actions.append(Send(encode(Ping()), broker.number))  # the answer states what it serves
        return actions

    def _say_goodbye(self, *brokers: KnownBroker, reason: str = "") -> list[WorkerAction]:
        """Say goodbye to these brokers, or to all that we have not left."""
        goodbye = encode(Goodbye(notes=Notes(reason=reason)))
        there = brokers or [each for each in self.brokers if not each.is_left]
        return [Send(goodbye, each.number) for each in there]

    def _next_actions(self, now: float) -> list[WorkerAction]:
        """Choose the next step; report finished samples unless the next lease may be begun."""
        if self._stopping:
            return [*self._results(), *self._say_goodbye(), Leave(self._reason)]
        stated, broker = self._state_credit(), self._next_broker()
        if broker is None:
            due = min(each.silence.next_due(now) for each in self.brokers)
            return [*stated, *self._results(), Listen(min(_PING_SECONDS, due))]
        return [*stated, Inspect(broker.leases[0])]

    def _next_broker(self) -> KnownBroker | None:
        """Return the broker whose lease is next: that of the siblings of the last clip, else the next in turn."""
        last = self._turn
        if self._siblings and last.leases and last.leases[0].indices == self._siblings:
            return last
        in_turn = self.brokers[last.number + 1 :] + self.brokers[: last.number + 1]
        return next((each for each in in_turn if each.leases), None)

    def _state_credit(self) -> list[WorkerAction]:
        """State the credit of the brokers for which it has changed."""
        if not self._has_several:
            return []
        # The next lease of the last one may be under way: it answers our result.
        with_work = [each for each in self.brokers if each.leases or each is self._turn]
        actions: list[WorkerAction] = []
        for broker in self.brokers:
            credit = CREDIT if with_work == [broker] else 1
            if credit != broker.credit and not broker.is_left:
                broker.credit = credit
                actions.append(Send(encode(Ping(notes=Notes(credit=credit))), broker.number))
        return actions

    def _make(self, broker: KnownBroker, now: float) -> Make:
        self._turn, self._at = broker, broker.leases.popleft()
        self._siblings = self._at.indices[1:]
        if not self._unsent:
            self._unsent_since = now
        return Make(self._at, broker.number)

    def _done(self, now: float) -> Lease:
        lease, self._at = self._at, None
        if lease is None:
            raise ValueError("nothing was to be made")
        self._turn.restart_silence(now)  # this process was not polling
        return lease

    def _results(self, begins: int = 0) -> list[WorkerAction]:
        """Report finished samples together with the lease of their broker that is begun next; 0 begins none."""
        if not self._unsent:
            return []
        self._turn.begun = begins
        begun = [*(work.lease for work, _ in self._unsent[1:]), begins]
        results = [
            Send([*encode(replace(work, begins=next_one)), *frames], self._turn.number)
            for (work, frames), next_one in zip(self._unsent, begun, strict=True)
        ]
        self._unsent.clear()
        return list(results)
