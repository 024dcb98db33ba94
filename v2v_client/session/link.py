"""The DEALER socket under a connection: frames in and out, and whether the network was cut in between.

ZeroMQ connects again by itself after a cut, but it tells nobody, and what was under way is gone. Its monitor does tell:
every handshake after the first means that messages may have been lost, so :meth:`Link.remade` says when to ask again.

Two faults it does not repair by itself: a peer whose packets vanish without any error, and a stream of bytes that is
no ZeroMQ stream any more (it then leaves the socket dead). For those a :class:`Link` can be connected again, under a
new routing id: the server still holds the old one. It knows the consumer by the secret of its Hello.
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
    """What a connection needs of a link: a :class:`Link`, or the queues of a test. Closed, it raises ServerLost."""

    def connect(self, largest_frame_bytes: int, *, again: bool = False) -> None:
        """See :meth:`Link.connect`."""

    def disconnect(self, *, linger_ms: int) -> None:
        """See :meth:`Link.disconnect`."""

    def send(self, frames: Sequence[Any]) -> None:
        """See :meth:`Link.send`."""

    def receive(self, seconds: float) -> Frames | None:
        """See :meth:`Link.receive`."""

    def remade(self) -> bool:
        """See :meth:`Link.remade`."""

    def close(self) -> None:
        """See :meth:`Link.close`."""


class Link:
    """One socket to one address; a ZeroMQ context of its own, made here, so never before a fork.

    Args:
        address: ``tcp://host:port``.
        keys: file of this consumer's key; None takes what ``V2V_KEYS`` names, "" none.

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
        """Opens a socket, in place of the one before, which is dropped with whatever it holds.

        Args:
            largest_frame_bytes: a peer that sends a larger frame is cut off before it is received.
            again: the socket before gave no answer. If it never connected, another kind of address is tried.

        Raises:
            UsageError: the address is not understood.
        """
        if again and self._monitor is not None and not self._shaken_hands():
            # Of a name that stands for addresses of both kinds ("localhost", as a rule) ZeroMQ tries the first only.
            self._ipv6 = "[" in self._address or not self._ipv6
        self.disconnect(linger_ms=0)
        with self._in_one_piece():
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
        """Drops the socket, if there is one; what was sent has ``linger_ms`` to leave, in the background."""
        socket, self._socket = self._socket, None
        monitor, self._monitor = self._monitor, None
        with self._in_one_piece():
            if socket is not None:
                socket.close(linger=linger_ms)
            if monitor is not None:
                monitor.close()

    @contextmanager
    def _in_one_piece(self) -> Iterator[None]:
        """Marks the link as torn for good if an exception strikes in here. Only one that a signal's handler raises
        does, and it may leave a socket open that is known to nobody but the frames of its traceback."""
        before, self._torn = self._torn, True
        yield
        self._torn = before

    def close(self) -> None:
        """Frees context and thread, after the time the socket was given to linger; where a signal has torn the link, in
        the background, once nothing holds its sockets any more."""
        try:
            self.disconnect(linger_ms=0)
        finally:
            if self._torn:
                # Terminating waits for every socket, and waiting here keeps the traceback alive that keeps one open.
                Thread(target=self._context.destroy, kwargs={"linger": 0}, daemon=True).start()
            else:
                self._context.destroy(linger=0)

    def send(self, frames: Sequence[Any]) -> None:
        """Queues a message; it is sent when the peer can be reached."""
        socket = self._open(self._socket)
        try:
            socket.send_multipart(frames, flags=zmq.NOBLOCK)
        except zmq.Again:
            pass  # the handshake has failed already, and ended the connection for good: who receives hears why
        except zmq.ZMQError as error:
            raise ServerLost(f"{self._address}: cannot send: {error}") from error

    def receive(self, seconds: float) -> Frames | None:
        """The next message; None when none came in that time, or the network was heard of instead."""
        socket = self._open(self._socket)
        try:
            if socket in dict(self._poller.poll(math.ceil(seconds * 1000))):
                frames = [socket.recv(zmq.NOBLOCK, copy=False)]
                while frames[-1].more:  # recv_multipart asks the socket instead, which takes longer
                    frames.append(socket.recv(zmq.NOBLOCK, copy=False))
                return [frame.buffer for frame in frames]
            return None
        except zmq.Again:
            return None  # a connection that just ended took its messages with it
        except zmq.ZMQError as error:
            raise ServerLost(f"{self._address}: cannot receive: {error}") from error

    def remade(self) -> bool:
        """Whether ZeroMQ has connected again since the last call. To be asked when nothing is left to receive, or what
        came before the cut would be taken for lost.

        Raises:
            KeyRefused: the server takes no such key.
        """
        before = self._handshakes.succeeded
        return self._shaken_hands() > max(1, before)

    def _shaken_hands(self) -> int:
        """How often the socket has connected."""
        monitor = self._open(self._monitor)
        self._handshakes.take(lambda: monitor.poll(0), lambda: monitor.recv_multipart(flags=zmq.NOBLOCK))
        return self._handshakes.succeeded

    def _open(self, socket: zmq.Socket[bytes] | None) -> zmq.Socket[bytes]:
        if socket is None:
            raise ServerLost(f"{self._address}: this connection is closed")
        return socket
