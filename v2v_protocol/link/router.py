"""Listen for consumers and for workers on two ROUTER sockets, and limit what their peers can cost. I/O.

A stranger is refused by its key (:class:`Gate`) or its user (:mod:`v2v_protocol.link.user`). The others are colleagues,
who make mistakes and do not attack. So only the number of connections is limited: a newcomer takes the place of the
oldest connection without a session. A connection is shut down under ZeroMQ, which then forgets the peer and frees what
it kept for it. A consumer that is disconnected by mistake reconnects and goes on.

ZeroMQ's monitor reports the descriptor of each connection. A message names the descriptor that it came over
(``ZMQ_SRCFD``), but it may be read after its connection has ended and another has got the descriptor. Therefore
connections are numbered as they are accepted, and the answer to each handshake holds the number of the last one
accepted until then. It comes back with each message of the connection. A message with a lower number than the
connection that has its descriptor now came over an earlier one.

Keys are CURVE keys (ZeroMQ RFC 26), and the answers follow ZAP (RFC 27). An answer depends on the key and the domain,
which is "consumer" or "worker": a key of one side is not valid at the other's port. ZeroMQ asks only at the handshake,
without keys too. It keeps the answer as the connection's user id, which comes with each of its messages: that number,
and the key, which may have been revoked since.

Memory: ZeroMQ keeps at most MOST_UNREAD whole messages from a peer, and at most MOST_QUEUED messages for one. Bytes for
a peer are *in flight* from :meth:`Router.send` until ZeroMQ has freed the message: the system has taken them, or the
connection has ended. pyzmq's tracker of a message tells. Below ``_TRACKED_BYTES`` it is not worth its time, so small
messages count together with the next one that completes this size. Above MOST_IN_FLIGHT_BYTES to all peers together,
those that have taken nothing for ``_STUCK_SECONDS`` are disconnected. The server holds large messages back, by these
counts and the credit of its consumers. Workers add at most 2 samples each, which pass through in the frames that
arrived.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import zmq
from zmq.utils import z85

from v2v_protocol.errors import UsageError, undo_on_error
from v2v_protocol.keys import SIDES
from v2v_protocol.messages import LARGEST_ARRAY_BYTES, LARGEST_REQUEST_BYTES, MOST_IN_FLIGHT_BYTES

MOST_QUEUED = 512
"""Messages queued for one peer at which it is disconnected."""
MOST_UNREAD = 4
"""Messages queued from one peer. Beyond that its connection is not read, so only this peer waits."""
MOST_MESSAGE_FRAMES = 64
"""Frames of a message; the largest in use has a dozen. A peer that sends more is disconnected."""
HANDSHAKE_MS = 3000
"""Time limit of a handshake, after which ZeroMQ disconnects the peer."""
_KEEPALIVE_SECONDS = 300
_REVIEW_SECONDS = 0.5
_TRACKED_BYTES = 1 << 16
_STUCK_SECONDS = 10.0
_COUNT_SECONDS = 1e-4
"""Time between two counts of the bytes in flight, for each peer that has any: a count takes a hundredth of it."""
_ZERO_COPY_RECEIVE = 10  # an option of contexts that pyzmq has no name for
# Plain numbers: combining two flags of an enumeration takes longer than sending a small frame.
_NOBLOCK, _NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)
_READ_SECONDS = 0.5
_POLL_SECONDS = 0.1
_EVENTS = int(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED)


@dataclass(eq=False, slots=True)
class _Connection:
    descriptor: int
    number: int
    inode: int = 0  # of its socket, which tells it from the next one with this descriptor
    identity: bytes = b""  # of a peer that sent a message
    is_cut: bool = False


class ConnectionGuard:
    """Watch a router's connections. Only Linux does; elsewhere all messages are accepted and no end is reported.

    Args:
        router: the socket; not bound yet.
        most_connections: largest number of connections at a time; None if only our own user can connect, who needs no
            guard.
        has_session: returns whether the peer with a routing id has a session; called by another thread.
        admits: returns whether a connection that was just accepted may stay; None admits all.

    Attributes:
        monitor: has a message when :meth:`take_events` has something to do; None: never.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        most_connections: int | None,
        has_session: Callable[[bytes], bool],
        admits: Callable[[socket.socket], bool] | None,
    ) -> None:
        self._most_connections, self._has_session, self._admits = most_connections or 0, has_session, admits
        self._connections: dict[int, _Connection] = {}  # open ones by descriptor, the oldest first
        self._previous: dict[int, _Connection] = {}  # ended ones whose descriptor has no new connection
        self._by_identity: dict[bytes, _Connection] = {}  # open ones that sent a message
        self._ended: list[bytes] = []
        self._accepted = 0
        self._lock = threading.Lock()
        watches = sys.platform == "linux" and most_connections is not None
        self.monitor = router.get_monitor_socket(_EVENTS) if watches else None

    def heard(self, identity: bytes, descriptor: int, number: int | None) -> bool:
        """Note a whole message of a peer; return whether it may be handled.

        Args:
            identity: routing id.
            descriptor: of the connection that the message came over; -1: not known.
            number: what :meth:`take_events` returned at the handshake of that connection; None if it had none.
        """
        with self._lock:
            connection = self._connections.get(descriptor) or self._previous.get(descriptor)
            if connection is None:
                return number is None or self.monitor is None
            if connection.is_cut or (number is not None and number < connection.number):
                return False
            if descriptor in self._previous:
                self._ended += {identity} - self._by_identity.keys()
            elif not connection.identity:
                connection.identity = identity
                self._by_identity[identity] = connection
            return True

    def disconnect(self, identity: bytes) -> None:
        """End a peer's connection."""
        if (connection := self._by_identity.get(identity)) is not None:
            _cut(connection)

    def take_ended(self) -> list[bytes]:
        """Return the peers whose connection ended since the last call; b"" if one never sent a message."""
        with self._lock:
            ended, self._ended = self._ended, []
        return ended

    def take_events(self) -> int:
        """Process all accepted and ended connections up to now; return the number of the last one accepted. Call it in
        one thread, and before a handshake is answered: then no message comes before its connection is checked.
        """
        newcomers = []
        while self.monitor is not None and int(self.monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            event, descriptor = struct.unpack("=hi", self.monitor.recv_multipart()[0])
            with self._lock:
                self._end(descriptor)
                if event == zmq.EVENT_ACCEPTED:
                    self._accepted += 1
                    self._previous.pop(descriptor, None)
                    self._connections[descriptor] = _Connection(descriptor, self._accepted)
                    newcomers.append(self._connections[descriptor])
        for newcomer in newcomers:
            is_admitted = False
            with suppress(OSError), _borrowed(newcomer.descriptor) as link:
                newcomer.inode = os.fstat(newcomer.descriptor).st_ino
                is_admitted = self._admits is None or self._admits(link)
            if not is_admitted:
                _cut(newcomer)
            elif len(self._connections) > self._most_connections:
                oldest_first = [*self._connections.values(), newcomer]
                _cut(next(x for x in oldest_first if x is newcomer or not (x.is_cut or self._has_session(x.identity))))
        return self._accepted

    def _end(self, descriptor: int) -> None:
        connection = self._connections.pop(descriptor, None)
        if connection is None:
            return
        self._previous[descriptor] = connection
        if not connection.identity:
            self._ended += [b""] if not self._ended else []
        elif self._by_identity.get(connection.identity) is connection:  # otherwise it is here over another one
            del self._by_identity[connection.identity]
            self._ended.append(connection.identity)


@contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Yield a connection that stays ZeroMQ's.

    Raises:
        OSError: the descriptor is closed, or is no socket.
    """
    link = socket.socket(fileno=descriptor)
    try:
        yield link
    finally:
        link.detach()


def _cut(connection: _Connection) -> None:
    connection.is_cut = True
    with suppress(OSError), _borrowed(connection.descriptor) as link:  # else it has just ended
        if os.fstat(connection.descriptor).st_ino == connection.inode:  # otherwise another has its descriptor already
            link.shutdown(socket.SHUT_RDWR)


class KeyStore(Protocol):
    """The keys that a server accepts."""

    def server_keys(self) -> tuple[bytes, bytes]:
        """Return the server's public and secret key.

        Raises:
            KeyRefused: there are none, or other users can read them.
        """

    def allowed(self) -> dict[str, dict[str, str]]:
        """Return the allowed keys of each side: names by public key."""


def new_key_pair() -> tuple[str, str]:
    """Return a new public and secret key."""
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


class Gate:
    """Answer the handshakes of a context, and let its guards process their events, until closed.

    Args:
        store: the keys; None requires none.

    Attributes:
        context: where the sockets are to be made.
        guards: of each side.

    Raises:
        KeyRefused: the server has no keys.
    """

    def __init__(self, store: KeyStore | None) -> None:
        self.store = store
        if store is not None:
            self._public, self._secret = store.server_keys()
            self._read(store)
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # Otherwise each small frame of a peer may keep the whole buffer of 8 KiB that it was read into.
        self.context.set(_ZERO_COPY_RECEIVE, 0)
        self.guards: dict[str, ConnectionGuard] = {}
        self._closing = threading.Event()
        self._requests = self.context.socket(zmq.REP)
        self._requests.bind("inproc://zeromq.zap.01")
        self._thread = threading.Thread(target=self._answer, name="v2v-gate", daemon=True)
        self._thread.start()

    def require(self, socket: zmq.Socket[bytes], side: str) -> None:
        """Require keys of that side, if there are keys, at the addresses that the socket binds from now on."""
        if self.store is not None:
            socket.curve_secretkey = self._secret
            socket.curve_publickey = self._public
            socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.ZAP_DOMAIN, side.encode())
        # Without a domain ZeroMQ accepts every peer if the authentication thread does not answer.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def admits(self, side: str, user: str) -> bool:
        """Return whether a key that passed the handshake is still valid."""
        return self.store is None or user in self._allowed[side]

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join()
        self._requests.close(linger=0)

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        while not self._closing.is_set():
            guards = [guard for guard in list(self.guards.values()) if guard.monitor is not None]
            ready, _, _ = zmq.select([self._requests, *(guard.monitor for guard in guards)], [], [], _POLL_SECONDS)
            if self.store is not None and time.monotonic() >= self._read_at + _READ_SECONDS:
                self._read(self.store)
            for guard in guards:
                guard.take_events()
            if self._requests in ready:
                version, request, domain, _, _, mechanism, *credentials = self._requests.recv_multipart()
                side = domain.decode(errors="replace")
                user = self._user(side, mechanism, credentials)
                status, text = (b"200", b"") if user is not None else (b"400", b"not a key of this side")
                number = self.guards[side].take_events()
                answer = b"%d %s" % (number, user or b"")
                self._requests.send_multipart([version, request, status, text, answer, b""])

    def _user(self, side: str, mechanism: bytes, credentials: list[bytes]) -> bytes | None:
        """Return the key of a handshake, empty if none is required; None if it is not valid."""
        if self.store is None:
            return b""
        if mechanism != b"CURVE" or side not in SIDES or len(credentials) != 1 or len(credentials[0]) != 32:
            return None
        public: bytes = z85.encode(credentials[0])
        if public.decode() not in self._allowed[side]:
            self._read(self.store)  # it may just have been created
        return public if public.decode() in self._allowed[side] else None

    def _read(self, store: KeyStore) -> None:
        self._read_at = time.monotonic()
        self._allowed = store.allowed()


@dataclass(frozen=True, slots=True)
class Received:
    """A message of a peer.

    Attributes:
        identity: routing id of its connection.
        frames: the message: the first frame as bytes, the others in ZeroMQ's memory.
        user: the key of its connection; empty without keys, and for a worker of this host.
    """

    identity: bytes
    frames: Sequence[Any]
    user: str = ""


class FromConsumer(Received):
    """A message that a consumer sent."""


class FromWorker(Received):
    """A message that a worker sent."""


@dataclass(frozen=True, slots=True)
class ConsumerGone:
    """The connection of a consumer has ended; the consumer may come back over another one.

    Attributes:
        identity: routing id; empty for connections that never sent a message.
    """

    identity: bytes


@dataclass(frozen=True, slots=True)
class InFlight:
    """How much of what was sent to a consumer has not left this process yet, after a change.

    Attributes:
        identity: routing id of its connection.
        nbytes: bytes, without small messages.
    """

    identity: bytes
    nbytes: int


ServerInput: TypeAlias = FromConsumer | FromWorker | ConsumerGone | InFlight


class Router:
    """One listening socket.

    Args:
        gate: checks its peers.
        side: of its peers, "consumer" or "worker".
        largest_frame_bytes: a peer that sends a larger frame is disconnected.
        most_connections, has_session, admits: see :class:`ConnectionGuard`.
    """

    def __init__(
        self,
        gate: Gate,
        side: str,
        largest_frame_bytes: int,
        most_connections: int | None,
        has_session: Callable[[bytes], bool],
        admits: Callable[[socket.socket], bool] | None,
    ) -> None:
        self.socket = router = gate.context.socket(zmq.ROUTER)
        self._side, self._gate = side, gate
        self._users: dict[bytes, str] = {}
        self._review_at = self._count_at = 0.0
        self._in_flight: dict[bytes, deque[tuple[zmq.MessageTracker, int]]] = {}  # oldest first, with their bytes
        self._taken_at: dict[bytes, float] = {}  # when a peer last took one of them, or the first was sent
        self._untracked: dict[bytes, int] = {}  # bytes for each peer since its last tracked message
        self._changed: set[bytes] = set()
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.SNDHWM, MOST_QUEUED)
        router.setsockopt(zmq.RCVHWM, MOST_UNREAD)
        router.setsockopt(zmq.MAXMSGSIZE, largest_frame_bytes)
        router.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        # Unroutable messages raise instead of vanishing.
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        # Our peers take a new routing id to replace a connection, so a second connection with one in use is a stranger.
        router.setsockopt(zmq.ROUTER_HANDOVER, 0)
        if sys.platform.startswith("linux"):
            # An ipc:// address is open to every user of this host; the system says whose process connects.
            router.setsockopt(zmq.IPC_FILTER_UID, os.getuid())
        # A host that vanishes (pre-empted, unplugged) does not close its connection, and no data is sent that would
        # reveal it. Without TCP keep-alive the connection would stay open for the life of this process.
        router.setsockopt(zmq.TCP_KEEPALIVE, 1)
        router.setsockopt(zmq.TCP_KEEPALIVE_IDLE, _KEEPALIVE_SECONDS)
        self.guard = gate.guards[side] = ConnectionGuard(router, most_connections, has_session, admits)

    def bind(self, address: str, flag: str, *, admits_all: bool = False) -> str:
        """Listen at an address; return it with its port.

        Args:
            address: ``tcp://host:port`` or ``ipc://name``.
            flag: name of the option that gave the address, for messages.
            admits_all: require no key at this address. Bind such an address before those that require one.

        Raises:
            UsageError: the address cannot be bound.
        """
        # Only our own user may connect to an ipc:// address.
        if not admits_all and not address.startswith("ipc:"):
            self._gate.require(self.socket, self._side)
        # Otherwise IPv4 addresses come back in their IPv6 form, which few readers recognise.
        self.socket.setsockopt(zmq.IPV6, int("[" in address))
        try:
            self.socket.bind(address)
        except zmq.ZMQError as error:
            is_port = error.errno in (errno.EADDRINUSE, errno.EACCES)
            remedy = "another port, or tcp://127.0.0.1:* for a free one" if is_port else "an address of this host"
            raise UsageError(f"{flag} {address}: {os.strerror(error.errno or 0)}; give {remedy}") from error
        return self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def receive(self) -> tuple[bytes, list[Any], str] | None:
        """Return the fields of an available :class:`Received`. A message of a connection that may not stay, of a
        revoked key, or with more than MOST_MESSAGE_FRAMES frames is dropped.
        """
        frames: list[Any] = []
        try:
            identity = frame = self.socket.recv(_NOBLOCK, copy=False)
            while frame.more:  # recv_multipart queries the socket instead, which takes longer
                frame = self.socket.recv(_NOBLOCK, copy=False)
                if len(frames) <= MOST_MESSAGE_FRAMES:
                    frames.append(frame if frames else frame.bytes)
        except zmq.Again:
            return None  # the connection has just ended, and its message is gone
        sender = identity.bytes
        # ZeroMQ knows neither for connections over ipc://, which have no handshake of ours.
        number, _, user = str(_about(identity, "User-Id") or "").partition(" ")
        descriptor = int(_about(identity, zmq.SRCFD) or -1)
        if not self.guard.heard(sender, descriptor, int(number) if number else None):
            return None
        if user:
            self._users[sender] = user
            if not self._gate.admits(self._side, user):
                return None  # the next review disconnects it
        if len(frames) > MOST_MESSAGE_FRAMES:
            self.guard.disconnect(sender)
            return None
        return sender, frames, user

    def send(self, identity: bytes, frames: Sequence[Any]) -> bool:
        """Queue a message. If the peer is not connected any more, does not read, or cannot be sent to for another
        reason, disconnect it and return False.
        """
        size, last = sum(map(len, frames)), frames[-1]
        counted = self._untracked.pop(identity, 0) + size
        if counted >= _TRACKED_BYTES:
            last = zmq.Frame(last, track=True, copy_threshold=0)
        try:
            self.socket.send(identity, _NOBLOCK_MORE)
            for frame in frames[:-1]:
                self.socket.send(frame, _NOBLOCK_MORE, copy=False)
            self.socket.send(last, _NOBLOCK, copy=False)
        except zmq.ZMQError:
            self.guard.disconnect(identity)
            return False
        if counted >= _TRACKED_BYTES:
            self._taken_at.setdefault(identity, time.monotonic())
            self._in_flight.setdefault(identity, deque()).append((last.tracker, counted))
            self._changed.add(identity)
        else:
            self._untracked[identity] = counted
        return True

    def take_in_flight(self) -> dict[bytes, int]:
        """Return the bytes in flight to each peer for which they have changed since the last call. If there are too
        many in all, disconnect the peer that has taken nothing for the longest time. Call it in each turn of the loop.
        """
        if self._in_flight and (now := time.monotonic()) >= self._count_at:
            self._count_at = now + _COUNT_SECONDS * len(self._in_flight)
            for identity, queue in self._in_flight.items():
                while queue and queue[0][0].done:
                    queue.popleft()
                    self._taken_at[identity] = now
                    self._changed.add(identity)
            stuck, taken_at = min(self._taken_at.items(), key=lambda each: each[1])
            in_all = sum(size for queue in self._in_flight.values() for _, size in queue)
            if in_all > MOST_IN_FLIGHT_BYTES and now - taken_at > _STUCK_SECONDS:
                self.guard.disconnect(stuck)
        changed = {each: sum(size for _, size in self._in_flight[each]) for each in self._changed}
        self._changed.clear()
        for identity in [identity for identity, nbytes in changed.items() if not nbytes]:
            del self._in_flight[identity], self._taken_at[identity]
        return changed

    def take_ended(self) -> list[bytes]:
        """Return the peers whose connection ended since the last call; b"" if one never sent a message.
        Disconnect peers whose key was revoked.
        """
        ended = self.guard.take_ended()
        for identity in ended:
            self._users.pop(identity, None)
            self._untracked.pop(identity, None)
        if (now := time.monotonic()) >= self._review_at:
            self._review_at = now + _REVIEW_SECONDS
            for identity, user in self._users.items():
                if not self._gate.admits(self._side, user):
                    self.guard.disconnect(identity)
        return ended


def _about(frame: Any, name: str | int) -> str | int | None:
    """Return a property of a frame; None if it has none."""
    try:
        return frame.get(name)  # type: ignore[no-any-return]
    except zmq.ZMQError:
        return None


class Sockets:
    """A router for consumers and one for workers.

    Args:
        bind: address for consumers.
        worker_bind: address for workers. Only our own user can connect to an ``ipc://`` address, and needs no guard.
        most_connections: largest number of consumer connections at a time, and of worker connections.
        keys: keys of the peers that may connect over ``tcp://``; None admits all peers.
        local_bind: address for workers of this host, which have no key; used if ``worker_bind`` is for other hosts.
        admits: returns whether a connection that was just accepted may stay; None admits all.

    Attributes:
        address, worker_address, local_address: where consumers, workers, and workers of this host connect.
        waited_seconds: total time that :meth:`receive` has waited without a message.
        has_session: returns whether a peer's connection is kept when another needs its place; called by another thread.

    Raises:
        UsageError: an address cannot be bound; the message names the flag.
        KeyRefused: the server's own keys cannot be read.
    """

    def __init__(
        self,
        bind: str,
        worker_bind: str,
        *,
        most_connections: int = 4096,
        keys: KeyStore | None = None,
        local_bind: str = "",
        admits: Callable[[socket.socket], bool] | None = None,
    ) -> None:
        self.waited_seconds = 0.0
        self.has_session: Callable[[bytes], bool] = lambda identity: False
        self._gate, self._poller = Gate(keys), zmq.Poller()
        with undo_on_error(self.close):
            is_private = worker_bind.startswith("ipc:")
            # The attribute is read at each call, because it is set later.
            asked = (lambda peer: self.has_session(peer)), admits
            self._consumers = Router(self._gate, "consumer", LARGEST_REQUEST_BYTES, most_connections, *asked)
            self._workers = Router(
                self._gate, "worker", LARGEST_ARRAY_BYTES, None if is_private else most_connections, *asked
            )
            self._poller.register(self._consumers.socket, zmq.POLLIN)
            self._poller.register(self._workers.socket, zmq.POLLIN)
            self.address = self._consumers.bind(bind, "--bind")
            has_local = bool(local_bind) and not is_private
            local = self._workers.bind(local_bind, "--worker-bind", admits_all=True) if has_local else ""
            self.worker_address = self._workers.bind(worker_bind, "--worker-bind")
            self.local_address = local or self.worker_address

    def receive(self, seconds: float) -> list[ServerInput]:
        """Return at most one message of each side, the workers' first, so that neither side can starve the other.
        Changes of what is in flight come first, ended connections last.

        Args:
            seconds: longest wait for any of them.
        """
        began = time.monotonic()
        ready = dict(self._poller.poll(int(seconds * 1000)))
        self.waited_seconds += time.monotonic() - began
        arrivals: list[ServerInput] = [InFlight(*each) for each in self._consumers.take_in_flight().items()]
        if self._workers.socket in ready and (sample := self._workers.receive()) is not None:
            arrivals.append(FromWorker(*sample))
        if self._consumers.socket in ready and (request := self._consumers.receive()) is not None:
            arrivals.append(FromConsumer(*request))
        arrivals += map(ConsumerGone, self._consumers.take_ended())
        self._workers.take_in_flight()
        self._workers.take_ended()
        return arrivals

    def send(self, identity: bytes, frames: Sequence[Any], *, to_worker: bool = False) -> bool:
        """Send a message to a consumer, or to a worker; return False if the peer is not connected any more or does not
        read.
        """
        return (self._workers if to_worker else self._consumers).send(identity, frames)

    def cut(self, identity: bytes) -> None:
        """End the connection of a consumer."""
        self._consumers.guard.disconnect(identity)

    def close(self) -> None:
        """End all connections; unsent messages are dropped."""
        self._gate.close()
        self._gate.context.destroy(linger=0)
