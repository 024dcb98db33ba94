"""Listen for peers on a ROUTER socket, and limit what they can cost. I/O.

Memory: ZeroMQ keeps at most MOST_UNREAD whole messages from a peer, and at most MOST_QUEUED messages for one.
:mod:`v2v_protocol.link.guard` limits connections.

Bytes for a peer are *in flight* from :meth:`Router.send` until ZeroMQ has freed the message: the system has taken them,
or the connection has ended. pyzmq's tracker of a message tells. Below ``_TRACKED_BYTES`` it is not worth its time, so
small messages count together with the next one that completes this size. Above MOST_IN_FLIGHT_BYTES to all peers
together, those that have taken nothing for ``_STUCK_SECONDS`` are disconnected. The sender of large messages holds
further ones back, by the counts of :meth:`Router.take_in_flight`.
"""

from __future__ import annotations

import errno
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import zmq

from v2v_protocol.errors import UsageError
from v2v_protocol.link.curve import Gate, KeyStore
from v2v_protocol.link.guard import ConnectionGuard
from v2v_protocol.messages import MOST_IN_FLIGHT_BYTES

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
            self.gate = Gate(self.context, keys)
        except BaseException:
            self.context.destroy(linger=0)
            raise

    def open(
        self,
        side: str,
        largest_frame_bytes: int,
        most_connections: int | None,
        has_session: Callable[[bytes], bool],
        admits: Callable[[socket.socket], bool] | None = None,
    ) -> Router:
        """Return a new router.

        Args:
            side: of its peers, "consumer" or "worker".
            largest_frame_bytes: a peer that sends a larger frame is disconnected.
            most_connections: largest number at a time; None if only our own user can connect, who needs no guard.
            has_session, admits: see :class:`v2v_protocol.link.guard.ConnectionGuard`.
        """
        router = Router(self.context, side, largest_frame_bytes, self.gate)
        if most_connections is not None:
            router.guard = ConnectionGuard(router.socket, most_connections, has_session, admits)
            self.gate.watch(side, router.guard)
        self._routers.append(router)
        self._poller.register(router.socket, zmq.POLLIN)
        return router

    def wait(self, seconds: float) -> list[Router]:
        """Wait for a message; return the routers that have one."""
        ready = dict(self._poller.poll(int(seconds * 1000)))
        return [router for router in self._routers if router.socket in ready]

    def close(self) -> None:
        """Close all routers; unsent messages are dropped."""
        self.gate.close()
        self.context.destroy(linger=0)


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


_R = TypeVar("_R", bound=Received)


class Router:
    """One listening socket. :meth:`Routers.open` creates it."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], side: str, largest_frame_bytes: int, gate: Gate
    ) -> None:
        self.socket = router = context.socket(zmq.ROUTER)
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
        self.guard: ConnectionGuard | None = None

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

    def receive(self, kind: type[_R]) -> _R | None:
        """Return an available message as a ``kind`` of :class:`Received`. One of a connection that may not stay, of a
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
        sender, user = identity.bytes, ""
        if self.guard is not None:
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
            self.disconnect(sender)
            return None
        return kind(sender, frames, user)

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
            self.disconnect(identity)
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
                self.disconnect(stuck)
        changed = {each: sum(size for _, size in self._in_flight[each]) for each in self._changed}
        self._changed.clear()
        for identity in [identity for identity, nbytes in changed.items() if not nbytes]:
            del self._in_flight[identity], self._taken_at[identity]
        return changed

    def disconnect(self, identity: bytes) -> None:
        """End the connection of a peer."""
        if self.guard is not None:
            self.guard.disconnect(identity)

    def take_ended(self) -> list[bytes]:
        """Return the peers whose connection ended since the last call; b"" if one never sent a message.
        Disconnect peers whose key was revoked.
        """
        ended = [] if self.guard is None else self.guard.take_ended()
        for identity in ended:
            self._users.pop(identity, None)
            self._untracked.pop(identity, None)
        if (now := time.monotonic()) >= self._review_at:
            self._review_at = now + _REVIEW_SECONDS
            for identity, user in self._users.items():
                if not self._gate.admits(self._side, user):
                    self.disconnect(identity)
        return ended


def _about(frame: Any, name: str | int) -> str | int | None:
    """Return a property of a frame; None if it has none."""
    try:
        return frame.get(name)  # type: ignore[no-any-return]
    except zmq.ZMQError:
        return None
