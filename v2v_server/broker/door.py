"""The door: a watch over the consumers' connections, which ZeroMQ counts by nothing but the size of one part. I/O.

ZeroMQ collects all parts of a message before it delivers one, and keeps what a peer does not read. It has no limit for
either. The system counts both for it: bytes that came over a connection, and bytes that the other end has taken. A
thread looks at them many times a second and ends the connection of a peer that

    sends more than any request without its end in sight     memory of the server, without a message
    has asked for more than it takes                         memory of the server, for samples
    says nothing that is a message after it has connected    a file of the server
    comes when all connections are taken

An address that opens one connection after the other and says nothing on them costs a handshake each time: the kernel
turns it away for a while (:mod:`v2v_server.keys.callers`, :mod:`v2v_server.system.turn_away`).

The connection is shut down under ZeroMQ, which then forgets the peer and what it kept for it. An honest consumer that
is cut off by mistake connects again and goes on. The loop learns whose connections have ended.

Only TCP on Linux is watched; an ``ipc://`` address lets in our own user only.
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
from dataclasses import dataclass
from typing import Any

import zmq

from v2v_protocol.wire import LARGEST_REQUEST_BYTES
from v2v_server.keys.callers import UNKNOWN, Callers
from v2v_server.system.turn_away import network_of, shown, turn_away

LOOK_SECONDS = 0.05
SAYS_NOTHING_SECONDS = 30.0
"""A consumer says Hello as soon as it has connected."""
MOST_CONNECTIONS = 4096 + 256
_LARGEST_UNREAD_BYTES = 6 * LARGEST_REQUEST_BYTES
"""More than ZeroMQ holds of whole messages (``transport.MOST_UNREAD``) and of one that is on its way."""
_SLACK_BYTES = 64 << 20
_EVENTS = int(zmq.EVENT_LISTENING | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED)
_TCP_INFO_BYTES, _ACKED, _RECEIVED = 136, 120, 128  # of struct tcp_info, Linux


def most_connections(files_for_others: int) -> int:
    """Connections that leave at least half of this process's files to everything else.

    Args:
        files_for_others: that workers take.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return max(1, min(MOST_CONNECTIONS, (soft - files_for_others) // 2))


@dataclass(slots=True)
class _Connection:
    peer: tuple[Any, ...] | None  # its address, by which it is known again
    caller: bytes | None  # its host; None: over a socket of this host
    since: float
    identity: bytes | None = None
    consumed: int = 0  # bytes that ZeroMQ had taken at the last look
    delivered: int = 0  # of those, how many at least are in messages that were delivered
    heard: bool = False  # a message since the last look
    sent: int = 0
    cut: bool = False


class Door:
    """Watches a socket's connections in a thread of its own, until closed.

    Args:
        router: the socket; not bound yet.
        most_connections: at a time.
        most_queued_bytes: of samples that a consumer has asked for and its host has not taken.
        most_unread_bytes: that may come without a message of them.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        most_connections: int,
        most_queued_bytes: int,
        most_unread_bytes: int = _LARGEST_UNREAD_BYTES,
    ) -> None:
        self._most_unread_bytes = most_unread_bytes
        self._most_connections = most_connections
        self._most_queued_bytes = most_queued_bytes + _SLACK_BYTES
        self._connections: dict[int, _Connection] = {}
        self._files: dict[bytes, int] = {}
        self._ended: list[bytes] = []
        self._callers = Callers()
        self._gone_silent: dict[int, bytes] = {}  # whose message may still come, by the descriptor that they had
        self._listening: list[int] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._monitor: zmq.Socket[bytes] | None = None
        if sys.platform == "linux":
            self._monitor = router.get_monitor_socket(_EVENTS)
            self._thread = threading.Thread(target=self._watch, args=(self._monitor,), name="v2v-door", daemon=True)
            self._thread.start()

    def heard(self, identity: bytes, file: int) -> None:
        """A whole message came from a consumer, over the connection of that descriptor."""
        with self._lock:
            if self._monitor is None:
                return
            self._take_events()
            connection = self._connections.get(file)
            if connection is None:  # it has gone already
                caller = self._gone_silent.pop(file, None)
                if caller is not None:
                    self._callers.spoke(caller, time.monotonic())
                if identity not in self._files:
                    self._ended.append(identity)
                return
            connection.heard = True
            if connection.identity != identity:
                if connection.identity is not None:  # who had the descriptor before, and was heard late
                    self._leave(connection.identity, file)
                elif connection.caller is not None:
                    self._callers.spoke(connection.caller, time.monotonic())
                connection.identity = identity
                self._files[identity] = file

    def sent(self, identity: bytes, size: int) -> None:
        """So many bytes are on their way to a consumer."""
        with self._lock:
            connection = self._connections.get(self._files.get(identity, -1))
            if connection is not None:
                connection.sent += size

    def cut(self, identity: bytes) -> None:
        """Ends a consumer's connection."""
        with self._lock:
            self._take_events()
            file = self._files.get(identity, -1)
            if file in self._connections:
                self._cut(file)

    def take_ended(self) -> list[bytes]:
        """Consumers whose connection has ended since the last call; b"" for some who never said who they were."""
        with self._lock:
            ended, self._ended = self._ended, []
        return ended

    def take_turned_away(self) -> list[str]:
        """Addresses that the kernel turns away, and did not before; "" for strangers."""
        with self._lock:
            return [shown(caller) if caller else "" for caller in self._callers.take_news()]

    def close(self) -> None:
        """Stops watching. To be called before the socket is closed."""
        self._closing.set()
        if self._monitor is not None:
            self._thread.join()
            self._monitor.close(linger=0)
            self._monitor = None

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _watch(self, monitor: zmq.Socket[bytes]) -> None:
        # A socket is for one thread at a time, and the loop reads this one, too: only its descriptor is waited for
        # without the lock.
        waiting = select.poll()
        waiting.register(int(monitor.getsockopt(zmq.FD)), select.POLLIN)
        look_at = time.monotonic()
        while not self._closing.is_set():
            waiting.poll(max(0.0, 1000 * (look_at - time.monotonic())))
            with self._lock:
                self._take_events()
                if (now := time.monotonic()) >= look_at:
                    look_at = now + LOOK_SECONDS
                    if self._callers.look(now):
                        self._turn_away()
                    for file in list(self._connections):
                        self._look(file, now)

    # --- under the lock -----------------------------------------------------------------------------------------------

    def _take_events(self) -> None:
        """Who has come and who has gone, in order, up to now.

        ZeroMQ tells of a connection before it delivers a message of it, but in another place: whoever asks about a
        message's connection reads these first.
        """
        if self._monitor is None:
            return
        while int(self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            event, file = struct.unpack("=hi", self._monitor.recv_multipart()[0])
            self._forget(file)
            if event == zmq.EVENT_LISTENING:
                self._listening.append(file)
            elif event == zmq.EVENT_ACCEPTED:
                self._accept(file)

    def _turn_away(self) -> None:
        away = [caller for caller in self._callers.away if caller != UNKNOWN]
        known = self._callers.known if UNKNOWN in self._callers.away else None
        for file in self._listening:
            turn_away(file, away, known)

    def _accept(self, file: int) -> None:
        peer, now = _peer(file), time.monotonic()
        caller = None if peer is _LOCAL else UNKNOWN if peer is None else network_of(peer[0])
        self._connections[file] = _Connection(peer, caller, now)
        if caller is not None and self._callers.came(caller, now):
            self._turn_away()
        if len(self._connections) > self._most_connections:
            # Those who have said nothing yet, the oldest first; perhaps the newcomer itself.
            silent = (each for each, known in self._connections.items() if known.identity is None and not known.cut)
            self._cut(next(silent, file))

    def _forget(self, file: int) -> None:
        connection = self._connections.pop(file, None)
        if connection is None:
            return
        if connection.identity is not None:
            self._leave(connection.identity, file)
            return
        if connection.caller is not None:
            self._gone_silent[file] = connection.caller
        if not self._ended:
            self._ended.append(b"")

    def _leave(self, identity: bytes, file: int) -> None:
        if self._files.get(identity) == file:  # otherwise it is here again over another connection
            del self._files[identity]
            self._ended.append(identity)

    def _look(self, file: int, now: float) -> None:
        connection = self._connections[file]
        counted = None if connection.cut else _counted(file)
        if counted is None:
            return
        consumed, taken = counted
        if connection.heard:
            # Messages come in order: what had come at the last look is delivered, or is in the few that wait.
            connection.heard, connection.delivered = False, connection.consumed
        connection.consumed = consumed
        if (
            consumed - connection.delivered > self._most_unread_bytes
            or connection.sent - taken > self._most_queued_bytes
            or (connection.identity is None and now - connection.since > SAYS_NOTHING_SECONDS)
        ):
            self._cut(file)

    def _cut(self, file: int) -> None:
        connection = self._connections[file]
        connection.cut = True
        if not connection.peer or _peer(file) != connection.peer:
            return  # no TCP; or closed already, and the descriptor is another's
        with contextlib.suppress(OSError):  # it has just ended
            link = _link(file)
            try:
                link.shutdown(socket.SHUT_RDWR)
            finally:
                link.detach()


def _link(file: int) -> socket.socket:
    """A connection that is ZeroMQ's: to be detached after use, never closed."""
    return socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, fileno=file)


_LOCAL: tuple[Any, ...] = ()


def _peer(file: int) -> tuple[Any, ...] | None:
    """Address of the other end; :data:`_LOCAL` where that is a process of this host; None where there is none."""
    try:
        link = socket.socket(fileno=file)
    except OSError:
        return None
    try:
        return link.getpeername() if link.family in (socket.AF_INET, socket.AF_INET6) else _LOCAL
    except OSError:
        return None
    finally:
        link.detach()


def _counted(file: int) -> tuple[int, int] | None:
    """Bytes that ZeroMQ has read from a connection, and bytes that the other end's system has taken."""
    try:
        link = _link(file)
    except OSError:
        return None  # it has just ended, and its event is on its way
    try:
        info = link.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
        waiting = int(struct.unpack("=i", fcntl.ioctl(file, termios.FIONREAD, bytes(4)))[0])
    except OSError:
        return None
    finally:
        link.detach()
    if len(info) < _TCP_INFO_BYTES:
        return None  # Linux before 4.1
    taken, received = (int(struct.unpack_from("=Q", info, offset)[0]) for offset in (_ACKED, _RECEIVED))
    return received - waiting, taken
