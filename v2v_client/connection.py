"""Run a conversation (:mod:`v2v_client.conversation`) with a server over a link.

Memory: the socket has no high-water mark, because the credit is the limit. The server never has more than ``credit``
answers under way, so at most credit x sample bytes wait here, or twice that shortly after requests were repeated.
Workers on this host write samples into slots of this process (:mod:`v2v_client.memory`) instead.

A connection belongs to the process that opened it. Its ZeroMQ context is created on opening, never before a fork.

All brokers make the same samples, so the choice between them only distributes load. Consumers (the loader workers of
all ranks, in the order of the ranks) are assigned to the list in contiguous blocks. If the launcher numbers ranks host
by host, and the list has one broker per host in the same order, every host uses its own broker. The consumers of a lost
broker are spread over all others.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
import platform
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace

from torch.utils.data import get_worker_info

from v2v_client.conversation import WAIT_REPORT_SECONDS, Arrival, Conversation, Event, ListeningClock, State
from v2v_client.memory import open_sample
from v2v_client.options import Options, Patience
from v2v_client.position import ResumeState, StreamIdentity
from v2v_protocol.arena import Slot
from v2v_protocol.errors import ServerLost, UsageError
from v2v_protocol.link.dealer import Dealer, diagnose
from v2v_protocol.messages import LARGEST_HEADER_BYTES, Hello, SampleHeader, decode, encode, largest_frame_bytes

_GOODBYE_LINGER_MS = 250
"""Time that closing may spend on sending the Goodbye. Without it the server would go on making requested samples."""
_REPORT_SECONDS = 5.0
"""A server that does not answer a Hello is reported after this time."""
_NO_SLOTS: Mapping[int, Slot] = {}

_log = logging.getLogger(__name__)


class Connection:
    """Hold a consumer's session with a server for one epoch.

    Args:
        address: ``tcp://host:port``, or several in the order in which they are tried. If one is silent for
            ``patience.takeover_seconds``, the next takes over. They share their workers, so a lack of those ends it.
        hello: the first message, with the requested spec and arrays.
        epoch: epoch of the samples to request.
        pinned: the stream that the server must offer; None accepts any.
        pinned_by: what pinned it, in words for the message of a mismatch.
        patience: timeouts for pinging, repeating requests and giving up; None for the defaults.
        clock: monotonic, in seconds.
        transport: creates the link to an address.

    Attributes:
        address: of the current broker.
        conversation: its state; stream, layout and credit are known once the connection is open.
    """

    def __init__(
        self,
        address: str | Sequence[str],
        hello: Hello,
        epoch: int,
        *,
        pinned: StreamIdentity | None = None,
        pinned_by: str = "this dataset",
        patience: Patience | None = None,
        clock: Callable[[], float] = time.monotonic,
        transport: Callable[[str], Dealer] = Dealer,
    ) -> None:
        hello = replace(hello, secret=secrets.token_bytes(32))
        self._brokers = (address,) if isinstance(address, str) else tuple(address)
        self._moves = 0  # changes of broker since the last sample
        self.address = self._brokers[0]
        self._is_pinned = pinned is not None
        self._patience = patience or Patience()
        self._clock = clock
        self._listening = ListeningClock(clock())
        self._transport = transport
        self._process = os.getpid()
        self._link: Dealer | None = None
        self._largest_frame_bytes = LARGEST_HEADER_BYTES
        self.conversation = Conversation(
            self.address, hello, epoch, pinned=pinned, pinned_by=pinned_by, patience=self._patience, now=self._now()
        )
        self._last_sample = self._now()  # initially the time of creation

    def _now(self) -> float:
        return self._listening.time(self._clock())

    # --- opening and closing ------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Send Hello and wait for the Welcome.

        The largest frame that the socket may accept follows from the layout. So if no stream is pinned yet, a first
        socket, which accepts frames no larger than a header, requests the layout.

        Raises:
            ServerLost: no answer within the deadline.
            RemoteError: the server refuses the spec.
            StateMismatch: the server offers another stream than the pinned one.
            UsageError: the address is malformed, an array is unknown, or the server belongs to another user.
        """
        self._link = self._transport(self.address)
        try:
            if not self._is_pinned:
                self._link.connect(self._largest_frame_bytes)
                self._await_welcome()
                self._leave(self._open_link())
            self._largest_frame_bytes = largest_frame_bytes(self.conversation.form.sizes)
            self._open_link().connect(self._largest_frame_bytes)
            self._await_welcome()
            self._listening.pause(self._clock())  # opening counts as listening
        except BaseException:
            self.close()
            raise

    def _await_welcome(self) -> None:
        self.conversation.handle_event(Event.OPENED, self._now())
        is_reported = False
        while self.conversation.state is not State.WELCOMED:
            if not is_reported and self.conversation.silence(self._now()) >= _REPORT_SECONDS:
                is_reported, limit = True, self._patience.timeout_seconds
                _log.warning("%s: %s; giving up after %g s", self.address, diagnose(self.address), limit)
            try:
                self._step(wait=True)
            except ServerLost as lost:
                raise ServerLost(f"{lost}; {diagnose(self.address)}") from lost

    def _leave(self, link: Dealer) -> None:
        """Send Goodbye, without waiting for a silent server."""
        quiet = self.conversation.silence(self._now()) >= self._patience.ping_seconds
        self.conversation.outbox.clear()
        self.conversation.handle_event(Event.LEFT, self._now())
        with suppress(ServerLost):  # no server to send it to
            self._send(link)
        link.disconnect(linger_ms=0 if quiet else _GOODBYE_LINGER_MS)

    def close(self) -> None:
        """Leave the server and free socket, context and thread. Later calls and calls in a forked child do nothing."""
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
        """Request samples as soon as the credit allows.

        Args:
            indices: global indices of the samples.
            slots: by index, where workers may write samples that were never requested before.

        Raises:
            ServerLost: this connection was closed.
            UsageError: another process opened it, from which this one was forked.
        """
        link = self._open_link()
        self.conversation.want(indices, slots)
        self._send(link)

    def receive(self, *, wait: bool = True) -> Arrival | None:
        """Return the next sample to arrive, in any order.

        Args:
            wait: False returns None if no sample has arrived yet.

        Raises:
            ServerLost: nothing was received for ``timeout_seconds``, or this connection was closed.
            UsageError: another process opened the connection, from which this one was forked.
            V2VError: see :meth:`Conversation.handle_message`.
        """
        began = self._clock()
        self._listening.listen(began)
        try:
            while True:
                arrival, idle = self._step(wait=wait)
                if wait:
                    began, before = self._clock(), began
                    self.conversation.record_wait(began - before, self._now())
                if arrival is not None or (idle and not wait):
                    return arrival
        finally:
            self._listening.pause(self._clock())

    def _step(self, *, wait: bool) -> tuple[Arrival | None, bool]:
        """Run due timers, then handle one message. Return (a sample, if one arrived; whether no message came)."""
        if len(self._brokers) > 1 and self.conversation.silence(self._now()) >= self._patience.takeover_seconds:
            self._take_over()
        arrival, idle = self._exchange(wait=wait)
        if arrival is not None:
            self._moves, self._last_sample = 0, self._now()
        return arrival, idle

    def _take_over(self) -> None:
        """Switch to the next broker and send it all unanswered requests. Brokers need no state of this consumer.

        Raises:
            ServerLost: all brokers had their turn, and ``timeout_seconds`` have passed.
        """
        now, waited = self._now(), self._now() - self._last_sample
        if self._moves >= len(self._brokers) - 1 and waited >= self._patience.timeout_seconds:
            raise ServerLost(
                f"{', '.join(self._brokers)}: no sample for {waited:.0f} s, and all are silent; start v2v-serve "
                f"there, or wait longer with timeout_seconds (now {self._patience.timeout_seconds:g})"
            )
        self._moves += 1
        lost = self.address
        self.address = self._brokers[(self._brokers.index(lost) + 1) % len(self._brokers)]
        _log.warning("%s: silent; %s takes over", lost, self.address)
        old, self._link = self._open_link(), self._transport(self.address)
        old.close()
        self._link.connect(self._largest_frame_bytes)
        self.conversation.move(self.address, now)

    def _exchange(self, *, wait: bool) -> tuple[Arrival | None, bool]:
        link, conversation = self._open_link(), self.conversation
        if conversation.tick(self._now()):
            link.connect(self._largest_frame_bytes, again=True)
        self._send(link)
        seconds = min(conversation.next_due(self._now()), WAIT_REPORT_SECONDS) if wait else 0.0
        due = self._clock() + seconds
        frames = link.receive(seconds)
        self._listening.wake(self._clock(), due)
        arrival = None
        if frames is not None:
            message, arrays = decode(frames[0]), frames[1:]
            if isinstance(message, SampleHeader) and message.arena and conversation.state is State.WELCOMED:
                arrays = [*open_sample(message.arena, conversation.form.sizes)]
            arrival = conversation.handle_message(message, arrays, self._now())
        elif link.has_reconnected():
            conversation.handle_event(Event.DISCONNECTED, self._now())
        self._send(link)
        return arrival, frames is None

    def _send(self, link: Dealer) -> None:
        outbox, self.conversation.outbox = self.conversation.outbox, []
        for message in outbox:
            link.send(encode(message))

    def _open_link(self) -> Dealer:
        if os.getpid() != self._process:
            raise UsageError(
                f"this iterator belongs to process {self._process}, and process {os.getpid()} was forked from it: call "
                "iter() in the process that takes the batches (DataLoader workers do)"
            )
        if self._link is None:
            raise ServerLost(f"{self.address}: this connection is closed")
        return self._link


@dataclass(frozen=True, slots=True)
class Connector:
    """Hold what all connections of a dataset have in common.

    Attributes:
        brokers: addresses of the servers.
        options: the requested stream.
        arrays, batch_size, seed, compress, keys, insecure, patience: see :class:`v2v_client.dataset.V2VStreamDataset`.
    """

    brokers: tuple[str, ...]
    options: Options
    arrays: tuple[str, ...]
    batch_size: int
    seed: int
    compress: bool
    keys: str | None
    insecure: bool
    patience: Patience

    def connection(
        self,
        state: ResumeState,
        rank: int,
        world_size: int,
        workers: int = 1,
        *,
        brokers: Sequence[str] | None = None,
        patience: Patience | None = None,
    ) -> Connection:
        """Return a connection that is not open yet.

        Args:
            state: where the consumer starts; its stream is pinned.
            rank, world_size: number of the rank, and of ranks.
            workers: number of loader workers of each rank; 1 without any.
            brokers: None tries all, in the order of this consumer.
            patience: None uses that of the dataset.

        Raises:
            StateMismatch: the options contradict the pinned stream.
        """
        loader, name, consumers = get_worker_info(), f"rank {rank} of {world_size}", world_size * workers
        consumer = rank * workers + (0 if loader is None else loader.id)
        hello = Hello(
            self.options.spec(state.stream, "this dataset's stream"),
            self.arrays,
            self.batch_size,
            self.seed,
            quarantine=state.quarantine if isinstance(state.quarantine, int) else None,  # a mixture does not connect
            stride=self.batch_size * consumers,
            name=name if loader is None else f"{name}, loader worker {loader.id} of {workers}",
            host=platform.node(),
            packed=self.compress,
        )
        return Connection(
            brokers or order(self.brokers, consumer, consumers),
            hello,
            state.epoch,
            pinned=state.stream,
            pinned_by="this dataset" if state.is_beginning else "the saved state",
            patience=patience or self.patience,
            transport=functools.partial(Dealer, keys=self.keys, insecure=self.insecure),
        )

    def compare(self, connection: Connection, state: ResumeState, *consumer: int) -> None:
        """Compare an open connection with the first other broker that answers, which is the same for nearly all ranks.

        Raises:
            StateMismatch: the two brokers offer different streams.
        """
        patience = dataclasses.replace(self.patience, timeout_seconds=self.patience.takeover_seconds)
        for broker in self.brokers if len(self.brokers) > 1 else ():
            if broker == connection.address:
                continue
            try:
                with closing(self.connection(state, *consumer, brokers=(broker,), patience=patience)) as other:
                    other.open()
                    connection.conversation.stream.require_same(
                        other.conversation.stream, ours=connection.address, theirs=broker
                    )
            except ServerLost as lost:
                _log.warning("cannot compare %s with %s before it takes over: %s", connection.address, broker, lost)
                continue
            return


def order(brokers: Sequence[str], consumer: int, consumers: int) -> tuple[str, ...]:
    """Return all brokers, in the order in which a consumer tries them.

    Args:
        brokers: their addresses, the same list for every consumer.
        consumer: the consumer's number, 0 <= consumer < consumers.
        consumers: number of consumers.
    """
    home = consumer * len(brokers) // consumers
    others = [*brokers[home + 1 :], *brokers[:home]]
    first = consumer % len(others) if others else 0
    return (brokers[home], *others[first:], *others[:first])
