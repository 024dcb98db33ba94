"""Implement the consumer's side of the protocol as a state machine with three states.

It is pure: messages in, messages out. The time is passed in, as seconds of listening
(:class:`ListeningClock`).

Entering a state, even from itself, sends messages:

    GREETING    sends Hello, and repeats it at growing intervals until Welcome arrives, because either may be lost
    WELCOMED    sends all unanswered requests again, and may send more

:data:`TRANSITIONS` defines which event leads from one state to another. After a restart, the
server does not know the consumer and denies its requests. The consumer then sends Hello with the resolved spec, and the
server must offer the same stream as before. Repeated requests can make a sample arrive twice; the reorder window drops
the second one.

Three conditions raise errors: nothing received for ``timeout_seconds`` (ServerLost); for the same time, a server that
answers but has no worker to make a sample (NoWorkers); and messages that break the protocol (ProtocolError).
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any

import numpy.typing as npt
import zstandard

from v2v_client.memory import Slots
from v2v_client.options import Patience
from v2v_client.position import StreamIdentity
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.errors import NoWorkers, ProtocolError, RemoteError, SampleUnavailable, ServerLost
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import (
    Buffer,
    Denied,
    ErrorCode,
    Goodbye,
    Hello,
    Message,
    Ping,
    Pong,
    SampleHeader,
    Unavailable,
    Want,
    Welcome,
    decode_map,
    decode_sample,
)
from v2v_protocol.sample import Form, Layout, Provenance, SampleId, array_layout

WAIT_REPORT_SECONDS = 1.0
"""Interval at which the server is told how long this consumer has waited for samples."""
_MOST_CREDIT_DENIALS = 3
_NO_SLOTS: Mapping[int, Slot] = {}


@dataclass(frozen=True, slots=True)
class Arrival:
    """Hold one received sample.

    Attributes:
        header: the sample's header; :meth:`Conversation.provenance` decodes its provenance.
        arrays: read-only views of the message or the server's memory, by name; None if they are in the sample's slot.
        slot_is_free: False if a worker may still write to the sample's slot.
    """

    header: SampleHeader
    arrays: Mapping[str, npt.NDArray[Any]] | None
    slot_is_free: bool = True


class Conversation:
    """Hold a consumer's side of a session, for one epoch.

    Args:
        address: of the server, for error messages.
        hello: the first message, with the requested spec and arrays.
        epoch: epoch of the samples to request.
        pinned: the stream that the server must offer; None accepts the first offer and pins it.
        pinned_by: what pinned it, in words for the message of a mismatch.
        patience: timeouts for pinging, repeating requests and giving up.
        now: the time, in seconds of listening.

    Attributes:
        state: the current state.
        outbox: messages to send, in order; the caller sends them and empties it.
        stream: the stream that the server offers; set in WELCOMED.
        layout: dtype and shape of each array of one sample; set in WELCOMED.
        credit: maximum number of samples requested and not received.
        waited_seconds: time spent waiting for samples since the last Hello. It is sent with each request, once a second
            while waiting, and with Goodbye.
    """

    stream: StreamIdentity
    layout: Layout
    form: Form

    def __init__(
        self,
        address: str,
        hello: Hello,
        epoch: int,
        *,
        pinned: StreamIdentity | None,
        pinned_by: str,
        patience: Patience,
        now: float,
    ) -> None:
        self._address = address
        self._hello = hello
        self._epoch = epoch
        self._pinned_by = pinned_by
        self._patience = patience
        self._slots = Slots()
        self._server = Liveness(
            now,
            gone_seconds=patience.timeout_seconds,
            # A server is always pinged before it counts as lost.
            ping_seconds=min(patience.ping_seconds, patience.timeout_seconds / 2),
        )
        self._rewant_seconds = min(patience.rewant_seconds, patience.timeout_seconds)
        self._answered = now  # last time that a request was answered, or all were repeated
        self._shortage = WorkerShortage(now, patience.timeout_seconds)
        self._moved = False  # whether the stream was offered by an earlier broker
        self._asked: dict[int, None] = {}  # sent and not answered, in the order sent
        self._queued: deque[int] = deque()  # to send when the credit allows
        self._hello_due = self._hello_wait = 0.0
        self._asked_again = False
        self._owed = False  # whether a request was denied for credit since all requests were repeated
        self._credit_denials = 0
        self._last: int | None = None  # index of the last sample received
        self._pinned: StreamIdentity | None = None
        self.state = State.CLOSED
        self.outbox: list[Message] = []
        self.credit = 0
        self.waited_seconds = 0.0
        self._wait_reported_at = now
        if pinned is not None:
            self._pin(pinned)

    def move(self, address: str, now: float) -> None:
        """Continue with the broker at ``address``, over a new link. It must offer the same stream."""
        if self._pinned is not None and not self._moved:
            self._pinned_by += f", begun at {self._address},"
            self._moved = True
        self._address = address
        self._server.mark_heard(now)
        self._answered = now
        self._shortage.end(now)
        self.outbox.clear()
        self.handle_event(Event.SILENCE, now)

    def _pin(self, stream: StreamIdentity) -> None:
        spec = stream.resolved
        self._pinned = stream
        self._hello = replace(self._hello, spec=stream.spec)
        self.layout = array_layout(spec.recipe, spec.voxel_dtype, self._hello.arrays)
        self.form = Form.of(self.layout)

    # --- states -------------------------------------------------------------------------------------------------------

    def handle_event(self, event: Event, now: float) -> None:
        """Change the state and queue the messages of the new one. Events without a transition do nothing."""
        state = TRANSITIONS[self.state].get(event)
        if state is None:
            return
        self.state = state
        match state:
            case State.GREETING:
                self._hello_wait = self._patience.ping_seconds
                self._hello_due = now + self._hello_wait
                self.waited_seconds = 0.0
                self.outbox.append(self._hello)
            case State.WELCOMED:
                self._want_again()
            case State.CLOSED:
                self.outbox.append(Goodbye(self.waited_seconds))

    def tick(self, now: float) -> bool:
        """Run the timers that are due at ``now``.

        Returns:
            whether the link must be connected again before the outbox is sent.

        Raises:
            ServerLost: nothing was received for ``timeout_seconds``.
        """
        if self._server.is_gone(now):
            raise self._server_lost(now)
        if now - self._answered >= self._rewant_seconds:
            silent = self._server.silence(now) >= self._rewant_seconds
            self._answered = now
            self._rewant_seconds = min(2 * self._rewant_seconds, self._patience.timeout_seconds)
            if silent:
                self.handle_event(Event.SILENCE, now)
                return True
            self.handle_event(Event.UNANSWERED, now)
        ping = self._server.ping_due(now)
        if self.state is State.GREETING:
            if now >= self._hello_due:
                self._hello_wait *= 2
                self._hello_due = now + self._hello_wait
                self.outbox.append(self._hello)
        elif ping:
            if self._owed:
                self._want_again()
            # A server answers every Ping, even of an unknown session. An empty request shows whether it knows this one.
            self.outbox += [Want(self._epoch, (), waited_seconds=self.waited_seconds), Ping()]
        return False

    def record_wait(self, seconds: float, now: float) -> None:
        """Add ``seconds`` spent waiting for samples since the last call, and report them once a second."""
        self.waited_seconds += seconds
        if self.state is State.WELCOMED and now - self._wait_reported_at >= WAIT_REPORT_SECONDS:
            self._wait_reported_at = now
            self.outbox.append(Want(self._epoch, (), waited_seconds=self.waited_seconds))

    def next_due(self, now: float) -> float:
        """Return the seconds until :meth:`tick` has something to do, at least 0."""
        due = [self._server.next_due(now), self._answered + self._rewant_seconds - now]
        if self.state is State.GREETING:
            due.append(self._hello_due - now)
        return max(0.0, min(due))

    def silence(self, now: float) -> float:
        """Return the seconds since the last message from the server."""
        return self._server.silence(now)

    def _server_lost(self, now: float) -> ServerLost:
        last = (
            "no sample was received" if self._last is None else f"last sample: epoch {self._epoch}, index {self._last}"
        )
        return ServerLost(
            f"{self._address}: nothing received for {self._server.silence(now):.0f} s; {last}; start v2v-serve there "
            "(without keys it serves its own user only), or wait longer with timeout_seconds "
            f"(now {self._patience.timeout_seconds:g})"
        )

    # --- asking -------------------------------------------------------------------------------------------------------

    def want(self, indices: Iterable[int], slots: Mapping[int, Slot] = _NO_SLOTS) -> None:
        """Request samples as soon as the credit allows.

        Args:
            indices: global indices of the samples.
            slots: by index, where workers may write samples that were never requested before.
        """
        self._queued.extend(indices)
        self._slots.offer(slots)
        if self.state is not State.WELCOMED:
            return
        allowed = self.credit - len(self._asked)
        now = [self._queued.popleft() for _ in range(min(allowed, len(self._queued)))]
        if now:
            self._asked.update(dict.fromkeys(now))
            # In one message: siblings are decoded together only if they are requested together.
            self.outbox.append(replace(self._slots.want(self._epoch, now), waited_seconds=self.waited_seconds))

    def _want_again(self) -> None:
        # In the original order. After a Welcome with less credit, the rest stays queued.
        self._asked_again = self._asked_again or bool(self._asked)
        self._queued.extendleft(reversed(self._asked))
        self._asked.clear()
        self._owed = False
        self.want(())

    # --- receiving ----------------------------------------------------------------------------------------------------

    def handle_message(self, message: Message, arrays: list[Buffer], now: float) -> Arrival | None:
        """Handle a received message.

        Args:
            message: the decoded first frame.
            arrays: the raw frames after it, or the bytes in the server's memory that it names.
            now: the time, in seconds of listening.

        Returns:
            the sample, if the message was a sample of this epoch; otherwise None.

        Raises:
            NoWorkers: for ``timeout_seconds`` the server had no worker to make a sample.
            SampleUnavailable: the server cannot make a requested sample.
            RemoteError: the server denies a request.
            StateMismatch: the server offers another stream than the pinned one.
            ProtocolError: the message breaks the protocol.
        """
        self._server.mark_heard(now)
        if isinstance(message, Pong):
            self._shortage.check(self._address, message.trouble if self._asked else "", now)
        else:
            self._answered = now
            self._shortage.end(now)
        if isinstance(message, SampleHeader):
            return self._sample(message, arrays)
        if arrays:
            raise ProtocolError(f"{self._address} sent {type(message).__name__} with {len(arrays)} surplus frames")
        match message:
            case Pong():
                pass
            case Welcome():
                self._accept_welcome(message, now)
            case Denied(code=ErrorCode.UNKNOWN_SESSION):
                # Every request under way is denied; a single Hello recovers all of them.
                self.handle_event(Event.FORGOTTEN, now)
            case Denied(code=ErrorCode.CREDIT) if self._asked_again and self._credit_denials < _MOST_CREDIT_DENIALS:
                # The server makes samples again that were already on their way when the requests were repeated, and
                # these use up credit. The denied requests stay in _asked; they are sent again when such a sample
                # arrives a second time, or with the next ping.
                self._credit_denials += 1
                self._owed = True
            case Denied():
                raise RemoteError(message.code, f"{self._address} refused: {message.text}")
            case Unavailable():
                if message.epoch == self._epoch and message.index in self._asked:
                    raise SampleUnavailable(
                        "unavailable",
                        f"{self._address} cannot make sample {message.index} of epoch {message.epoch}: {message.text}",
                    )
            case _:
                raise ProtocolError(
                    f"{self._address} sent {type(message).__name__}, which servers do not send to consumers"
                )
        return None

    def _accept_welcome(self, welcome: Welcome, now: float) -> None:
        stream = StreamIdentity.of(welcome)
        if welcome.credit < 1:
            raise ProtocolError(f"{self._address} grants a credit of {welcome.credit} samples")
        if self._pinned is None:
            self._pin(stream)
        else:
            self._pinned.require_same(stream, ours=self._pinned_by, theirs=self._address)
        self.stream, self.credit = stream, welcome.credit
        # After a restart, the server must continue with the newest quarantine snapshot seen.
        self._hello = replace(self._hello, quarantine=welcome.quarantine)
        self.handle_event(Event.WELCOME, now)

    def _sample(self, header: SampleHeader, frames: list[Buffer]) -> Arrival | None:
        if header.epoch != self._epoch:
            return None
        form = self.form
        if (header.names, header.dtypes, header.shapes) != (form.names, form.dtypes, form.shapes):
            raise ProtocolError(
                f"{self._address} sent sample {header.index} of epoch {header.epoch} as {header.names!r:.200} of "
                f"{header.dtypes!r:.200}, shapes {header.shapes!r:.200}; asked: {self.layout}"
            )
        again = header.index not in self._asked
        is_gone = bool(header.arena) and not frames  # the server dropped it before it was read
        in_message = bool(frames) or is_gone or header.slot == NO_SLOT
        unpacked = unpack if header.packed else None
        arrays = decode_sample(self.layout, frames, unpacked) if in_message and not is_gone else None
        slot_is_free = self._slots.record_arrival(header.index, header.slot, in_message=in_message)
        if is_gone and not again:
            del self._asked[header.index]
            self._queued.appendleft(header.index)  # without a slot, it comes in a message
        if is_gone or slot_is_free is None:
            self._ask_for_more(again)
            return None
        self._hello = replace(self._hello, quarantine=max(self._hello.quarantine or 0, header.quarantine))
        self._asked.pop(header.index, None)
        self._credit_denials = 0
        self._last = header.index
        self._ask_for_more(again)
        return Arrival(header, arrays, slot_is_free=slot_is_free)

    def _ask_for_more(self, again: bool) -> None:
        """Send queued requests after a sample. A second copy (``again``) held credit that counted as free."""
        if again and self._owed:
            self._want_again()
        else:
            self.want(())

    def provenance(self, header: SampleHeader) -> Provenance:
        """Decode a sample's provenance. Call this once its batch is complete: decoding many in a row is cheaper.

        Raises:
            ProtocolError: the provenance is malformed or belongs to another sample.
        """
        identity = SampleId(
            spec_digest=self.stream.spec_digest,
            catalogue_digest=self.stream.catalogue_digest,
            numerics_version=self.stream.numerics_version,
            seed=self._hello.seed,
            epoch=header.epoch,
            index=header.index,
        )
        provenance = Provenance.from_dict(decode_map(header.provenance))
        if provenance.id != identity:
            raise ProtocolError(f"{self._address} sent {provenance.id} in answer to {identity}")
        if type(provenance.quarantine) is not int or provenance.quarantine != header.quarantine:
            raise ProtocolError(
                f"{self._address} sent sample {header.index} of epoch {header.epoch} as made under quarantine snapshot "
                f"{header.quarantine}, and its provenance names {provenance.quarantine!r:.40}"
            )
        return provenance


class State(Enum):
    """List the states of a conversation."""

    CLOSED = auto()  # before Hello, or after Goodbye
    GREETING = auto()  # Hello was sent
    WELCOMED = auto()  # the server has answered Hello


class Event(Enum):
    """List the events that change the state."""

    OPENED = auto()  # a link is open
    WELCOME = auto()  # the server answered Hello
    FORGOTTEN = auto()  # the server does not know the session: it was restarted, or the consumer was silent too long
    DISCONNECTED = auto()  # the network was interrupted and is back: messages under way in either direction may be lost
    UNANSWERED = auto()  # the server is alive, but no request was answered for a while: messages may be lost
    SILENCE = auto()  # nothing was received for the same time: the link may be broken and is opened again
    LEFT = auto()  # the consumer leaves: Goodbye


# Events without an entry change nothing.
TRANSITIONS: Mapping[State, Mapping[Event, State]] = {
    State.CLOSED: {
        Event.OPENED: State.GREETING,
    },
    State.GREETING: {
        Event.WELCOME: State.WELCOMED,
        Event.DISCONNECTED: State.GREETING,
        Event.SILENCE: State.GREETING,
        Event.LEFT: State.CLOSED,
    },
    State.WELCOMED: {
        Event.WELCOME: State.WELCOMED,
        Event.FORGOTTEN: State.GREETING,
        Event.DISCONNECTED: State.WELCOMED,
        Event.UNANSWERED: State.WELCOMED,
        Event.SILENCE: State.GREETING,
        Event.LEFT: State.CLOSED,
    },
}


_STOPPED_SECONDS = 1.0
"""If a wait exceeds its deadline by this much, the process was stopped."""
_WARN_SECONDS = 5.0
"""A server without workers is logged after this time."""

_log = logging.getLogger(__name__)


class ListeningClock:
    """Measure the seconds spent listening. ``now`` is the caller's monotonic clock, in seconds."""

    def __init__(self, now: float) -> None:
        self._away = 0.0
        self._paused = now

    def time(self, now: float) -> float:
        """Return the seconds of listening so far, from an arbitrary origin."""
        return now - self._away

    def listen(self, now: float) -> None:
        """Start listening. The time since :meth:`pause` does not count."""
        self._away += max(0.0, now - self._paused)

    def pause(self, now: float) -> None:
        """Stop listening."""
        self._paused = now

    def wake(self, now: float, due: float) -> None:
        """End a wait for messages that was to end at ``due`` at the latest.

        If ``due`` is over 1 s ago, this process was stopped (in a terminal, by a batch system) and could not receive;
        the excess does not count.
        """
        if now - due > _STOPPED_SECONDS:
            self._away += now - due


class WorkerShortage:
    """Measure how long a server that answers has had no worker to make a requested sample.

    Args:
        now: seconds of listening.
        limit_seconds: time after which the consumer gives up.
    """

    def __init__(self, now: float, limit_seconds: float) -> None:
        self._since = now
        self._limit_seconds = limit_seconds
        self._warned = False

    def end(self, now: float) -> None:
        """Record that the server answered a request, or was replaced."""
        self._since = now

    def check(self, address: str, trouble: str, now: float) -> None:
        """Record the trouble that a server reports with its workers; log it after 5 s.

        Args:
            address: of the server.
            trouble: why no sample can be made; empty if there is no trouble, or no request.

        Raises:
            NoWorkers: there has been trouble for ``limit_seconds``.
        """
        if not trouble:
            self._since, self._warned = now, False
            return
        waited = now - self._since
        text = f"{address}: no sample for {waited:.0f} s, because {trouble}"
        if waited >= self._limit_seconds:
            raise NoWorkers(f"{text}; or wait longer with timeout_seconds (now {self._limit_seconds:g})")
        if waited >= _WARN_SECONDS and not self._warned:
            self._warned = True
            _log.warning("%s; giving up after %g s (timeout_seconds)", text, self._limit_seconds)


def unpack(frame: Buffer, size: int) -> Buffer:
    """Return the bytes of an array.

    Args:
        frame: a zstd frame that states its content size.
        size: of the array, in bytes. No more than this is ever allocated.

    Raises:
        ProtocolError: it is not a zstd frame, or it holds another number of bytes.
    """
    try:
        stated = zstandard.frame_content_size(frame)
        if stated == size:
            return zstandard.ZstdDecompressor().decompress(frame)
    except zstandard.ZstdError as error:
        raise ProtocolError(f"sample: a compressed array is damaged: {error}") from None
    raise ProtocolError(f"sample: a compressed array states {stated} bytes; it has {size}")
