"""Send and receive frames over a connection's DEALER socket, and detect interruptions of the network.

ZeroMQ reconnects by itself after a disconnect, but reports no error, and messages under way are lost. Its monitor shows
it: every handshake after the first means that messages may have been lost. :meth:`Link.has_reconnected` tells the
caller when to send its requests again.

ZeroMQ does not recover from two faults: a peer whose packets vanish without an error, and a byte stream that is no
longer ZeroMQ's (the socket is dead after that). For those a :class:`Link` can connect again, under a new routing id,
because the server still holds the old one. The server recognises the consumer by the secret of its Hello.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from threading import Thread
from typing import Any, Protocol

import zmq

from v2v_protocol.errors import ServerLost, UsageError
from v2v_protocol.keys import HANDSHAKE_EVENTS, Handshakes, key_for
from v2v_protocol.wire import Frames

_RECONNECT_MS, _LONGEST_RECONNECT_MS = 100, 1000


class Transport(Protocol):
    """The interface of :class:`Link`, which tests implement with queues. After ``close`` methods raise ServerLost."""

    def connect(self, largest_frame_bytes: int, *, again: bool = False) -> None:
        """See :meth:`Link.connect`."""

    def disconnect(self, *, linger_ms: int) -> None:
        """See :meth:`Link.disconnect`."""

    def send(self, frames: Sequence[Any]) -> None:
        """See :meth:`Link.send`."""

    def receive(self, seconds: float) -> Frames | None:
        """See :meth:`Link.receive`."""

    def has_reconnected(self) -> bool:
        """See :meth:`Link.has_reconnected`."""

    def close(self) -> None:
        """See :meth:`Link.close`."""


class Link:
    """Hold one socket to one address, with its own ZeroMQ context. Create it after any fork, never before.

    Args:
        address: ``tcp://host:port``.
        keys: path of this consumer's key file; None uses the file that ``V2V_KEYS`` names, "" uses no key.

    Raises:
        KeyRefused: the key file cannot be used.

    Every method raises ServerLost once the link is closed.
    """

    def __init__(self, address: str, keys: str | None = None) -> None:
        self._address = address
        self._key = key_for(address, "consumer", keys)
        self._handshakes = Handshakes(address, self._key, "consumer")
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._poller = zmq.Poller()
        self._sockets = 0
        self._ipv6 = "[" in address
        self._torn = False

    def connect(self, largest_frame_bytes: int, *, again: bool = False) -> None:
        """Open a socket. The previous socket is dropped with all messages it holds.

        Args:
            largest_frame_bytes: a peer that sends a larger frame is disconnected before the frame is received.
            again: True if the previous socket got no answer. If it never connected, the other IP version is tried.

        Raises:
            UsageError: the address is malformed.
        """
        if again and self._monitor is not None and not self._count_handshakes():
            # If a name has IPv4 and IPv6 addresses ("localhost" usually does), ZeroMQ tries only the first.
            self._ipv6 = "[" in self._address or not self._ipv6
        self.disconnect(linger_ms=0)
        with self._mark_torn_on_error():
            socket = self._context.socket(zmq.DEALER)
            socket.setsockopt(zmq.ROUTING_ID, b"\x01" + os.urandom(15))  # a first byte of 0 is ZeroMQ's own
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVHWM, 0)
            socket.setsockopt(zmq.SNDHWM, 0)
            socket.setsockopt(zmq.IPV6, int(self._ipv6))
            socket.setsockopt(zmq.MAXMSGSIZE, largest_frame_bytes)
            socket.setsockopt(zmq.RECONNECT_IVL, _RECONNECT_MS)
            socket.setsockopt(zmq.RECONNECT_IVL_MAX, _LONGEST_RECONNECT_MS)
            self._sockets += 1
            events = f"inproc://handshakes-{self._sockets}"
            socket.monitor(events, HANDSHAKE_EVENTS)
            if self._key is not None:
                self._key.secure(socket)
            monitor = self._context.socket(zmq.PAIR)
            monitor.setsockopt(zmq.LINGER, 0)
            monitor.connect(events)
            self._socket, self._monitor = socket, monitor
            self._handshakes.begin()
            self._poller = zmq.Poller()
            self._poller.register(socket, zmq.POLLIN)
            self._poller.register(monitor, zmq.POLLIN)
        try:
            socket.connect(self._address)
        except zmq.ZMQError as error:
            raise UsageError(f"address {self._address!r}: {error}; give tcp://host:port") from error

    def disconnect(self, *, linger_ms: int) -> None:
        """Drop the socket, if there is one. Queued messages have ``linger_ms`` to leave, in the background."""
        socket, self._socket = self._socket, None
        monitor, self._monitor = self._monitor, None
        with self._mark_torn_on_error():
            if socket is not None:
                socket.close(linger=linger_ms)
            if monitor is not None:
                monitor.close()

    @contextmanager
    def _mark_torn_on_error(self) -> Iterator[None]:
        """Mark the link as torn permanently if the body raises.

        Only a signal handler can raise here. Its exception may leave a socket open to which only the frames of the
        traceback refer.
        """
        before, self._torn = self._torn, True
        yield
        self._torn = before

    def close(self) -> None:
        """Free context and I/O thread once the socket has lingered.

        If a signal has torn the link, this happens in the background, once nothing refers to its sockets.
        """
        try:
            self.disconnect(linger_ms=0)
        finally:
            if self._torn:
                # Terminating waits for every socket. Waiting here would keep the traceback alive that holds one open.
                Thread(target=self._context.destroy, kwargs={"linger": 0}, daemon=True).start()
            else:
                self._context.destroy(linger=0)

    def send(self, frames: Sequence[Any]) -> None:
        """Queue a message. It is sent once the peer can be reached."""
        socket = self._open(self._socket)
        try:
            socket.send_multipart(frames, flags=zmq.NOBLOCK)
        except zmq.Again:
            pass  # the handshake failed, which ended the connection for good: receive() reports why
        except zmq.ZMQError as error:
            raise ServerLost(f"{self._address}: cannot send: {error}") from error

    def receive(self, seconds: float) -> Frames | None:
        """Return the next message, or None if ``seconds`` passed or the monitor had an event instead."""
        socket = self._open(self._socket)
        try:
            if socket in dict(self._poller.poll(math.ceil(seconds * 1000))):
                frames = [socket.recv(zmq.NOBLOCK, copy=False)]
                while frames[-1].more:  # recv_multipart asks the socket for this, which is slower
                    frames.append(socket.recv(zmq.NOBLOCK, copy=False))
                return [frame.buffer for frame in frames]
            return None
        except zmq.Again:
            return None  # a connection that just ended took its messages with it
        except zmq.ZMQError as error:
            raise ServerLost(f"{self._address}: cannot receive: {error}") from error

    def has_reconnected(self) -> bool:
        """Return whether ZeroMQ has reconnected since the last call.

        Call this when nothing is left to receive; otherwise messages that came before the disconnect count as lost.

        Raises:
            KeyRefused: the server does not accept this key.
        """
        before = self._handshakes.succeeded
        return self._count_handshakes() > max(1, before)

    def _count_handshakes(self) -> int:
        """Return how often the socket has connected."""
        monitor = self._open(self._monitor)
        self._handshakes.take(lambda: monitor.poll(0), lambda: monitor.recv_multipart(flags=zmq.NOBLOCK))
        return self._handshakes.succeeded

    def _open(self, socket: zmq.Socket[bytes] | None) -> zmq.Socket[bytes]:
        if socket is None:
            raise ServerLost(f"{self._address}: this connection is closed")
        return socket
