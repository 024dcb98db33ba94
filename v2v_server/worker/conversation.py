"""The worker's side of the conversation with its server: a state machine without I/O. Time is passed in.

    start, heard, loaded, made, failed ──► [Send, Reconnect, Say ...] and one step: Listen, Load, Make or Leave

Every event is answered with a list of actions. The last of them is the step to take next, and what comes of that step
is the next event. So whoever has the socket and the kernels (:mod:`v2v_server.worker.process`) takes no decision:

    Listen     take the messages that are there, waiting for the first     ──► heard
    Load       have the kernels of this lease                              ──► loaded
    Make       make this lease's sample                                    ──► made, or failed
    Leave      end

The worker holds the leases of two clips at a time, so that the next one is at hand when a sample is done. After each
sample it takes in its messages, then says what is done and along with it what it begins next. Siblings that are made in
little time and lie in slots are announced together: server and consumer then wake once for all of them.

Only the lease that was said to be begun is ever blamed for the end of a worker. Whatever the server may not have heard,
it sends again or gives to others; nothing here has to be undone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from v2v_protocol.errors import ProtocolError, RemoteError, VersionMismatch, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    Goodbye,
    Lease,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
)
from v2v_protocol.wire import Frames, decode, encode

CREDIT = 2
_PING_SECONDS = 5.0
_LONGEST_PING_SECONDS = 320.0
"""A server that is away needs no new connection every few seconds: the waits double."""
_RECONNECT_SECONDS = 10.0
"""Silence after which a ping goes over a new connection. The server may hold the old one although the network cut it,
and then ignores what ZeroMQ sends under the same routing id after it connected again."""
_TOLD_SECONDS = 20.0
"""Of silence until whoever started a worker is told that its server does not answer."""
_TOGETHER_SECONDS = 0.1
"""What is done waits for a sibling if less time than this has gone by since the first of them was begun. Not since it
was done: where samples take long the server's clocks, which run from result to result, must see each of them."""


@dataclass(frozen=True, slots=True)
class Send:
    """Send this message to the server."""

    frames: Frames


@dataclass(frozen=True, slots=True)
class Reconnect:
    """Replace the connection by a new one, and drop what the old one has not sent."""


@dataclass(frozen=True, slots=True)
class Say:
    """Tell whoever reads this worker's log."""

    text: str


@dataclass(frozen=True, slots=True)
class Listen:
    """Take every message that is there; wait at most this long for the first."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Load:
    """Have the kernels that this lease needs."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class Make:
    """Make this lease's sample."""

    lease: Lease


@dataclass(frozen=True, slots=True)
class Leave:
    """The conversation is over."""


Action: TypeAlias = Send | Reconnect | Say | Listen | Load | Make | Leave


@dataclass(frozen=True, slots=True)
class Spent:
    """What a sample took, as its :class:`v2v_protocol.messages.Result` says it."""

    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0
    memory_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Tools:
    """What the conversation asks about its process. An answer changes nothing.

    Attributes:
        is_ready: whether the kernels of a lease are loaded.
        is_compiled: whether loading them takes no time to speak of.
        is_decoded: whether a lease's sample needs no decoding, because its sibling's clip is at hand.
    """

    is_ready: Callable[[Lease], bool]
    is_compiled: Callable[[Lease], bool]
    is_decoded: Callable[[Lease], bool]


class WorkerConversation:
    """What one worker says.

    Args:
        hello: how it introduces itself.
        address: of the server, for what is said to people.
        tools: see there.
        is_watched: the server sees in the worker's logbook which lease it is at.
    """

    def __init__(self, hello: WorkerHello, address: str, tools: Tools, *, is_watched: bool) -> None:
        self._hello = hello
        self._address = address
        self._tools = tools
        self._is_watched = is_watched
        self._leases: deque[Lease] = deque()
        self._at: Lease | None = None  # made now
        self._begun = 0  # the lease that was last said to be begun
        self._unheard = False  # nothing says yet that the server took in our last hello
        self._away = False  # we said goodbye to compile
        self._silence = Liveness(0.0)
        self._told = False
        # Leases that are done, what is to be said of their samples, and what these took.
        self._unsent: list[tuple[int, Frames, Spent]] = []
        self._unsent_since = 0.0
        self._stopping = False

    def stop(self) -> None:
        """The worker finishes the sample it is at, gives the other leases back and leaves."""
        self._stopping = True

    # --- events -------------------------------------------------------------------------------------------------------

    def start(self, now: float) -> list[Action]:
        """The worker can work."""
        self._listens_from(now)
        return [self._say_hello(), *self._go_on(now)]

    def heard(self, messages: Sequence[Any], now: float) -> list[Action]:
        """The first frames of the messages that came, oldest first; none after the wait.

        Raises:
            RemoteError: the server does not want this worker (another numerics version).
            VersionMismatch: the server speaks another version of the protocol.
        """
        actions: list[Action] = []
        if messages:
            self._listens_from(now)
            for frame in messages:
                actions += self._take_in(frame)
        else:
            actions += self._nothing_heard(now)
        if self._away:
            self._away = False
            self._leases.clear()  # which were on their way when the server heard of our goodbye
            actions.append(self._say_hello())
        return actions + self._go_on(now)

    def loaded(self, now: float) -> list[Action]:
        """The kernels of the lease that was to be begun are there."""
        self._listens_from(now)
        return [Listen(0.0)] if self._away else self._go_on(now)

    def made(self, frames: Frames, now: float, spent: Spent = Spent()) -> list[Action]:
        """The sample is made.

        Args:
            frames: its SampleHeader message.
            now: the time.
            spent: what it took.
        """
        lease = self._done(now)
        self._unsent.append((lease.lease, frames, spent))
        may_wait = (
            len(frames) == 1  # arrays that travel with it had better be on their way
            and self._is_watched  # elsewhere the server blames what was begun to its knowledge
            and bool(self._leases)
            and self._tools.is_decoded(self._leases[0])
            and now - self._unsent_since < _TOGETHER_SECONDS
        )
        if may_wait and not self._stopping:
            self._begun = self._leases[0].lease
            return [self._make(now)]
        return [Listen(0.0)]

    def failed(self, error: VideoError, now: float) -> list[Action]:
        """The video could not give what it promised. This is said at once."""
        lease = self._done(now)
        here = isinstance(error, VideoChanged | VideoUnreadable)
        return [Send(encode(LeaseFailed(lease.lease, error.frame, error.reason, here))), Listen(0.0)]

    # --- what the server says -----------------------------------------------------------------------------------------

    def _take_in(self, frame: Any) -> list[Action]:
        try:
            message: Message = decode(frame)
        except VersionMismatch:
            raise  # a denial, in words that only its own version understands
        except ProtocolError as error:
            return [Say(f"ignored a message from the server: {error}")]
        match message:
            case Lease():
                self._unheard = False
                self._leases.append(message)
            case Pong():
                self._unheard = False
            case Stop():
                self._stopping = True
            case Denied(ErrorCode.UNKNOWN_SESSION) if self._unheard:
                pass  # what it denies was said before; another hello would take back the leases that this one brings
            case Denied(ErrorCode.UNKNOWN_SESSION):
                # The server was restarted, or had given us up: what we hold has been given to others, and the numbers
                # of what is done as well.
                self._leases.clear()
                self._unsent.clear()
                return [self._say_hello()]
            case Denied(code, text):
                raise RemoteError(code, text)
            case _:
                pass
        return []

    def _nothing_heard(self, now: float) -> list[Action]:
        actions: list[Action] = []
        if self._silence.ping_due(now):
            if self._silence.silence(now) >= _RECONNECT_SECONDS:
                actions += [Reconnect(), self._say_hello()]
            else:
                self._unheard = False  # it may be lost
            actions.append(Send(encode(Ping())))
        if self._silence.silence(now) >= _TOLD_SECONDS and not self._told:
            self._told = True
            if not self._is_watched:  # of its own workers a server knows
                actions.append(Say(f"{self._address} has not answered for {_TOLD_SECONDS:g} s; waiting"))
        return actions

    def _listens_from(self, now: float) -> None:
        """Silence is counted from here: while a sample is made nobody listens."""
        self._silence = Liveness(now, ping_seconds=_PING_SECONDS, longest_ping_seconds=_LONGEST_PING_SECONDS)
        self._told = False

    # --- what the worker does -----------------------------------------------------------------------------------------

    def _say_hello(self) -> Send:
        self._begun = 0  # a server that does not know us counts its leases anew
        self._unheard = True
        return Send(encode(self._hello))

    def _go_on(self, now: float) -> list[Action]:
        """What is done is said; then the next step."""
        actions = self._results()
        if self._stopping:
            return [*actions, Send(encode(Goodbye())), Leave()]
        if not self._leases:
            return [*actions, Listen(min(_PING_SECONDS, self._silence.next_due(now)))]
        lease = self._leases[0]
        if self._begun != lease.lease:
            if not self._tools.is_ready(lease):
                # While they are compiled its leases are for others: that takes seconds, many where cores are few, and
                # a video is not to be blamed for them, nor a worker.
                self._away = not self._tools.is_compiled(lease)
                return [*actions, *([Send(encode(Goodbye()))] if self._away else []), Load(lease)]
            self._begun = lease.lease
            actions.append(Send(encode(Begun(lease.lease))))
        return [*actions, self._make(now)]

    def _make(self, now: float) -> Make:
        self._at = self._leases.popleft()
        if not self._unsent:
            self._unsent_since = now
        return Make(self._at)

    def _done(self, now: float) -> Lease:
        lease, self._at = self._at, None
        if lease is None:
            raise ValueError("nothing was to be made")
        self._listens_from(now)
        return lease

    def _results(self) -> list[Action]:
        """Says what is done, and along with it what is begun next."""
        if not self._unsent:
            return []
        may_go_on = self._leases and not self._stopping and self._tools.is_ready(self._leases[0])
        self._begun = self._leases[0].lease if may_go_on else 0
        begun = [*(number for number, *_ in self._unsent[1:]), self._begun]
        results = [
            Send([*encode(_result(number, next_one, spent)), *frames])
            for (number, frames, spent), next_one in zip(self._unsent, begun, strict=True)
        ]
        self._unsent.clear()
        return list(results)


def _result(lease: int, begins: int, spent: Spent) -> Result:
    return Result(
        lease, begins, spent.decode_seconds, spent.simulate_seconds, spent.handover_seconds, spent.memory_bytes
    )
