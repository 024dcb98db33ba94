"""The consumer's end of the wire: a session with a server, and what to do when nothing comes.

Rules
    Hello is answered by Welcome. It is sent again, ever more rarely, until it is: either may have been lost.
    A server that does not know us (it was restarted, or forgot us while we were silent) refuses what we send; then we
    say Hello with the resolved spec, and it must offer the same stream as before.
    After every Welcome, whenever the network was cut and came back, and whenever nothing was answered for
    ``rewant_seconds`` although pongs come, everything unanswered is asked for again. That can make a sample twice; the
    reorder window drops the second.
    Nothing at all heard for ``rewant_seconds``: the connection itself is suspect, and another one is made.
    Nothing heard for ``timeout_seconds`` of listening: ServerLost.

Memory: the socket has no high-water mark, because the credit is the limit: the server never has more than ``credit``
answers under way, so at most credit x sample bytes wait here, twice that in the moments after asking again. Workers on
this host put them into slots that are lent to them (:mod:`v2v_client.memory.lending`).

A connection belongs to the process that made it; its ZeroMQ context is made when it is opened, never before a fork.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace

import zmq

from v2v_client.memory.lending import Lending
from v2v_client.position.state import Stream
from v2v_client.session.arrival import Arrival, opened_provenance
from v2v_client.session.link import Link
from v2v_client.session.liveness import Due, Liveness, Patience
from v2v_protocol.arena import Slot
from v2v_protocol.errors import ProtocolError, RemoteError, SampleUnavailable, ServerLost, UsageError
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
from v2v_protocol.wire import LARGEST_HEADER_BYTES, decode, encode, layout_of

_GOODBYE_LINGER_MS = 250
"""How long closing may take to get the Goodbye out: without it the server would go on with what was asked for."""
_MOST_CREDIT_REFUSALS = 3
_NO_SLOTS: Mapping[int, Slot] = {}


class Connection:
    """A consumer's session with a server, for one epoch.

    Args:
        address: ``tcp://host:port``.
        hello: what to ask for.
        epoch: of the samples to ask for.
        pinned: the stream that the server must offer; None takes what it offers.
        pinned_by: what pinned it, in words, for the message of a mismatch.
        patience: when to ping, to ask again and to give up.
        clock: seconds, never going back.

    Attributes:
        stream: what the server offers; set by :meth:`open`.
        credit: most samples asked for and not received.
        layout: dtype and shape of each array of one sample.
        strays: samples of another epoch, dropped.
    """

    stream: Stream
    layout: Layout
    _form: Form

    def __init__(
        self,
        address: str,
        hello: Hello,
        epoch: int,
        *,
        pinned: Stream | None = None,
        pinned_by: str = "this dataset",
        patience: Patience | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = address
        self._hello = hello
        self._quarantine = hello.quarantine  # a server that was restarted is asked to go on under what we have seen
        self._epoch = epoch
        self._pinned = pinned
        self._pinned_by = pinned_by
        self._patience = patience or Patience()
        self._clock = clock
        self._process = os.getpid()
        self._lending = Lending()
        self._link: Link | None = None
        self._largest_frame_bytes = LARGEST_HEADER_BYTES
        self._liveness = Liveness(self._patience, clock())
        self._asked: dict[int, None] = {}  # sent and not answered, in that order
        self._queued: deque[int] = deque()  # to be sent when the credit allows
        self._welcome_due: float | None = None  # when to say Hello again; None once welcomed
        self._hello_wait = 0.0
        self._asked_again = False
        self._owed = False  # a request was refused for credit since everything was asked again
        self._credit_refusals = 0
        self._last: int | None = None  # last sample received
        self.credit = 0
        self.strays = 0

    # --- opening and closing ------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Says Hello and waits for the Welcome.

        The largest frame the socket accepts is known only with the layout. So where no stream is pinned yet, a first
        socket that accepts nothing larger than a header asks for it.

        Raises:
            ServerLost: no answer within the deadline.
            RemoteError: the server refuses the spec.
            StateMismatch: it offers another stream than the pinned one.
            UsageError: the address, or the arrays, are not understood.
        """
        self._link = Link(self._address)
        try:
            if self._pinned is None:
                self._link.connect(LARGEST_HEADER_BYTES)
                self._await_welcome()
                self._pinned = self.stream
                self._leave(self._link)
            self._hello = replace(self._hello, spec=self._pinned.spec)
            self.layout = self._layout(self._pinned)
            self._form = Form.of(self.layout)
            self._largest_frame_bytes = max(LARGEST_HEADER_BYTES, *self._form.sizes)
            self._link.connect(self._largest_frame_bytes)
            self._await_welcome()
            self._liveness.pause(self._clock())  # until here we listened
        except BaseException:
            self.close()
            raise

    def _layout(self, stream: Stream) -> Layout:
        spec = stream.resolved
        return array_layout(spec.recipe, spec.voxel_dtype, self._hello.arrays)

    def _await_welcome(self) -> None:
        self._begin_hello()
        while self._welcome_due is not None:
            self._step(wait=True)

    def _begin_hello(self) -> None:
        self._hello_wait = self._patience.ping_seconds
        self._welcome_due = self._clock() + self._hello_wait
        self._say_hello()

    def _say_hello(self) -> None:
        self._send(replace(self._hello, quarantine=self._quarantine))

    def _leave(self, link: Link) -> None:
        """Tells the server, where that does not take long."""
        quiet = self._liveness.silence(self._clock()) >= self._patience.ping_seconds
        with suppress(ServerLost):  # nobody to tell
            link.send(encode(Goodbye()))
        link.disconnect(linger_ms=0 if quiet else _GOODBYE_LINGER_MS)

    def close(self) -> None:
        """Leaves the server and frees socket, context and thread. May be called again, and in a forked child, where it
        does nothing."""
        if os.getpid() != self._process:
            return
        link, self._link = self._link, None
        if link is not None:
            try:
                self._leave(link)
            finally:
                link.close()

    # --- asking and receiving -----------------------------------------------------------------------------------------

    def want(self, indices: Iterable[int], slots: Mapping[int, Slot] = _NO_SLOTS) -> None:
        """Asks for samples, as soon as the credit allows.

        Args:
            indices: of the samples.
            slots: where some of them may come to lie, if they were never asked for before.

        Raises:
            ServerLost: this connection was closed.
            UsageError: it was opened by another process, from which this one was forked.
        """
        self._queued.extend(indices)
        self._lending.offer(slots)
        if self._welcome_due is not None:
            return
        room = self.credit - len(self._asked)
        now = [self._queued.popleft() for _ in range(min(room, len(self._queued)))]
        if not now:
            return
        self._asked.update(dict.fromkeys(now))
        # In one message: siblings are decoded together only if they are asked for together.
        self._send(self._lending.want(self._epoch, now))

    def _want_again(self) -> None:
        # In the order they were asked; after a Welcome with less credit, the rest waits its turn.
        self._asked_again = self._asked_again or bool(self._asked)
        self._queued.extendleft(reversed(self._asked))
        self._asked.clear()
        self._owed = False
        self.want(())

    def receive(self, *, wait: bool = True) -> Arrival | None:
        """The next sample to arrive, whichever it is.

        Args:
            wait: False returns None when none is here yet.

        Raises:
            ServerLost: nothing was heard for ``timeout_seconds``.
            SampleUnavailable: the server cannot make a sample that was asked for.
            RemoteError: the server refuses a request.
            StateMismatch: after a restart the server offers another stream.
            ProtocolError: it sent what no server of ours sends.
            UsageError: the connection was opened by another process, from which this one was forked.
        """
        self._liveness.listen(self._clock())
        try:
            while True:
                arrival, idle = self._step(wait=wait)
                if arrival is not None or (idle and not wait):
                    return arrival
        finally:
            self._liveness.pause(self._clock())

    def _step(self, *, wait: bool) -> tuple[Arrival | None, bool]:
        """Does what is due, then handles one message: (a sample if it was one, whether no message came)."""
        now = self._clock()
        self._attend(now)
        seconds = self._liveness.next_due(now) if wait else 0.0
        if self._welcome_due is not None and wait:
            seconds = min(seconds, max(0.0, self._welcome_due - now))
        link = self._open_link()
        frames = link.receive(seconds)
        self._liveness.woke(self._clock(), now + seconds)
        if frames is None:
            if link.remade():
                self._resume()
            return None, True
        message = decode(frames[0].buffer)
        answer = not isinstance(message, Pong)
        self._liveness.heard(self._clock(), answer=answer)
        if isinstance(message, SampleHeader):
            return self._sample(message, frames[1:]), False
        if len(frames) != 1:
            raise ProtocolError(f"{self._address} sent {type(message).__name__} with {len(frames) - 1} frames too many")
        self._handle(message)
        return None, False

    def _attend(self, now: float) -> None:
        """Pings, asks again, connects anew or gives up, as the silence demands."""
        due = self._liveness.due(now)
        if due is Due.GIVE_UP:
            raise self._lost(now)
        if due is Due.CONNECT_ANEW:
            self._open_link().connect(self._largest_frame_bytes, keep_name=True)
            self._begin_hello()
        elif self._welcome_due is not None:
            if now >= self._welcome_due:
                self._hello_wait *= 2
                self._welcome_due = now + self._hello_wait
                self._say_hello()
        elif due is Due.WANT_AGAIN or (due is Due.PING and self._owed):
            self._want_again()
            self._send(Ping())
        elif due is Due.PING:
            # A server answers anybody's Ping; that it forgot us shows only when something is asked, be it nothing.
            self._send(Want(self._epoch, ()))
            self._send(Ping())

    def _resume(self) -> None:
        """The network was cut and is back: what was under way in either direction may be lost."""
        if self._welcome_due is not None:
            self._begin_hello()
        else:
            self._want_again()

    def _handle(self, message: Message) -> None:
        match message:
            case Pong():
                pass
            case Welcome():
                self._welcomed(message)
            case Denied(code=ErrorCode.UNKNOWN_SESSION):
                # Every request that was under way is refused: one Hello answers them all.
                if self._welcome_due is None:
                    self._begin_hello()
            case Denied(code=ErrorCode.CREDIT) if self._may_exceed_credit():
                # It makes again what it had sent, on the way to us, when we asked again. What it refused stays asked
                # for, in our account, and goes out again with the rest when such a sample comes, or when all is quiet.
                self._credit_refusals += 1
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

    def _may_exceed_credit(self) -> bool:
        return self._asked_again and self._credit_refusals < _MOST_CREDIT_REFUSALS

    def _welcomed(self, welcome: Welcome) -> None:
        stream = Stream.of(welcome)
        if welcome.credit < 1:
            raise ProtocolError(f"{self._address} grants a credit of {welcome.credit} samples")
        if self._pinned is not None:
            self._pinned.require_same(stream, ours=self._pinned_by, theirs=self._address)
        self.stream, self.credit = stream, welcome.credit
        self._quarantine = welcome.quarantine
        self._welcome_due = None
        self._want_again()

    def _sample(self, header: SampleHeader, frames: list[zmq.Frame]) -> Arrival | None:
        if header.epoch != self._epoch:
            self.strays += 1
            return None
        form = self._form
        if (header.names, header.dtypes, header.shapes) != (form.names, form.dtypes, form.shapes):
            raise ProtocolError(
                f"{self._address} sent sample {header.index} of epoch {header.epoch} as {layout_of(header)}; "
                f"asked: {self.layout}"
            )
        again = header.index not in self._asked
        found = self._lending.payload(header, frames)
        if found is None:
            self.strays += 1
            self._ask_on(again)
            return None
        self._quarantine = max(self._quarantine or 0, header.quarantine)
        self._asked.pop(header.index, None)
        self._credit_refusals = 0
        self._last = header.index
        self._ask_on(again)
        return Arrival(header, found)

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
        return opened_provenance(header, identity, self._address)

    def _ask_on(self, again: bool) -> None:
        """After a sample; one that comes again held credit that we took for free."""
        if again and self._owed:
            self._want_again()
        else:
            self.want(())

    # --- the link -----------------------------------------------------------------------------------------------------

    def _open_link(self) -> Link:
        if os.getpid() != self._process:
            raise UsageError(
                f"this iterator belongs to process {self._process}, and process {os.getpid()} was forked from it: call "
                "iter() in the process that takes the batches (DataLoader workers do)"
            )
        if self._link is None:
            raise ServerLost(f"{self._address}: this connection is closed")
        return self._link

    def _send(self, message: Message) -> None:
        self._open_link().send(encode(message))

    def _lost(self, now: float) -> ServerLost:
        last = (
            "no sample was received" if self._last is None else f"last sample: epoch {self._epoch}, index {self._last}"
        )
        return ServerLost(
            f"{self._address}: nothing heard for {self._liveness.silence(now):.0f} s; {last}; start v2v-serve there, "
            f"or wait longer with timeout_seconds (now {self._patience.timeout_seconds:g})"
        )
