"""Asks a server for its state, over a socket of its own. Blocking; for one thread."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any

from v2v_protocol.errors import ProtocolError, RemoteError, ServerLost, UsageError
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.messages import Denied, GetStatus, Status
from v2v_protocol.safe_json import parse_json
from v2v_protocol.wire import Frames, decode, encode

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
        self._link = Dealer(address, keys)
        try:
            self._link.connect()
        except UsageError:
            self.close()
            raise

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
                self._link.send(encode(GetStatus()))
            frames = self._link.receive(max(0.0, min(end, ask_at) - now))
            if frames is None:
                self._link.has_reconnected()  # raises if the server refuses the key
            elif (seen := self._latest(frames)) is not None:
                return seen
        raise ServerLost(f"{self._address}: no answer for {timeout_seconds:g} s; is v2v-serve running there?")

    def _latest(self, frames: Frames) -> dict[str, Any] | None:
        """The newest of the answers that are here: one that came too late for its question is old."""
        newest = None
        more: Frames | None = frames
        while more is not None:
            message = decode(more[0])
            if isinstance(message, Denied):
                raise RemoteError(message.code, f"{self._address} refused: {message.text}")
            if isinstance(message, Status):
                newest = message
            more = self._link.receive(0)
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
        self._link.close()
