"""Encrypt and authenticate connections with CURVE keys (ZeroMQ RFC 26), and answer authentication requests (ZAP,
RFC 27) in a thread. I/O.

The answer depends on the key and the domain, which is "consumer" or "worker": a key of one side is not valid at the
other's port. ZeroMQ asks only at the handshake. It keeps the key as the connection's user id, which identifies messages
of connections whose key was revoked since.
"""

from __future__ import annotations

import threading
import time
from typing import Protocol

import zmq
from zmq.utils import z85

from v2v_protocol.keys import SIDES, PeerKey

_READ_SECONDS = 0.5
_POLL_MS = 100


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
    """Authenticate a context's handshakes until closed. Create it before a socket of the context binds.

    Args:
        context: context of the sockets.
        store: the keys.

    Raises:
        KeyRefused: the server has no keys.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], store: KeyStore) -> None:
        self._store = store
        self._public, self._secret = store.server_keys()
        self._changed = store.changed()
        self._allowed = store.allowed()
        self._read_at = time.monotonic()
        self._closing = threading.Event()
        self._requests = context.socket(zmq.REP)
        self._requests.bind("inproc://zeromq.zap.01")
        self._thread = threading.Thread(target=self._answer, name="v2v-keys", daemon=True)
        self._thread.start()

    def require(self, socket: zmq.Socket[bytes], side: str) -> None:
        """Require keys of that side at the addresses that the socket binds from now on."""
        socket.curve_secretkey = self._secret
        socket.curve_publickey = self._public
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.ZAP_DOMAIN, side.encode())
        # Without a domain ZeroMQ accepts every peer if the authentication thread does not answer.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def admits(self, side: str, user: str) -> bool:
        """Return whether a key that passed the handshake is still valid."""
        return user in self._allowed[side]

    def close(self) -> None:
        """End the thread. Call it before the context is closed."""
        self._closing.set()
        self._thread.join()
        self._requests.close(linger=0)

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        while not self._closing.is_set():
            asked = self._requests.poll(_POLL_MS)
            if time.monotonic() >= self._read_at + _READ_SECONDS:
                self._read()
            if asked:
                version, request, domain, _, _, mechanism, *credentials = self._requests.recv_multipart()
                user = self._user(domain.decode(errors="replace"), mechanism, credentials)
                status, text = (b"200", b"") if user else (b"400", b"not a key of this side")
                self._requests.send_multipart([version, request, status, text, user, b""])

    def _user(self, side: str, mechanism: bytes, credentials: list[bytes]) -> bytes:
        """Return the key of a handshake; empty if it is not valid."""
        if mechanism != b"CURVE" or side not in SIDES or len(credentials) != 1 or len(credentials[0]) != 32:
            return b""
        public: bytes = z85.encode(credentials[0])
        if public.decode() not in self._allowed[side] and self._store.changed() != self._changed:
            self._read()  # just created
        return public if public.decode() in self._allowed[side] else b""

    def _read(self) -> None:
        self._read_at = time.monotonic()
        self._changed = self._store.changed()
        self._allowed = self._store.allowed()
