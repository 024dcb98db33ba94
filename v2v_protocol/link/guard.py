"""Guard a server against peers that cost it memory or descriptors. I/O.

ZeroMQ collects all parts of a message before it delivers the first, and keeps what a peer does not read. It limits the
size of a part and the number of messages, not the bytes. Linux counts for each TCP connection the bytes that came and
those that the other end has acknowledged. The guard compares these counts with the messages that were delivered, and
ends the connection of a peer that

    sends more than any request without the end of a message    unfinished bytes, of one connection
    has the most unfinished bytes, if all together are too many  unfinished bytes, of all connections
    does not finish a message in time                            unfinished bytes, by age
    requests more than it reads                                  samples
    sends no message after it has connected                      a descriptor
    has been idle for the longest, if no connection is free      a descriptor

An empty part takes 2 bytes on the wire and 64 in memory, so unfinished bytes cost at most 32 times as much memory.

The connection is shut down under ZeroMQ, which then forgets the peer and frees what it kept for it. An honest consumer
that is disconnected by mistake reconnects and goes on. The loop learns which connections have ended.

The guard's thread measures only connections on which something happened: idle ones cost nothing. Only TCP on Linux is
measured; an ``ipc://`` address admits our own user only.
"""

from __future__ import annotations

import contextlib
import fcntl
import resource
import select
import socket
import struct
import sys
import termios
import threading
import time
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import Any

import zmq

from v2v_protocol.wire import LARGEST_REQUEST_BYTES

CHECK_SECONDS, _HURRIED_CHECK_SECONDS = 0.05, 0.01
IDLE_SECONDS = 30.0
"""End a connection that sent its last message this long ago if another needs its place, or that never sent one."""
MOST_CONNECTIONS = 4096 + 256
_MOST_UNFINISHED_BYTES = 6 * LARGEST_REQUEST_BYTES
"""Of one connection: more than ZeroMQ holds of whole messages (``router.MOST_UNREAD``) and of one on its way."""
_MOST_UNFINISHED_IN_ALL_BYTES = 2 << 20
"""Of all connections: 64 MiB of empty parts. A request has at most 1 KB as a rule, so 2,000 may wait at a time."""
_SLOW_BYTES, _MOST_SLOW_SECONDS = 4096, 10.0
"""A message with more unfinished bytes must end within this time, in which the loop reads."""
_LONGEST_TURN_SECONDS = 1.0
"""The loop is held up if its last turn began longer ago; whole messages that wait for it look unfinished."""
_HANDSHAKE_BYTES, _CURVE_HANDSHAKE_BYTES = 128, 640
_CURVE_FRAME_BYTES = 33
_SLACK_BYTES = 64 << 20
_LATE_SECONDS = CHECK_SECONDS
"""A message of an ended connection is read at most this long after its end, while the loop reads; a peer that connects
again does so later (``dealer``)."""
_EVENTS = int(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED)
_TCP_INFO_BYTES, _ACKED, _RECEIVED = 136, 120, 128  # of struct tcp_info, Linux


def most_connections(files_for_others: int) -> int:
    """Return the number of connections that leaves at least half of this process's descriptors to everything else.

    Args:
        files_for_others: descriptors that workers take.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return max(1, min(MOST_CONNECTIONS, (soft - files_for_others) // 2))


@dataclass(slots=True)
class _Connection:
    peer: tuple[Any, ...] | None  # its address, which identifies it; None if it has no TCP address
    heard_at: float  # the guard's time at the check before its last message; at first before its accept
    identity: bytes | None = None
    is_heard: bool = False  # since the last check
    delivered: int = 0  # bytes on the wire of its handshake and of the messages that were delivered
    slow_seconds: float = 0.0  # in which its message did not end
    sent: int = 0
    is_cut: bool = False


class ConnectionGuard:
    """Watch a router's connections in a thread, until closed.

    Args:
        router: the socket; not bound yet.
        most_connections: largest number of connections at a time.
        most_queued_bytes: largest number of bytes that were sent to a peer and its host has not acknowledged; None
            limits no bytes in either direction.
        is_encrypted: whether connections use CURVE.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        most_connections: int,
        most_queued_bytes: int | None = None,
        *,
        is_encrypted: bool = False,
    ) -> None:
        self._most_connections = most_connections
        self._most_queued_bytes = None if most_queued_bytes is None else most_queued_bytes + _SLACK_BYTES
        self._handshake_bytes = _CURVE_HANDSHAKE_BYTES if is_encrypted else _HANDSHAKE_BYTES
        self._frame_bytes = _CURVE_FRAME_BYTES if is_encrypted else 0
        self._connections: dict[int, _Connection] = {}  # by descriptor, the least recently heard first
        self._left: dict[int, tuple[bytes | None, float]] = {}  # who had a descriptor until just now, and when it ended
        self._silent: dict[int, None] = {}  # those that have sent no message, the oldest first
        self._descriptors: dict[bytes, int] = {}
        self._to_check: set[int] = set()
        self._unfinished: dict[int, int] = {}  # bytes of messages that were not delivered
        self._ended: list[bytes] = []
        # The guard's time: seconds in which the loop has read, until the last check and in the interval before it.
        self._now = self._elapsed_seconds = 0.0
        self._checked_at = self._turn_at = time.monotonic()
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._monitor: zmq.Socket[bytes] | None = None
        if sys.platform == "linux":
            self._received = select.epoll()
            self._monitor = router.get_monitor_socket(_EVENTS)
            self._thread = threading.Thread(target=self._watch, args=(self._monitor,), name="v2v-guard", daemon=True)
            self._thread.start()

    def heard(self, identity: bytes, descriptor: int, frames: Sequence[Sized]) -> None:
        """Note a whole message of a peer.

        Args:
            identity: routing id.
            descriptor: of the connection that the message came over.
            frames: the message.
        """
        with self._lock:
            if self._monitor is None:
                return
            self._take_events()
            connection = self._connections.get(descriptor)
            previous, _ = self._left.get(descriptor, (None, 0.0))
            if connection is None or identity == previous:  # it has ended; another may have its descriptor already
                if identity not in self._descriptors:
                    self._ended.append(identity)
                return
            if connection.identity != identity:
                if connection.identity is not None:  # the previous owner of the descriptor, heard late
                    self._leave(connection.identity, descriptor)
                connection.identity = identity
                self._descriptors[identity] = descriptor
                self._silent.pop(descriptor, None)
            for frame in frames:
                body = len(frame) + self._frame_bytes
                connection.delivered += body + (2 if body < 256 else 9)
            if not connection.is_heard:
                connection.is_heard, connection.heard_at = True, self._now
                self._to_check.add(descriptor)
                self._connections[descriptor] = self._connections.pop(descriptor)

    def sent(self, identity: bytes, size: int) -> None:
        """Note that bytes are queued for a peer."""
        with self._lock:
            descriptor = self._descriptors.get(identity, -1)
            connection = self._connections.get(descriptor)
            if connection is not None:
                connection.sent += size
                self._to_check.add(descriptor)

    def disconnect(self, identity: bytes) -> None:
        """End a peer's connection."""
        with self._lock:
            self._take_events()
            descriptor = self._descriptors.get(identity, -1)
            # Shortly after an end, a late first message may have given this identity to the descriptor's next owner.
            if descriptor in self._connections and descriptor not in self._left:
                self._cut(descriptor)

    def take_ended(self) -> list[bytes]:
        """Return the peers whose connection ended since the last call; b"" if one never sent a message. Call it in each
        turn of the loop.
        """
        with self._lock:
            self._turn_at = time.monotonic()
            ended, self._ended = self._ended, []
        return ended

    def close(self) -> None:
        """Stop watching. Call it before the socket is closed."""
        self._closing.set()
        if self._monitor is not None:
            self._thread.join()
            self._monitor.close(linger=0)
            self._monitor = None
            self._received.close()

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _watch(self, monitor: zmq.Socket[bytes]) -> None:
        # A socket is for one thread at a time, and the loop reads this one, too: only its descriptor is waited for
        # without the lock.
        waiting = select.poll()
        waiting.register(int(monitor.getsockopt(zmq.FD)), select.POLLIN)
        check_at = time.monotonic()
        while not self._closing.is_set():
            waiting.poll(max(0.0, 1000 * (check_at - time.monotonic())))
            with self._lock:
                self._take_events()
                if (now := time.monotonic()) >= check_at:
                    unfinished = self._check(now)
                    is_calm = unfinished < _MOST_UNFINISHED_IN_ALL_BYTES / 4
                    check_at = now + (CHECK_SECONDS if is_calm else _HURRIED_CHECK_SECONDS)

    # --- under the lock -----------------------------------------------------------------------------------------------

    def _take_events(self) -> None:
        """Process all accepted and ended connections, in order, up to now.

        ZeroMQ reports a connection before it delivers a message of it, but in another place: read these events before
        looking up the connection of a message.
        """
        if self._monitor is None:
            return
        while int(self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            event, descriptor = struct.unpack("=hi", self._monitor.recv_multipart()[0])
            self._forget(descriptor)
            if event == zmq.EVENT_ACCEPTED:
                self._accept(descriptor)

    def _accept(self, descriptor: int) -> None:
        self._connections[descriptor] = _Connection(_peer(descriptor), self._now, delivered=self._handshake_bytes)
        self._silent[descriptor] = None
        self._to_check.add(descriptor)  # what it sent before it is registered below is not reported
        if self._most_queued_bytes is not None:
            with contextlib.suppress(OSError):  # it has ended, or ended late and is still registered
                # Edge-triggered: reports a connection once after each arrival of data, although ZeroMQ reads the data.
                self._received.register(descriptor, select.EPOLLIN | select.EPOLLET)
        if len(self._connections) > self._most_connections:
            self._cut(self._dispensable(descriptor))

    def _dispensable(self, newcomer: int) -> int:
        """Return the connection to end for a newcomer: the oldest silent one, perhaps the newcomer, unless the least
        recently heard one is idle.
        """
        silent = next(iter(self._silent))
        if silent == newcomer:
            for descriptor, connection in self._connections.items():
                if not connection.is_cut:
                    is_idle = self._now - connection.heard_at >= IDLE_SECONDS
                    return descriptor if is_idle else newcomer
        return silent

    def _forget(self, descriptor: int) -> None:
        connection = self._connections.pop(descriptor, None)
        if connection is None:
            return
        self._left[descriptor] = connection.identity, self._now
        self._silent.pop(descriptor, None)
        self._to_check.discard(descriptor)
        self._unfinished.pop(descriptor, None)
        if connection.identity is not None:
            self._leave(connection.identity, descriptor)
        elif not self._ended:
            self._ended.append(b"")

    def _leave(self, identity: bytes, descriptor: int) -> None:
        if self._descriptors.get(identity) == descriptor:  # otherwise it is here again over another connection
            del self._descriptors[identity]
            self._ended.append(identity)

    def _check(self, now: float) -> int:
        """Measure the connections on which something happened, and end those beyond a limit; return the unfinished
        bytes of all.
        """
        # Time in which this process was stopped, or its loop was held up, does not count.
        is_reading = now - self._turn_at < _LONGEST_TURN_SECONDS
        self._elapsed_seconds = min(now - self._checked_at, 2 * CHECK_SECONDS) if is_reading else 0.0
        self._checked_at = now
        self._now += self._elapsed_seconds
        self._left = {key: left for key, left in self._left.items() if self._now - left[1] < _LATE_SECONDS}
        while (
            self._silent and self._now - self._connections[oldest := next(iter(self._silent))].heard_at > IDLE_SECONDS
        ):
            self._cut(oldest)
        self._to_check.update(descriptor for descriptor, _ in self._received.poll(0, MOST_CONNECTIONS))
        to_check, self._to_check = self._to_check, set()
        for descriptor in to_check & self._connections.keys():
            self._measure(descriptor, self._connections[descriptor])
        in_all = sum(self._unfinished.values())
        while in_all > _MOST_UNFINISHED_IN_ALL_BYTES:
            largest = max(self._unfinished, key=self._unfinished.__getitem__)
            in_all -= self._unfinished[largest]
            self._cut(largest)
        return in_all

    def _measure(self, descriptor: int, connection: _Connection) -> None:
        """Measure a connection, and end it if it is beyond a limit of its own."""
        is_heard, connection.is_heard = connection.is_heard, False
        if connection.is_cut or self._most_queued_bytes is None or (counted := _counted(descriptor)) is None:
            return
        consumed, waiting, acknowledged = counted
        connection.delivered = min(connection.delivered, max(consumed, self._handshake_bytes))
        unfinished = self._unfinished[descriptor] = max(0, consumed - connection.delivered)
        is_slow = unfinished > _SLOW_BYTES and not is_heard
        connection.slow_seconds = connection.slow_seconds + self._elapsed_seconds if is_slow else 0.0
        if (
            unfinished > _MOST_UNFINISHED_BYTES
            or connection.slow_seconds > _MOST_SLOW_SECONDS
            or connection.sent - acknowledged > self._most_queued_bytes
        ):
            self._cut(descriptor)
        elif unfinished > _SLOW_BYTES or waiting or connection.sent > acknowledged:
            self._to_check.add(descriptor)  # again, although nothing more may come

    def _cut(self, descriptor: int) -> None:
        connection = self._connections[descriptor]
        connection.is_cut = True
        self._silent.pop(descriptor, None)
        self._unfinished.pop(descriptor, None)
        if connection.peer is None or _peer(descriptor) != connection.peer:
            return  # no TCP; or closed already, and the descriptor is another's
        with contextlib.suppress(OSError):  # it has just ended
            link = _socket(descriptor)
            try:
                link.shutdown(socket.SHUT_RDWR)
            finally:
                link.detach()


def _socket(descriptor: int) -> socket.socket:
    """Return a connection that is ZeroMQ's: detach it after use, never close it."""
    return socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fileno=descriptor)


def _peer(descriptor: int) -> tuple[Any, ...] | None:
    """Return the TCP address of the other end; None if it has none or has just ended."""
    try:
        link = socket.socket(fileno=descriptor)
    except OSError:
        return None
    try:
        return link.getpeername() if link.family in (socket.AF_INET, socket.AF_INET6) else None
    except OSError:
        return None
    finally:
        link.detach()


def _counted(descriptor: int) -> tuple[int, int, int] | None:
    """Return the bytes of a connection that ZeroMQ has read, that it has not read yet, and that the other end has
    acknowledged.
    """
    try:
        link = _socket(descriptor)
    except OSError:
        return None  # it has just ended, and its event is on its way
    try:
        info = link.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
        waiting = int(struct.unpack("=i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))[0])
    except OSError:
        return None
    finally:
        link.detach()
    if len(info) < _TCP_INFO_BYTES:
        return None  # Linux before 4.1
    acknowledged, received = (int(struct.unpack_from("=Q", info, offset)[0]) for offset in (_ACKED, _RECEIVED))
    return received - waiting, waiting, acknowledged
