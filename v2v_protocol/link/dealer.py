"""Connect to a server with a DEALER socket, send and receive, and detect interruptions of the network. I/O.

ZeroMQ reconnects by itself after a disconnect, but reports no error, and messages under way are lost. Its monitor shows
it: every handshake after the first means that messages may have been lost. :meth:`Dealer.has_reconnected` tells the
caller when to send its requests again.

ZeroMQ does not recover from two faults: a peer whose packets vanish without an error, and a byte stream that is no
longer ZeroMQ's (the socket is dead after that). For those a :class:`Dealer` can connect again, under a new routing id,
because the server still holds the old one. The server recognises the peer by the secret of its Hello.

A key names its server. Without one, any user of this host could listen at a port on loopback in the server's place, at
once or after the server has ended. So ZeroMQ asks about each connection before its handshake (ZAP, RFC 27), and the
answer comes from the kernel (:mod:`v2v_protocol.link.user`): until then it sends nothing, and afterwards only to root
and our own user. ZeroMQ's questions do not name a connection. There is one at a time, and the monitor has reported its
descriptor by then. A question that may be one of an earlier connection gets no answer, which ZeroMQ would give to the
next one. The server then ends this connection after some seconds, and ZeroMQ asks again.
"""

from __future__ import annotations

import itertools
import math
import os
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from socket import create_connection, gaierror
from threading import Thread
from typing import Any

import zmq

from v2v_protocol.errors import KeyRefused, ServerLost, UsageError
from v2v_protocol.keys import VARIABLE, PeerKey, key_for
from v2v_protocol.link.user import loopback_user
from v2v_protocol.messages import LARGEST_HEADER_BYTES, Frames

_CONNECTED, _SILENT, _SUCCEEDED, _MECHANISM, _AUTHENTICATION = 0x0001, 0x0800, 0x1000, 0x2000, 0x4000
"""Events of a socket monitor: connected; handshake failed without detail, succeeded, protocol error, authentication
failed.
"""
_MISMATCH = 0x11000002
_MOST_SILENT = 5
"""Consecutive handshakes that the server ended without a reply; a server that is stopping may end one or two."""
_ASK_EVERY = 5
_OUR_SIGNATURE = b"\xff" + bytes(8) + b"\x7f\x03"
_RECONNECT_MS, _LONGEST_RECONNECT_MS = 100, 1000
_NOBLOCK, _NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)
_monitors = itertools.count()


class Dealer:
    """Hold one socket to one address, with its own ZeroMQ context. Create it after any fork, never before.

    Args:
        address: ``tcp://host:port``.
        keys: this peer's key, or the path of its file; None uses the file that ``V2V_KEYS`` names, "" uses no key.
        side: what this peer is: "consumer" or "worker".
        insecure: without a key, also speak to a server on loopback that belongs to another user.

    Raises:
        KeyRefused: the key file cannot be used.

    Every method raises ServerLost once the dealer is closed.
    """

    def __init__(
        self,
        address: str,
        keys: str | PeerKey | None = None,
        side: str = "consumer",
        *,
        insecure: bool = False,
    ) -> None:
        self._address = address
        self._key = keys if isinstance(keys, PeerKey) else key_for(address, side, keys)
        self._handshakes = Handshakes(address, self._key, side)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._asks = self._key is None and not insecure and sys.platform == "linux" and address.startswith("tcp:")
        self._questions = self._context.socket(zmq.ROUTER)
        self._questions.bind("inproc://zeromq.zap.01")
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._poller = zmq.Poller()
        self._ipv6 = "[" in address
        self._torn = False

    def connect(self, largest_frame_bytes: int = LARGEST_HEADER_BYTES, *, again: bool = False) -> None:
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
            events = f"inproc://handshakes-{next(_monitors)}"
            socket.monitor(events, _CONNECTED | _SILENT | _SUCCEEDED | _MECHANISM | _AUTHENTICATION)
            if self._key is not None:
                secure(socket, self._key)
            if self._asks:
                socket.setsockopt(zmq.ZAP_DOMAIN, b"server")
            monitor = self._context.socket(zmq.PAIR)
            monitor.setsockopt(zmq.LINGER, 0)
            monitor.connect(events)
            self._socket, self._monitor = socket, monitor
            self._handshakes.succeeded = self._handshakes.connections = 0
            self._poller = zmq.Poller()
            for each in (socket, monitor, self._questions):
                self._poller.register(each, zmq.POLLIN)
        try:
            socket.connect(self._address)
        except zmq.ZMQError as error:
            raise UsageError(f"address {self._address!r}: {error.strerror}; give tcp://host:port") from error

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
        """Queue a message. It is sent once the peer can be reached.

        Raises:
            ServerLost: the link is closed, or the system refuses to send.
        """
        socket = self._open(self._socket)
        try:
            for frame in frames[:-1]:  # send_multipart combines flags of an enumeration, which takes longer
                socket.send(frame, _NOBLOCK_MORE, copy=False)
            socket.send(frames[-1], _NOBLOCK, copy=False)
        except zmq.Again:
            pass  # the handshake failed, which ended the connection for good: has_reconnected() reports why
        except zmq.ZMQError as error:
            raise ServerLost(f"{self._address}: cannot send: {error}") from error

    def receive(self, seconds: float) -> Frames | None:
        """Return the next message. None if ``seconds`` passed or something happened to the connection: then call
        :meth:`has_reconnected`, without which a connection may wait for its handshake.

        Raises:
            ServerLost: the link is closed, or the system refuses to receive.
        """
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
            UsageError: the server belongs to another user.
        """
        before = self._handshakes.succeeded
        return self._count_handshakes() > max(1, before)

    def _count_handshakes(self) -> int:
        """Return how often the socket has connected. Tell ZeroMQ that it may speak to the server, if it asks."""
        monitor, questions = self._open(self._monitor), list[list[bytes]]()
        while self._questions.poll(0):
            questions.append(self._questions.recv_multipart())
        self._handshakes.take(lambda: monitor.poll(0), lambda: monitor.recv_multipart(flags=zmq.NOBLOCK))
        has_asked = len(questions) == self._handshakes.connections  # so has the newest, as each asks once
        if questions:
            self._handshakes.connections = 0
        if questions and has_asked:
            with suppress(OSError):  # it has just ended
                if user := loopback_user(self._handshakes.descriptor):
                    raise UsageError(
                        f"{self._address}: the server there belongs to {user}, not to root or user {os.geteuid()}: "
                        "nothing was sent; use a key of that server (keys=, --keys), or give insecure=True "
                        "(--insecure) to trust it"
                    )
                self._questions.send_multipart([*questions[-1][:4], b"200", b"", b"", b""])
        return self._handshakes.succeeded

    def _open(self, socket: zmq.Socket[bytes] | None) -> zmq.Socket[bytes]:
        if socket is None:
            raise ServerLost(f"{self._address}: this connection is closed")
        return socket


def wait_for_any(dealers: Sequence[Dealer], seconds: float) -> None:
    """Wait at most ``seconds`` until one of several dealers has a message, or something happened to its connection."""
    zmq.zmq_poll([each for dealer in dealers for each in dealer._poller.sockets], math.ceil(seconds * 1000))


def secure(socket: zmq.Socket[bytes], key: PeerKey) -> None:
    """Set a peer's key on its socket. Call it before the socket connects."""
    socket.curve_serverkey = key.server.encode()
    socket.curve_publickey = key.public.encode()
    socket.curve_secretkey = key.secret.encode()


class Handshakes:
    """Count the handshakes of a socket that connects, from the events of its monitor.

    Args:
        address, key, side: of the socket, for messages.

    Attributes:
        succeeded: how many have succeeded; a new socket begins at 0.
        connections: made since ZeroMQ last asked about one.
        descriptor: of the newest connection; -1 before the first.
    """

    def __init__(self, address: str, key: PeerKey | None, side: str) -> None:
        self.succeeded, self.connections, self.descriptor = 0, 0, -1
        self._is_proven = False  # that the server is the one of the key
        self._silent = 0
        self._address, self._side = address, side
        self._mine = "no key was given" if key is None else f"{side} key {key.name!r}"
        self._has_key = key is not None

    def take(self, waiting: Callable[[], int], receive: Callable[[], Sequence[bytes]]) -> None:
        """Process the available events.

        Args:
            waiting: returns whether an event is available.
            receive: returns the next event.

        Raises:
            KeyRefused: the two sides cannot agree.
        """
        while waiting():
            event, value = struct.unpack("=Hi", receive()[0])
            if event == _CONNECTED:
                self.descriptor, self.connections = value, self.connections + 1
                continue
            self._silent = self._silent + 1 if event == _SILENT else 0
            if event == _SUCCEEDED:
                self.succeeded += 1
                self._is_proven = True
            elif event == _AUTHENTICATION:
                raise KeyRefused(
                    f"{self._address} refuses {self._mine}: the key was revoked, or is not a {self._side} key there; "
                    f"`v2v-keys list` on the server's host shows the valid keys"
                )
            elif (event == _MECHANISM and value == _MISMATCH) or self._is_lost():
                raise KeyRefused(
                    f"{self._address} asks for no key, and this side has one ({self._mine}): nothing was sent; leave "
                    f"the key out (keys='', or no {VARIABLE}) only if you know that this server uses no keys"
                    if self._has_key
                    else f"{self._address} asks for a key, and {self._mine}: set {VARIABLE} (or keys=, --keys) to a "
                    f"file that `v2v-keys new NAME --for {self._side}` made"
                )
            elif self._has_key and not self._is_proven and self._silent >= _MOST_SILENT:
                raise KeyRefused(
                    f"{self._address} ended {self._silent} handshakes without a reply: it is not the server that "
                    f"{self._mine} was made for, or not a v2v server; ask for a new key file"
                )

    def _is_lost(self) -> bool:
        """Return whether the two sides disagree about a key and the server's reply was lost. The server ends such a
        handshake as soon as it notices, and the reply may be lost with the connection. So this side asks again from
        time to time.
        """
        if self._is_proven or self._silent % _ASK_EVERY != 1:
            return False
        return mechanism_of(self._address) == (b"NULL" if self._has_key else b"CURVE")


def mechanism_of(address: str, seconds: float = 2.0) -> bytes:
    """Return the security mechanism of the server, from its greeting (ZMTP 3: 64 bytes, of which 20 name the
    mechanism).

    Returns:
        ``b"CURVE"`` or ``b"NULL"``; empty if no such server answers in time.
    """
    try:
        greeting = _greeting(address, seconds)
    except (OSError, ValueError):
        return b""
    return greeting[12:32].rstrip(b"\0") if greeting[:1] == b"\xff" else b""


def diagnose(address: str) -> str:
    """Return the likely reason why a server does not answer, from one more connection to it."""
    if not address.startswith("tcp://"):
        return "no server answers there"
    try:
        greeting = _greeting(address, 1.0)
    except gaierror:
        return "the host name cannot be resolved: correct it, or give an IP address"
    except (OSError, ValueError) as error:
        return f"nothing listens there ({error}): start v2v-serve, or correct host and port"
    if greeting[:1] == b"\xff":
        return (
            "a server listens there, and does not answer yet; without keys it answers only root and its own user: run "
            "this as its user, or use keys (v2v-keys init)"
        )
    return "another program listens there, or the server's page: give the address that v2v-serve prints when ready"


def _greeting(address: str, seconds: float) -> bytes:
    """Return the greeting of a ZMTP server, or what another program sends in its place.

    Raises:
        OSError, ValueError: no connection.
    """
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    greeting = b""
    with create_connection((host.strip("[]"), int(port)), timeout=seconds) as peer, suppress(TimeoutError):
        peer.sendall(_OUR_SIGNATURE)  # send no more: the side that has the whole greeting of the other decides
        while len(greeting) < 64 and (piece := peer.recv(64 - len(greeting))):
            greeting += piece
    return greeting
