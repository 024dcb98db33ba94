"""Send and receive messages of consumers and workers.

The loop (:mod:`v2v_server.serve`) uses only the :class:`ServerTransport` protocol. The server implements it with
:class:`Sockets`, two ZeroMQ sockets; tests implement it with plain queues.

Samples pass through in the frames that arrived; only the small header before them is read.

Memory: a consumer asks for more only after it has taken what it was sent. So the broker holds at most the sum over all
sessions of credit x sample bytes (in ZeroMQ's send queue of a slow consumer) + workers x 2 x sample bytes. A peer that
asks and never reads is disconnected at MOST_QUEUED messages, or at the bytes of its credit
(:mod:`v2v_server.broker.door`).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import zmq

from v2v_protocol.errors import UsageError
from v2v_protocol.wire import LARGEST_ARRAY_BYTES, LARGEST_REQUEST_BYTES
from v2v_server.broker.actions import ToConsumer, ToWorker
from v2v_server.broker.door import MOST_CONNECTIONS, Door
from v2v_server.keys.folder import KeyFolder
from v2v_server.keys.zap import HANDSHAKE_MS, Gate

MOST_QUEUED = 512
"""Messages queued for one peer at which it is disconnected; above any credit (``admission.MOST_CREDIT``)."""
MOST_UNREAD = 4
"""Messages queued from one peer. Beyond that its connection is not read, so only this peer waits."""
_KEEPALIVE_SECONDS = 300
_REVIEW_SECONDS = 0.5
# Plain numbers: combining two flags of an enumeration takes longer than sending a small frame.
_NOBLOCK, _NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


@dataclass(frozen=True, slots=True)
class FromConsumer:
    """A message that a consumer sent.

    Attributes:
        identity: routing id of its connection.
        frames: the message.
        user: name of the key of its connection; empty without keys.
    """

    identity: bytes
    frames: Sequence[Any]
    user: str = ""


@dataclass(frozen=True, slots=True)
class FromWorker:
    """A message that a worker sent.

    Attributes:
        identity: routing id of its connection.
        frames: the message.
        user: name of the key of its connection; empty without keys, and for a worker of this host.
    """

    identity: bytes
    frames: Sequence[Any]
    user: str = ""


@dataclass(frozen=True, slots=True)
class ConsumerGone:
    """The connection of a consumer has ended; the consumer may come back over another one.

    Attributes:
        identity: routing id; empty for connections that never sent a message.
    """

    identity: bytes


@dataclass(frozen=True, slots=True)
class TurnedAway:
    """New connections from an address are rejected, because it opened more connections without a message than a host
    needs.

    Attributes:
        address: of a host, or of an IPv6 network; empty if connections ended before their addresses could be read. Then
            all hosts that have sent no message within the hour are rejected.
        side: which port: that of consumers or of workers.
    """

    address: str
    side: str


Arrival: TypeAlias = FromConsumer | FromWorker | ConsumerGone | TurnedAway


class ServerTransport(Protocol):
    """Transport of messages between the server and its peers."""

    @property
    def address(self) -> str:
        """Where consumers connect."""

    @property
    def worker_address(self) -> str:
        """Where workers connect."""

    @property
    def waited_seconds(self) -> float:
        """Total time that :meth:`receive` has waited without a message, seconds."""

    def receive(self, seconds: float) -> list[Arrival]:
        """Return at most one message of each side, the workers' first, so that neither side can starve the other. Ended
        connections and rejected addresses follow last.

        Args:
            seconds: longest wait for any of them.
        """

    def send(self, action: ToConsumer | ToWorker) -> bool:
        """Send a message; return False if the peer is not connected any more or does not read."""

    def cut(self, identity: bytes) -> None:
        """End the connection of a consumer."""

    def close(self) -> None:
        """End all connections; unsent messages are dropped."""


class Sockets:
    """Two ROUTER sockets, one for consumers and one for workers.

    Args:
        bind: address for consumers.
        worker_bind: address for workers.
        most_connections: largest number of consumer connections at a time.
        most_queued_bytes: largest number of bytes queued for one consumer.
        keys: keys of the peers that may connect over ``tcp://``; None admits all peers.
        local_bind: address for workers of this host, which have no key; used if ``worker_bind`` requires keys.

    Raises:
        UsageError: an address cannot be bound; the message names the flag.
        KeyRefused: the server's own keys cannot be read.
    """

    def __init__(
        self,
        bind: str,
        worker_bind: str,
        *,
        most_connections: int = MOST_CONNECTIONS,
        most_queued_bytes: int = 1 << 40,
        keys: KeyFolder | None = None,
        local_bind: str = "",
    ) -> None:
        self.waited_seconds = 0.0
        self._context = zmq.Context()
        self._consumers = self._router(LARGEST_REQUEST_BYTES)
        self._workers = self._router(LARGEST_ARRAY_BYTES)
        try:
            self._gate = None if keys is None else Gate(self._context, keys)
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self._door = Door(self._consumers, most_connections, most_queued_bytes)
        # Workers send large samples, so only their number and silent connections are limited here.
        # Only our own user can reach an ipc:// address.
        is_private = worker_bind.startswith("ipc:")
        self._worker_door = None if is_private else Door(self._workers, most_connections, 1 << 40, 1 << 62)
        self._users: dict[tuple[str, bytes], str] = {}
        self._look_at_users = 0.0
        try:
            self._guard(self._consumers, bind, "consumer")
            _bind(self._consumers, bind, "--bind")
            self.local_address = ""
            if self._gate is not None and not worker_bind.startswith("ipc:") and local_bind:
                _bind(
                    self._workers, local_bind, "--worker-bind"
                )  # before the guard, which applies to the addresses bound after it
                self.local_address = self._workers.getsockopt_string(zmq.LAST_ENDPOINT)
            self._guard(self._workers, worker_bind, "worker")
            _bind(self._workers, worker_bind, "--worker-bind")
        except BaseException:
            self.close()
            raise
        self._poller = zmq.Poller()
        self._poller.register(self._consumers, zmq.POLLIN)
        self._poller.register(self._workers, zmq.POLLIN)
        self.address = self._consumers.getsockopt_string(zmq.LAST_ENDPOINT)
        self.worker_address = self._workers.getsockopt_string(zmq.LAST_ENDPOINT)
        self.local_address = self.local_address or self.worker_address

    def _guard(self, router: zmq.Socket[bytes], address: str, side: str) -> None:
        # Only our own user may connect to an ipc:// address.
        if self._gate is not None and not address.startswith("ipc:"):
            self._gate.guard(router, side)

    def _router(self, largest_bytes: int) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.SNDHWM, MOST_QUEUED)
        router.setsockopt(zmq.RCVHWM, MOST_UNREAD)
        router.setsockopt(zmq.MAXMSGSIZE, largest_bytes)
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
        return router

    def receive(self, seconds: float) -> list[Arrival]:
        """Implement :meth:`ServerTransport.receive`."""
        began = time.monotonic()
        ready = dict(self._poller.poll(int(seconds * 1000)))
        self.waited_seconds += time.monotonic() - began
        arrivals: list[Arrival] = []
        if self._workers in ready and (message := self._receive(self._workers, "worker")) is not None:
            arrivals.append(FromWorker(*message, self._users.get(("worker", message[0]), "")))
        if self._consumers in ready and (message := self._receive(self._consumers, "consumer")) is not None:
            arrivals.append(FromConsumer(*message, self._users.get(("consumer", message[0]), "")))
        gone = self._door.take_ended()
        workers_gone = [] if self._worker_door is None else self._worker_door.take_ended()
        if self._gate is not None:
            self._review(self._gate, gone, workers_gone)
        arrivals += map(ConsumerGone, gone)
        for door, side in ((self._door, "consumer"), (self._worker_door, "worker")):
            if door is not None:
                arrivals += (TurnedAway(address, side) for address in door.take_turned_away())
        return arrivals

    def _receive(self, router: zmq.Socket[bytes], side: str) -> tuple[bytes, list[Any]] | None:
        """Return an available message and its sender, if the sender's key has not been revoked since it connected.

        The header is copied out as bytes; what follows stays in ZeroMQ's own frames.
        """
        frames: list[Any] = []
        try:
            identity = frame = router.recv(_NOBLOCK, copy=False)
            while frame.more:  # recv_multipart queries the socket instead, which takes longer
                frame = router.recv(_NOBLOCK, copy=False)
                frames.append(frame if frames else frame.bytes)
        except zmq.Again:
            return None  # the connection has just ended, and its message is gone
        door = self._door if side == "consumer" else self._worker_door
        if door is not None:
            with suppress(zmq.ZMQError):  # ZeroMQ does not know this for messages of connections that have just ended
                door.heard(identity.bytes, int(identity.get(zmq.SRCFD)))
        if self._gate is not None:
            with suppress(zmq.ZMQError):  # it came over ipc://, and has no key
                user = str(identity.get("User-Id"))
                self._users[side, identity.bytes] = user
                if not self._gate.admits(side, user):
                    return None  # the next review cuts it off
        return identity.bytes, frames

    def _review(self, gate: Gate, consumers: list[bytes], workers: list[bytes]) -> None:
        """Forget peers that are gone, and disconnect peers whose key was revoked."""
        for side, identities in (("consumer", consumers), ("worker", workers)):
            for identity in identities:
                self._users.pop((side, identity), None)
        if (now := time.monotonic()) < self._look_at_users:
            return
        self._look_at_users = now + _REVIEW_SECONDS
        for (side, identity), user in self._users.items():
            door = self._door if side == "consumer" else self._worker_door
            if door is not None and not gate.admits(side, user):
                door.cut(identity)

    def send(self, action: ToConsumer | ToWorker) -> bool:
        """Implement :meth:`ServerTransport.send`."""
        router = self._consumers if isinstance(action, ToConsumer) else self._workers
        try:
            router.send(action.identity, _NOBLOCK_MORE)
            for frame in action.frames[:-1]:
                router.send(frame, _NOBLOCK_MORE, copy=False)
            router.send(action.frames[-1], _NOBLOCK, copy=False)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            if error.errno == zmq.EHOSTUNREACH:
                return False
            raise
        if isinstance(action, ToConsumer):
            self._door.sent(action.identity, sum(map(len, action.frames)))
        return True

    def cut(self, identity: bytes) -> None:
        """Implement :meth:`ServerTransport.cut`."""
        self._door.cut(identity)

    def close(self) -> None:
        """Close both sockets; unsent messages are dropped."""
        self._door.close()
        if self._worker_door is not None:
            self._worker_door.close()
        if self._gate is not None:
            self._gate.close()
        self._context.destroy(linger=0)


def _bind(router: zmq.Socket[bytes], address: str, flag: str) -> None:
    # Otherwise IPv4 addresses come back in their IPv6 form, which few readers recognise.
    router.setsockopt(zmq.IPV6, int("[" in address))
    try:
        router.bind(address)
    except zmq.ZMQError as error:
        raise UsageError(f"{flag} {address}: {error.strerror or error}") from error
