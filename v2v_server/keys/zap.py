"""Answer ZeroMQ's authentication requests (ZAP, RFC 27), in a thread of its own. I/O.

The answer depends on the key and the domain, which is "consumer" or "worker": a key of one side is not valid at the
other's port. ZeroMQ asks only at the handshake. It keeps the key as the connection's user id, which identifies messages
of connections whose key was revoked since.
"""

from __future__ import annotations

import threading
import time

import zmq
from zmq.utils import z85

from v2v_protocol.keys import SIDES
from v2v_server.keys.folder import KeyFolder

HANDSHAKE_MS = 3000
"""Time limit of a handshake, after which ZeroMQ disconnects the peer."""
_LOOK_SECONDS = 0.5
_TURN_MS = 100


class Gate:
    """Authenticate a context's handshakes until closed. Create it before a socket of the context binds.

    Args:
        context: context of the sockets.
        folder: the keys.

    Raises:
        KeyRefused: the server has no keys.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], folder: KeyFolder) -> None:
        self._folder = folder
        self._public, self._secret = folder.server_keys()
        self._changed = folder.changed()
        self._allowed = folder.allowed()
        self._looked = time.monotonic()
        self._closing = threading.Event()
        self._questions = context.socket(zmq.REP)
        self._questions.bind("inproc://zeromq.zap.01")
        self._thread = threading.Thread(target=self._answer, name="v2v-keys", daemon=True)
        self._thread.start()

    def guard(self, socket: zmq.Socket[bytes], side: str) -> None:
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
        self._questions.close(linger=0)

    # --- in the thread ------------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        while not self._closing.is_set():
            asked = self._questions.poll(_TURN_MS)
            if time.monotonic() >= self._looked + _LOOK_SECONDS:
                self._look()
            if asked:
                version, request, domain, _, _, mechanism, *credentials = self._questions.recv_multipart()
                user = self._user(domain.decode(errors="replace"), mechanism, credentials)
                status, text = (b"200", b"") if user else (b"400", b"not a key of this side")
                self._questions.send_multipart([version, request, status, text, user, b""])

    def _user(self, side: str, mechanism: bytes, credentials: list[bytes]) -> bytes:
        """Return the key of a handshake; empty if it is not valid."""
        if mechanism != b"CURVE" or side not in SIDES or len(credentials) != 1 or len(credentials[0]) != 32:
            return b""
        public: bytes = z85.encode(credentials[0])
        if public.decode() not in self._allowed[side] and self._folder.changed() != self._changed:
            self._look()  # just made
        return public if public.decode() in self._allowed[side] else b""

    def _look(self) -> None:
        self._looked = time.monotonic()
        self._changed = self._folder.changed()
        self._allowed = self._folder.allowed()
