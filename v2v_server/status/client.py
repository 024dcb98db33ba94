"""Asks a server for its state, over a socket of its own. Blocking; for one thread."""

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
"""Without an answer the question is asked again: it may be lost with a connection."""


class StatusClient:
    """One connection to look through.

    Args:
        address: of the server's consumers' or workers' side, ``tcp://host:port``.
        keys: file of a consumer's key; None takes what ``V2V_KEYS`` names, "" none.

    Raises:
        UsageError: the address is not understood.
        KeyRefused: the key file cannot be used.
    """

    def __init__(self, address: str, keys: str | None = None) -> None:
        self._address = address
        key = key_for(address, "consumer", keys)
        self._handshakes = Handshakes(address, key, "consumer")
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        # A name of its own: a first byte of 0 is ZeroMQ's.
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
        """The state of now: ``v2v_server.status.state.ServiceState.to_dict()``.

        Raises:
            ServerLost: no answer in that time.
            RemoteError: the server is too busy for us.
            KeyRefused: it takes no such key.
            ProtocolError, VersionMismatch: it is no server of ours, or of another version.
        """
        end = time.monotonic() + timeout_seconds
        ask_at = time.monotonic()
        while (now := time.monotonic()) < end:
            if now >= ask_at:
                ask_at = now + _AGAIN_SECONDS
                with suppress(zmq.Again):  # the handshake has failed, and is heard of below
                    self._socket.send_multipart(encode(GetStatus()), flags=zmq.NOBLOCK)
            ready = dict(self._poller.poll(int(1000 * max(0.0, min(end, ask_at) - now)) + 1))
            if self._monitor in ready:
                self._handshakes.take(
                    lambda: self._monitor.poll(0), lambda: self._monitor.recv_multipart(flags=zmq.NOBLOCK)
                )
            if self._socket in ready and (seen := self._latest()) is not None:
                return seen
        raise ServerLost(f"{self._address}: no answer for {timeout_seconds:g} s; is v2v-serve running there?")

    def _latest(self) -> dict[str, Any] | None:
        """The newest of the answers that are here: one that came too late for its question is old."""
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
            state = parse_json(newest.json)
        except ValueError as error:
            raise ProtocolError(f"{self._address} sent a state that is no JSON") from error
        if not isinstance(state, dict) or not isinstance(state.get("version"), int):
            raise ProtocolError(f"{self._address} sent a state without a version")
        return state

    def close(self) -> None:
        """Ends the connection."""
        self._context.destroy(linger=0)
