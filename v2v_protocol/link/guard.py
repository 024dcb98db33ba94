"""Watch the connections of a router: which have ended, how many there are, and end one. I/O.

A stranger is refused by its key (:mod:`v2v_protocol.link.curve`) or its user (:mod:`v2v_protocol.link.user`). The
others are colleagues, who make mistakes and do not attack. So only the number of connections is limited: a newcomer
takes the place of the oldest connection without a session.

ZeroMQ's monitor reports the descriptor of each connection. A message names the descriptor that it came over
(``ZMQ_SRCFD``), but it may be read after its connection has ended and another has got the descriptor. Therefore
connections are numbered as they are accepted, and the answer to each handshake (:class:`v2v_protocol.link.curve.Gate`)
holds the number of the last one accepted until then. It comes back with each message of the connection. A message with
a lower number than the connection that has its descriptor now came over an earlier one.

A connection is shut down under ZeroMQ, which then forgets the peer and frees what it kept for it. A consumer that is
disconnected by mistake reconnects and goes on.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import zmq

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
        most_connections: largest number of connections at a time.
        has_session: returns whether the peer with a routing id has a session; called by another thread.
        admits: returns whether a connection that was just accepted may stay; None admits all.

    Attributes:
        monitor: has a message when :meth:`take_events` has something to do; None: never.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        most_connections: int,
        has_session: Callable[[bytes], bool],
        admits: Callable[[socket.socket], bool] | None = None,
    ) -> None:
        self._most_connections, self._has_session, self._admits = most_connections, has_session, admits
        self._connections: dict[int, _Connection] = {}  # open ones by descriptor, the oldest first
        self._previous: dict[int, _Connection] = {}  # ended ones whose descriptor has no new connection
        self._by_identity: dict[bytes, _Connection] = {}  # open ones that sent a message
        self._ended: list[bytes] = []
        self._accepted = 0
        self._lock = threading.Lock()
        self.monitor = router.get_monitor_socket(_EVENTS) if sys.platform == "linux" else None

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
