"""The worker's side of the conversation with its server: a state machine without I/O. Time is passed in.

    start, on_messages, on_inspected, on_kernels_loaded, on_sample, on_failure ──► [Send, Say ...] and one step

Every event returns a list of actions. The last action is the next step, and the result of that step is the next event.
So the caller, which has the socket and the kernels (:mod:`v2v_server.worker.process`), takes no decisions:

    Listen     receive the available messages, waiting for the first       ──► on_messages
    Inspect    see what the work on this lease needs                       ──► on_inspected
    Load       load the kernels of this lease, and fetch its video         ──► on_kernels_loaded
    Make       make this lease's sample                                    ──► on_sample, or on_failure
    Leave      end

The worker holds the leases of two clips at a time, so the next one is available as soon as a sample is done. After each
sample it receives its messages. Then it reports the sample together with the lease that it begins next. Siblings that
are made quickly and lie in slots are reported together, so server and consumer wake once for all of them.

A worker that cannot read a message, such as a lease of a later release, says so in its Goodbye and leaves.

Only the lease that was last announced as begun can be blamed for the end of a worker. The server sends everything else
again or gives it to other workers; nothing here has to be undone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from v2v_protocol.errors import (
    ProtocolError,
    RemoteError,
    SidecarError,
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
_PING_SECONDS = 5.0
_LONGEST_PING_SECONDS = 320.0
"""A server that is away needs no new connection every few seconds: the waits double."""
_RECONNECT_SECONDS = 10.0
"""Silence after which a ping goes over a new connection. The server may hold the old one after the network dropped it,
and then ignores what ZeroMQ sends under the same routing id after it connected again."""
_TOLD_SECONDS = 20.0
"""Silence of the server after which the worker logs it."""
_TOGETHER_SECONDS = 0.1
"""A result waits for its sibling's if less than this has passed since the first of them was begun. The time does not
count from the result: if samples take long, the server's clocks, which run between results, must see each one."""


@dataclass(frozen=True, slots=True)
class Send:
    """Send this message to the server."""

    frames: Frames


@dataclass(frozen=True, slots=True)
class Reconnect:
    """Replace the connection by a new one, and drop what the old one has not sent."""


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
    """Make this lease's sample."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class Leave:
    """End the conversation.

    Attributes:
        reason: why this worker cannot work for its server; "": it was told to leave.
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


class WorkerConversation:
    """Conversation of one worker.

    Args:
        hello: its first message.
        address: address of the server, for log lines.
        is_watched: whether the server sees the lease in work in the worker's logbook.
    """

    def __init__(self, hello: WorkerHello, address: str, *, is_watched: bool) -> None:
        self._hello = hello
        self._address = address
        self._is_watched = is_watched
        self._leases: deque[Lease] = deque()
        self._at: Lease | None = None  # in work
        self._begun = 0  # the lease last announced as begun
        self._unheard = False  # the server has not yet confirmed our last hello
        self._away = False  # we said goodbye to compile
        self._silence = Liveness(0.0)
        self._silence_reported = False
        self._unsent: list[tuple[Result, Frames]] = []  # finished leases with their messages
        self._unsent_since = 0.0
        self._may_wait = False  # the latest of them may wait for its sibling's
        self._stopping = False
        self._reason = ""  # why it stops by itself
        self.has_server = False
        """Whether the server has answered within the last interval between pings."""

    def stop(self) -> None:
        """Finish the current sample, return the other leases, and leave."""
        self._stopping = True

    # --- events -------------------------------------------------------------------------------------------------------

    def start(self, now: float) -> list[WorkerAction]:
        """Begin the conversation; call it when the worker is ready."""
        self._restart_silence(now)
        return [self._say_hello(), *self._next_actions(now)]

    def on_messages(self, messages: Sequence[Any], now: float) -> list[WorkerAction]:
        """Handle the first frames of the received messages, oldest first; empty after a wait without messages.

        Raises:
            RemoteError: the server rejects this worker (another numerics version).
            VersionMismatch: the server speaks another version of the protocol.
        """
        actions: list[WorkerAction] = []
        if messages:
            self._restart_silence(now)
            self.has_server = True
            for frame in messages:
                actions += self._handle(frame)
        else:
            actions += self._handle_silence(now)
        if self._away:
            self._away = False
            self._leases.clear()  # they were in transit when the server received our goodbye
            actions.append(self._say_hello())
        return actions + self._next_actions(now)

    def on_inspected(self, readiness: Readiness, now: float) -> list[WorkerAction]:
        """Report finished samples together with the lease that is begun next, and begin it."""
        if self._stopping:
            return self._next_actions(now)
        lease = self._leases[0]
        if self._may_wait:
            self._may_wait = False
            if not readiness.is_decoded:
                return [Listen(0.0)]
            self._begun = lease.lease
            return [self._make(now)]
        actions = self._results(lease.lease if readiness.is_ready else 0)
        if not readiness.is_ready:
            # Compiling takes seconds, more on hosts with few cores. Meanwhile other workers get our leases, and neither
            # a video nor this worker is blamed for the delay.
            self._away = not readiness.is_soon_ready
            return [*actions, *([Send(encode(Goodbye()))] if self._away else []), Load(lease)]
        if self._begun != lease.lease:
            self._begun = lease.lease
            actions.append(Send(encode(Begun(lease.lease))))
        return [*actions, self._make(now)]

    def on_kernels_loaded(self, now: float) -> list[WorkerAction]:
        """Continue after the kernels of the next lease are loaded."""
        self._restart_silence(now)
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
            and bool(self._leases)
            and not self._stopping
            and now - self._unsent_since < _TOGETHER_SECONDS
        )
        return [Inspect(self._leases[0]) if self._may_wait else Listen(0.0)]

    def on_failure(self, error: VideoError | SidecarError, now: float) -> list[WorkerAction]:
        """Report at once that the video, or its sidecar, could not be used."""
        lease = self._done(now)
        if isinstance(error, SidecarError):
            failed = LeaseFailed(lease.lease, None, error.reason, error.here, error.ending)
            return [Send(encode(failed)), Listen(0.0)]
        here = isinstance(error, VideoChanged | VideoUnreadable)
        return [Send(encode(LeaseFailed(lease.lease, error.frame, error.reason, here))), Listen(0.0)]

    # --- what the server says -----------------------------------------------------------------------------------------

    def _handle(self, frame: Any) -> list[WorkerAction]:
        try:
            message: Message = decode(frame)
        except VersionMismatch:
            raise  # a denial in a format of another protocol version
        except ProtocolError as error:
            # It may be a lease: to ignore it would be to hang, to make it without what it says would be another sample.
            self._stopping, self._reason = True, f"cannot read a message of the server: {error}"
            return []
        match message:
            case Lease():
                self._unheard = False
                self._leases.append(message)
            case Pong():
                self._unheard = False
            case Stop():
                self._stopping = True
            case Denied(ErrorCode.UNKNOWN_SESSION) if self._unheard:
                pass  # it answers an older message; another hello would revoke the leases that this one brings
            case Denied(ErrorCode.UNKNOWN_SESSION):
                # The server was restarted or had given us up: our leases, finished or not, belong to others now.
                self._leases.clear()
                self._unsent.clear()
                return [self._say_hello()]
            case Denied(code, text):
                raise RemoteError(code, text)
            case _:
                pass
        return []

    def _handle_silence(self, now: float) -> list[WorkerAction]:
        actions: list[WorkerAction] = []
        if self._silence.ping_due(now):
            self.has_server = False
            if self._silence.silence(now) >= _RECONNECT_SECONDS:
                actions += [Reconnect(), self._say_hello()]
            else:
                self._unheard = False  # it may be lost
            actions.append(Send(encode(Ping())))
        if self._silence.silence(now) >= _TOLD_SECONDS and not self._silence_reported:
            self._silence_reported = True
            if not self._is_watched:  # a server sees the state of its own workers
                actions.append(
                    Say(
                        f"{self._address} has not answered for {_TOLD_SECONDS:g} s; waiting. Is v2v-serve running "
                        "there? Without keys it serves only root and its own user"
                    )
                )
        return actions

    def _restart_silence(self, now: float) -> None:
        """Restart the measurement of silence. Exclude time during which this process was not polling."""
        self._silence = Liveness(now, ping_seconds=_PING_SECONDS, longest_ping_seconds=_LONGEST_PING_SECONDS)
        self._silence_reported = False

    # --- what the worker does -----------------------------------------------------------------------------------------

    def _say_hello(self) -> Send:
        self._begun = 0  # a server that does not know us numbers its leases from the start
        self._unheard = True
        return Send(encode(self._hello))

    def _next_actions(self, now: float) -> list[WorkerAction]:
        """Choose the next step; report finished samples unless the next lease may be begun."""
        if self._stopping:
            return [*self._results(), Send(encode(Goodbye(notes=Notes(reason=self._reason)))), Leave(self._reason)]
        if not self._leases:
            return [*self._results(), Listen(min(_PING_SECONDS, self._silence.next_due(now)))]
        return [Inspect(self._leases[0])]

    def _make(self, now: float) -> Make:
        self._at = self._leases.popleft()
        if not self._unsent:
            self._unsent_since = now
        return Make(self._at)

    def _done(self, now: float) -> Lease:
        lease, self._at = self._at, None
        if lease is None:
            raise ValueError("nothing was to be made")
        self._restart_silence(now)
        return lease

    def _results(self, begins: int = 0) -> list[WorkerAction]:
        """Report finished samples together with the lease that is begun next; 0 begins none."""
        if not self._unsent:
            return []
        self._begun = begins
        begun = [*(work.lease for work, _ in self._unsent[1:]), begins]
        results = [
            Send([*encode(replace(work, begins=next_one)), *frames])
            for (work, frames), next_one in zip(self._unsent, begun, strict=True)
        ]
        self._unsent.clear()
        return list(results)
