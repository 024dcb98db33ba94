"""What a consumer and its server say to each other, as a machine of three states. Pure: messages in, messages out, and
the time is passed in, in seconds of listening (:class:`v2v_client.session.liveness.ListeningClock`).

Entering a state, be it from itself, is what makes us speak:

    GREETING    says Hello, and again, ever more rarely, until Welcome comes: either may have been lost
    WELCOMED    asks for everything that is unanswered; may ask for more

:data:`TRANSITIONS` has what leads where. An event that a state has no entry for changes nothing. After a restart, a
server that does not know us denies what we send; we say Hello with the resolved spec, and it must offer the same stream
as before. That everything is asked for again can make a sample twice; the reorder window drops the second.

Three things are no events but errors: nothing heard for ``timeout_seconds`` (ServerLost); for as long, a server that
answers, but has no worker that could make a sample (NoWorkers); and whatever no server of ours says (ProtocolError).
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Any

import numpy.typing as npt

from v2v_client.memory.slots import Answer, Slots
from v2v_client.position.state import StreamIdentity
from v2v_client.session.liveness import Patience
from v2v_client.session.packing import unpack
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.errors import NoWorkers, ProtocolError, RemoteError, SampleUnavailable, ServerLost
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import (
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
)
from v2v_protocol.sample import Form, Layout, Provenance, SampleId, array_layout
from v2v_protocol.wire import Buffer, decode_map, decode_sample, layout_of


class State(Enum):
    """Where a conversation stands."""

    CLOSED = auto()  # nobody was spoken to yet, or not any more
    GREETING = auto()  # Hello was said
    WELCOMED = auto()  # the server knows us


class Event(Enum):
    """What moves it."""

    OPENED = auto()  # there is a link
    WELCOME = auto()  # the server answered Hello
    FORGOTTEN = auto()  # it does not know us: it was restarted, or we were silent for too long
    DISCONNECTED = auto()  # the network was cut and is back: what was under way in either direction may be lost
    UNANSWERED = auto()  # the server lives, but no request was answered for long: messages may be lost
    SILENCE = auto()  # nothing at all was heard for as long: the link itself is suspect, and is made anew
    LEFT = auto()  # we said Goodbye


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

WAIT_REPORT_SECONDS = 1.0
"""From one word about how long samples are waited for to the next."""
_MOST_CREDIT_DENIALS = 3
_WARN_SECONDS = 5.0
"""So long after the last sign of hope a server without workers is worth a word."""
_NO_SLOTS: Mapping[int, Slot] = {}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Arrival:
    """One sample.

    Attributes:
        header: what is said of it; its provenance is opened by :meth:`Conversation.provenance`.
        arrays: read-only views of what was received, by name; None where a worker put them into their slot.
        slot_is_free: whether no worker writes to its slot any more.
    """

    header: SampleHeader
    arrays: Mapping[str, npt.NDArray[Any]] | None
    slot_is_free: bool = True


class Conversation:
    """A consumer's side of a session, for one epoch.

    Args:
        address: of the server, for messages of errors.
        hello: what to ask for.
        epoch: of the samples to ask for.
        pinned: the stream that the server must offer; None takes what it offers, and keeps to it.
        pinned_by: what pinned it, in words, for the message of a mismatch.
        patience: when to ping, to ask again and to give up.
        now: the time.

    Attributes:
        state: where it stands.
        outbox: messages to be sent, in order; whoever sends them empties it.
        stream: what the server offers, once welcomed.
        layout: dtype and shape of each array of one sample, once welcomed.
        credit: most samples asked for and not received.
        strays: samples of another epoch, dropped.
        waited_seconds: for how long samples were waited for since the last Hello; the server is told with each request,
            while they are waited for once a second, and at the end.
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
            # Nobody is given up unasked.
            ping_seconds=min(patience.ping_seconds, patience.timeout_seconds / 2),
        )
        self._rewant_seconds = min(patience.rewant_seconds, patience.timeout_seconds)
        self._answered = now  # a request, or all were asked again
        self._available_at = now  # the last time that nothing spoke against a sample to come
        self._warned = False
        self._moved = False  # from a broker that had offered the stream
        self._asked: dict[int, None] = {}  # sent and not answered, in that order
        self._queued: deque[int] = deque()  # to be sent when the credit allows
        self._hello_due = 0.0
        self._hello_wait = 0.0
        self._asked_again = False
        self._owed = False  # a request was denied for credit since everything was asked again
        self._credit_denials = 0
        self._last: int | None = None  # last sample received
        self._pinned: StreamIdentity | None = None
        self.state = State.CLOSED
        self.outbox: list[Message] = []
        self.credit = 0
        self.strays = 0
        self.waited_seconds = 0.0
        self._wait_reported_at = now
        if pinned is not None:
            self._pin(pinned)

    def move(self, address: str, now: float) -> None:
        """Goes on with the broker at ``address``, over a link that was just made: it must offer the same stream."""
        if self._pinned is not None and not self._moved:
            self._pinned_by += f", begun at {self._address},"
            self._moved = True
        self._address = address
        self._server.mark_heard(now)
        self._answered = self._available_at = now
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
        """Moves on."""
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
        """Does what the time demands.

        Returns:
            whether the link is to be connected anew before the outbox is sent.

        Raises:
            ServerLost: nothing was heard for ``timeout_seconds``.
            NoWorkers: for as long, nobody was there to make a sample.
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
            # A server answers anybody's Ping; that it forgot us shows only when something is asked, be it nothing.
            self.outbox += [Want(self._epoch, (), waited_seconds=self.waited_seconds), Ping()]
        return False

    def record_wait(self, seconds: float, now: float) -> None:
        """Samples have been waited for, so long since the last call, and still are."""
        self.waited_seconds += seconds
        if self.state is State.WELCOMED and now - self._wait_reported_at >= WAIT_REPORT_SECONDS:
            self._wait_reported_at = now
            self.outbox.append(Want(self._epoch, (), waited_seconds=self.waited_seconds))

    def next_due(self, now: float) -> float:
        """Seconds until :meth:`tick` has something to do, at least 0."""
        due = [self._server.next_due(now), self._answered + self._rewant_seconds - now]
        if self.state is State.GREETING:
            due.append(self._hello_due - now)
        return max(0.0, min(due))

    def silence(self, now: float) -> float:
        """Seconds for which nothing was heard."""
        return self._server.silence(now)

    def _server_lost(self, now: float) -> ServerLost:
        last = (
            "no sample was received" if self._last is None else f"last sample: epoch {self._epoch}, index {self._last}"
        )
        return ServerLost(
            f"{self._address}: nothing heard for {self._server.silence(now):.0f} s; {last}; start v2v-serve there, "
            f"or wait longer with timeout_seconds (now {self._patience.timeout_seconds:g})"
        )

    # --- asking -------------------------------------------------------------------------------------------------------

    def want(self, indices: Iterable[int], slots: Mapping[int, Slot] = _NO_SLOTS) -> None:
        """Asks for samples, as soon as the credit allows.

        Args:
            indices: of the samples.
            slots: where some of them may come to lie, if they were never asked for before.
        """
        self._queued.extend(indices)
        self._slots.offer(slots)
        if self.state is not State.WELCOMED:
            return
        room = self.credit - len(self._asked)
        now = [self._queued.popleft() for _ in range(min(room, len(self._queued)))]
        if now:
            self._asked.update(dict.fromkeys(now))
            # In one message: siblings are decoded together only if they are asked for together.
            self.outbox.append(replace(self._slots.want(self._epoch, now), waited_seconds=self.waited_seconds))

    def _want_again(self) -> None:
        # In the order they were asked; after a Welcome with less credit, the rest waits its turn.
        self._asked_again = self._asked_again or bool(self._asked)
        self._queued.extendleft(reversed(self._asked))
        self._asked.clear()
        self._owed = False
        self.want(())

    # --- hearing ------------------------------------------------------------------------------------------------------

    def handle_message(self, message: Message, arrays: list[Buffer], now: float) -> Arrival | None:
        """A message came.

        Args:
            message: its first frame.
            arrays: the raw frames behind it.
            now: the time.

        Returns:
            the sample, if it was one that was asked for.

        Raises:
            NoWorkers: nobody has been there to make a sample for ``timeout_seconds``.
            SampleUnavailable: the server cannot make a sample that was asked for.
            RemoteError: the server denies a request.
            StateMismatch: it offers another stream than the pinned one.
            ProtocolError: it sent what no server of ours sends.
        """
        self._server.mark_heard(now)
        if isinstance(message, Pong):
            self._check_for_workers(message.trouble, now)
        else:
            self._answered = self._available_at = now
        if isinstance(message, SampleHeader):
            return self._sample(message, arrays)
        if arrays:
            raise ProtocolError(f"{self._address} sent {type(message).__name__} with {len(arrays)} frames too many")
        match message:
            case Pong():
                pass
            case Welcome():
                self._accept_welcome(message, now)
            case Denied(code=ErrorCode.UNKNOWN_SESSION):
                # Every request that was under way is denied: one Hello answers them all.
                self.handle_event(Event.FORGOTTEN, now)
            case Denied(code=ErrorCode.CREDIT) if self._may_exceed_credit():
                # It makes again what it had sent, on the way to us, when we asked again. What it denied stays asked
                # for, in our account, and goes out again with the rest when such a sample comes, or when all is quiet.
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
                self.strays += 1
            case _:
                raise ProtocolError(f"{self._address} sent {type(message).__name__}, which no server sends a consumer")
        return None

    def _check_for_workers(self, trouble: str, now: float) -> None:
        if not trouble or not self._asked:
            self._available_at, self._warned = now, False
            return
        waited = now - self._available_at
        limit = self._patience.timeout_seconds
        text = f"{self._address}: no sample for {waited:.0f} s, because {trouble}"
        if waited >= limit:
            raise NoWorkers(f"{text}; or wait longer with timeout_seconds (now {limit:g})")
        if waited >= _WARN_SECONDS and not self._warned:
            self._warned = True
            _log.warning("%s; this is waited for until %g s have passed (timeout_seconds)", text, limit)

    def _may_exceed_credit(self) -> bool:
        return self._asked_again and self._credit_denials < _MOST_CREDIT_DENIALS

    def _accept_welcome(self, welcome: Welcome, now: float) -> None:
        stream = StreamIdentity.of(welcome)
        if welcome.credit < 1:
            raise ProtocolError(f"{self._address} grants a credit of {welcome.credit} samples")
        if self._pinned is None:
            self._pin(stream)
        else:
            self._pinned.require_same(stream, ours=self._pinned_by, theirs=self._address)
        self.stream, self.credit = stream, welcome.credit
        # A server that was restarted is asked to go on under what we have seen.
        self._hello = replace(self._hello, quarantine=welcome.quarantine)
        self.handle_event(Event.WELCOME, now)

    def _sample(self, header: SampleHeader, frames: list[Buffer]) -> Arrival | None:
        if header.epoch != self._epoch:
            self.strays += 1
            return None
        form = self.form
        if (header.names, header.dtypes, header.shapes) != (form.names, form.dtypes, form.shapes):
            raise ProtocolError(
                f"{self._address} sent sample {header.index} of epoch {header.epoch} as {layout_of(header)}; "
                f"asked: {self.layout}"
            )
        again = header.index not in self._asked
        in_message = bool(frames) or header.slot == NO_SLOT
        arrays = decode_sample(header, frames, unpack) if in_message else None
        answer = self._slots.record_arrival(header.index, header.slot, in_message=in_message)
        if answer is Answer.NOWHERE:
            self.strays += 1
            self._ask_for_more(again)
            return None
        self._hello = replace(self._hello, quarantine=max(self._hello.quarantine or 0, header.quarantine))
        self._asked.pop(header.index, None)
        self._credit_denials = 0
        self._last = header.index
        self._ask_for_more(again)
        return Arrival(header, arrays, slot_is_free=answer is not Answer.ABANDONED)

    def _ask_for_more(self, again: bool) -> None:
        """After a sample; one that comes again held credit that we took for free."""
        if again and self._owed:
            self._want_again()
        else:
            self.want(())

    def provenance(self, header: SampleHeader) -> Provenance:
        """Where a sample came from. Opened once its batch is whole: many at once take less than one at a time.

        Raises:
            ProtocolError: it is that of another sample, or of none.
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
