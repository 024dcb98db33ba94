"""Request a server's status over a separate socket. Blocking; for one thread."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from types import TracebackType
from typing import Any

import zmq

from v2v_protocol.errors import ProtocolError, RemoteError, ServerLost, UsageError
from v2v_protocol.keys import HANDSHAKE_EVENTS, Handshakes, key_for
from v2v_protocol.messages import Denied, GetStatus, Status
from v2v_protocol.safe_json import parse_json
from v2v_protocol.wire import LARGEST_HEADER_BYTES, decode, encode

_AGAIN_SECONDS = 2.0
"""An unanswered request is repeated after this time: it may be lost with a connection."""


class StatusClient:
    """One connection to a server.

    Args:
        address: where consumers or workers connect, ``tcp://host:port``.
        keys: file of a consumer's key; None: the one that ``V2V_KEYS`` names, "": no key.

    Raises:
        UsageError: the address is malformed.
        KeyRefused: the key file cannot be used.
    """

    def __init__(self, address: str, keys: str | None = None) -> None:
        self._address = address
        key = key_for(address, "consumer", keys)
        self._handshakes = Handshakes(address, key, "consumer")
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        # ZeroMQ reserves a first byte of 0.
        self._socket.setsockopt(zmq.ROUTING_ID, b"\x02" + os.urandom(15))
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_HEADER_BYTES)
        self._socket.setsockopt(zmq.IPV6, int("[" in address))
        if key is not None:
            key.secure(self._socket)
        self._monitor = self._socket.get_monitor_socket(HANDSHAKE_EVENTS)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            raise UsageError(f"address {address!r}: {error.strerror}; give tcp://host:port") from error
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)

    def __enter__(self) -> StatusClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def get_status(self, timeout_seconds: float = 10.0) -> dict[str, Any]:
        """Return the current status, see :mod:`v2v_server.status.parts`.

        Raises:
            ServerLost: there is no answer in this time.
            RemoteError: the server is too busy.
            KeyRefused: the server does not accept the key.
            ProtocolError, VersionMismatch: the peer is no such server, or has another version.
        """
        end = time.monotonic() + timeout_seconds
        ask_at = time.monotonic()
        while (now := time.monotonic()) < end:
            if now >= ask_at:
                ask_at = now + _AGAIN_SECONDS
                with suppress(zmq.Again):  # the handshake failed, which the monitor reports
                    self._socket.send_multipart(encode(GetStatus()), flags=zmq.NOBLOCK)
            ready = dict(self._poller.poll(int(1000 * max(0.0, min(end, ask_at) - now)) + 1))
            if self._monitor in ready:
                self._handshakes.take(
                    lambda: self._monitor.poll(0), lambda: self._monitor.recv_multipart(flags=zmq.NOBLOCK)
                )
            if self._socket in ready and (latest := self._latest()) is not None:
                return latest
        raise ServerLost(f"{self._address}: no answer for {timeout_seconds:g} s; is v2v-serve running there?")

    def _latest(self) -> dict[str, Any] | None:
        """Return the newest answer that has arrived: one that came too late for its request is old."""
        newest = None
        while self._socket.poll(0):
            message = decode(self._socket.recv_multipart()[0])
            if isinstance(message, Denied):
                raise RemoteError(message.code, f"{self._address} refused: {message.text}")
            if isinstance(message, Status):
                newest = message
        if newest is None:
            return None
        try:
            status = parse_json(newest.json)
        except ValueError as error:
            raise ProtocolError(f"{self._address} sent a status that is not JSON") from error
        if not isinstance(status, dict) or not isinstance(status.get("version"), int):
            raise ProtocolError(f"{self._address} sent a status without a version")
        return status

    def close(self) -> None:
        """End the connection."""
        self._context.destroy(linger=0)
