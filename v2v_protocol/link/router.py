"""Listen for peers on a ROUTER socket, and limit what they can cost. I/O.

Memory: ZeroMQ keeps at most MOST_UNREAD whole messages from a peer, and at most MOST_QUEUED messages for one.
:mod:`v2v_protocol.link.guard` limits bytes, unfinished messages and connections.
"""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zmq

from v2v_protocol.errors import UsageError
from v2v_protocol.link.curve import Gate, KeyStore
from v2v_protocol.link.guard import ConnectionGuard

MOST_QUEUED = 512
"""Messages queued for one peer at which it is disconnected."""
MOST_UNREAD = 4
"""Messages queued from one peer. Beyond that its connection is not read, so only this peer waits."""
MOST_FRAMES = 64
"""Frames of a message; the largest in use has a dozen. A peer that sends more is disconnected."""
HANDSHAKE_MS = 3000
"""Time limit of a handshake, after which ZeroMQ disconnects the peer."""
_KEEPALIVE_SECONDS = 300
_REVIEW_SECONDS = 0.5
_ZERO_COPY_RECEIVE = 10  # an option of contexts that pyzmq has no name for
# Plain numbers: combining two flags of an enumeration takes longer than sending a small frame.
_NOBLOCK, _NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


@dataclass(frozen=True, slots=True)
class Limits:
    """What peers of a router may cost.

    Attributes:
        frame_bytes: largest frame of a message.
        connections: largest number at a time; None if only our own user can connect, who needs no guard.
        queued_bytes: largest number of bytes queued for one peer; None limits no bytes in either direction.
    """

    frame_bytes: int
    connections: int | None
    queued_bytes: int | None = None


class Routers:
    """The routers of one process, which share keys and an I/O thread.

    Args:
        keys: keys of the peers that may connect over ``tcp://``; None admits all peers.

    Raises:
        KeyRefused: the server's own keys cannot be read.
    """

    def __init__(self, keys: KeyStore | None = None) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # Otherwise each small frame of a peer may keep the whole buffer of 8 KiB that it was read into.
        self.context.set(_ZERO_COPY_RECEIVE, 0)
        self._routers: list[Router] = []
        self._poller = zmq.Poller()
        try:
            self.gate = None if keys is None else Gate(self.context, keys)
        except BaseException:
            self.context.destroy(linger=0)
            raise

    def open(self, side: str, limits: Limits) -> Router:
        """Return a new router for peers of a side, "consumer" or "worker"."""
        router = Router(self.context, side, limits, self.gate)
        self._routers.append(router)
        self._poller.register(router.socket, zmq.POLLIN)
        return router

    def wait(self, seconds: float) -> list[Router]:
        """Wait for a message; return the routers that have one."""
        ready = dict(self._poller.poll(int(seconds * 1000)))
        return [router for router in self._routers if router.socket in ready]

    def close(self) -> None:
        """Close all routers; unsent messages are dropped."""
        for router in self._routers:
            router.close()
        if self.gate is not None:
            self.gate.close()
        self.context.destroy(linger=0)


@dataclass(frozen=True, slots=True)
class Received:
    """A message of a peer.

    Attributes:
        identity: routing id of its connection.
        frames: the message: the first frame as bytes, the others in ZeroMQ's memory.
        user: the key of its connection; empty without keys and over ``ipc://``.
    """

    identity: bytes
    frames: list[Any]
    user: str


class Router:
    """One listening socket. :meth:`Routers.open` creates it."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], side: str, limits: Limits, gate: Gate | None = None
    ) -> None:
        self.socket = router = context.socket(zmq.ROUTER)
        self._side, self._gate = side, gate
        self._users: dict[bytes, str] = {}
        self._review_at = 0.0
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.SNDHWM, MOST_QUEUED)
        router.setsockopt(zmq.RCVHWM, MOST_UNREAD)
        router.setsockopt(zmq.MAXMSGSIZE, limits.frame_bytes)
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
        self.guard = (
            None
            if limits.connections is None
            else ConnectionGuard(router, limits.connections, limits.queued_bytes, is_encrypted=gate is not None)
        )

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
        if self._gate is not None and not admits_all and not address.startswith("ipc:"):
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

    def receive(self) -> Received | None:
        """Return an available message, if its sender's key has not been revoked since it connected, and it has at most
        MOST_FRAMES frames.
        """
        frames: list[Any] = []
        try:
            identity = frame = self.socket.recv(_NOBLOCK, copy=False)
            while frame.more:  # recv_multipart queries the socket instead, which takes longer
                frame = self.socket.recv(_NOBLOCK, copy=False)
                if len(frames) <= MOST_FRAMES:
                    frames.append(frame if frames else frame.bytes)
        except zmq.Again:
            return None  # the connection has just ended, and its message is gone
        sender, user = identity.bytes, ""
        if self.guard is not None:
            with suppress(zmq.ZMQError):  # ZeroMQ does not know this for messages of connections that have just ended
                self.guard.heard(sender, int(identity.get(zmq.SRCFD)), frames)
        if self._gate is not None:
            with suppress(zmq.ZMQError):  # it came over ipc://, and has no key
                user = self._users[sender] = str(identity.get("User-Id"))
                if not self._gate.admits(self._side, user):
                    return None  # the next review disconnects it
        if len(frames) > MOST_FRAMES:
            self.disconnect(sender)
            return None
        return Received(sender, frames, user)

    def send(self, identity: bytes, frames: Sequence[Any]) -> bool:
        """Queue a message; return False if the peer is not connected any more or does not read."""
        try:
            self.socket.send(identity, _NOBLOCK_MORE)
            for frame in frames[:-1]:
                self.socket.send(frame, _NOBLOCK_MORE, copy=False)
            self.socket.send(frames[-1], _NOBLOCK, copy=False)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            if error.errno == zmq.EHOSTUNREACH:
                return False
            raise
        if self.guard is not None:
            self.guard.sent(identity, sum(map(len, frames)))
        return True

    def disconnect(self, identity: bytes) -> None:
        """End the connection of a peer."""
        if self.guard is not None:
            self.guard.disconnect(identity)

    def take_ended(self) -> list[bytes]:
        """Return the peers whose connection ended since the last call; b"" if one never sent a message.
        Disconnect peers whose key was revoked.
        """
        ended = [] if self.guard is None else self.guard.take_ended()
        if self._gate is not None:
            self._review(self._gate, ended)
        return ended

    def _review(self, gate: Gate, ended: Iterable[bytes]) -> None:
        for identity in ended:
            self._users.pop(identity, None)
        if (now := time.monotonic()) >= self._review_at:
            self._review_at = now + _REVIEW_SECONDS
            for identity, user in self._users.items():
                if not gate.admits(self._side, user):
                    self.disconnect(identity)

    def close(self) -> None:
        """Stop the guard. :meth:`Routers.close` closes the socket."""
        if self.guard is not None:
            self.guard.close()
