"""Encrypt and authenticate connections with CURVE keys (ZeroMQ RFC 26), and answer authentication requests (ZAP,
RFC 27) in a thread. I/O.

The answer depends on the key and the domain, which is "consumer" or "worker": a key of one side is not valid at the
other's port. ZeroMQ asks only at the handshake. It keeps the answer as the connection's user id, which comes with each
of its messages: the number of the last connection accepted until then (:mod:`v2v_protocol.link.guard`), and the key,
which may have been revoked since. Without keys ZeroMQ asks too, for the number.
"""

from __future__ import annotations

import threading
import time
from typing import Protocol

import zmq
from zmq.utils import z85

from v2v_protocol.keys import SIDES, PeerKey
from v2v_protocol.link.guard import ConnectionGuard

_READ_SECONDS = 0.5
_POLL_SECONDS = 0.1


class KeyStore(Protocol):
    """The keys that a server accepts."""

    def server_keys(self) -> tuple[bytes, bytes]:
        """Return the server's public and secret key.

        Raises:
            KeyRefused: there are none, or other users can read them.
        """

    def changed(self) -> tuple[int, ...]:
        """Return a value that differs after a key was created or revoked."""

    def allowed(self) -> dict[str, dict[str, str]]:
        """Return the allowed keys of each side: names by public key."""


def new_key_pair() -> tuple[str, str]:
    """Return a new public and secret key."""
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def secure(socket: zmq.Socket[bytes], key: PeerKey) -> None:
    """Set a peer's key on its socket. Call it before the socket connects."""
    socket.curve_serverkey = key.server.encode()
    socket.curve_publickey = key.public.encode()
    socket.curve_secretkey = key.secret.encode()


class Gate:
    """Answer a context's handshakes, and let its guards process their events, until closed. Create it before a socket
    of the context binds.

    Args:
        context: context of the sockets.
        store: the keys; None requires none.

    Raises:
        KeyRefused: the server has no keys.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], store: KeyStore | None) -> None:
        self.store = store
        if store is not None:
            self._public, self._secret = store.server_keys()
            self._changed = store.changed()
            self._allowed = store.allowed()
        self._guards: dict[str, ConnectionGuard] = {}
        self._read_at = time.monotonic()
        self._closing = threading.Event()
        self._requests = context.socket(zmq.REP)
        self._requests.bind("inproc://zeromq.zap.01")
        self._thread = threading.Thread(target=self._answer, name="v2v-gate", daemon=True)
        self._thread.start()

    def watch(self, side: str, guard: ConnectionGuard) -> None:
        """Let the guard of a side process its events."""
        self._guards[side] = guard

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
        """End the thread. Call it before the context is closed."""
        self._closing.set()
        self._thread.join()
        self._requests.close(linger=0)

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        while not self._closing.is_set():
            guards = [guard for guard in self._guards.values() if guard.monitor is not None]
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
                number = self._guards[side].take_events()
                answer = b"%d %s" % (number, user or b"")
                self._requests.send_multipart([version, request, status, text, answer, b""])

    def _user(self, side: str, mechanism: bytes, credentials: list[bytes]) -> bytes | None:
        """Return the key of a handshake, empty if none is required; None if it is not valid."""
        if self.store is None:
            return b""
        if mechanism != b"CURVE" or side not in SIDES or len(credentials) != 1 or len(credentials[0]) != 32:
            return None
        public: bytes = z85.encode(credentials[0])
        if public.decode() not in self._allowed[side] and self.store.changed() != self._changed:
            self._read(self.store)  # just created
        return public if public.decode() in self._allowed[side] else None

    def _read(self, store: KeyStore) -> None:
        self._read_at = time.monotonic()
        self._changed = store.changed()
        self._allowed = store.allowed()
