"""Request a server's status over a separate socket. Blocking; for one thread."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from typing import Any

from v2v_protocol.errors import ProtocolError, RemoteError, ServerLost, undo_on_error
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.messages import Denied, GetStatus, Status, decode, encode
from v2v_protocol.persisted import parse_json

_AGAIN_SECONDS = 2.0
"""An unanswered request is repeated after this time: it may be lost with a connection."""


class StatusClient(AbstractContextManager["StatusClient"]):
    """One connection to a server.

    Args:
        address: where consumers or workers connect, ``tcp://host:port``.
        keys: file of a consumer's key; None: the one that ``V2V_KEYS`` names, "": no key.
        insecure: see :class:`v2v_protocol.link.dealer.Dealer`.

    Raises:
        UsageError: the address is malformed.
        KeyRefused: the key file cannot be used.
    """

    def __init__(self, address: str, keys: str | None = None, *, insecure: bool = False) -> None:
        self._address = address
        self._link = Dealer(address, keys, insecure=insecure)
        with undo_on_error(self.close):
            self._link.connect()

    def __exit__(self, *_: object) -> None:
        self.close()

    def get_status(self, timeout_seconds: float = 10.0) -> dict[str, Any]:
        """Return the current status, see :mod:`v2v_server.status.snapshot`.

        Raises:
            ServerLost: there is no answer in this time.
            RemoteError: the server is too busy.
            UsageError: the server belongs to another user, or does not accept the key.
            ProtocolError, VersionMismatch: the peer is no such server, or has another version.
        """
        end = time.monotonic() + timeout_seconds
        ask_at = time.monotonic()
        while self._link.receive(0) is not None:
            pass  # a late answer to an earlier request
        while (now := time.monotonic()) < end:
            if now >= ask_at:
                ask_at = now + _AGAIN_SECONDS
                self._link.send(encode(GetStatus()))
            frames = self._link.receive(max(0.0, min(end, ask_at) - now))
            if frames is None:
                self._link.has_reconnected()  # raises if the server refuses the key
                continue
            match decode(frames[0]):
                case Denied(code, text):
                    raise RemoteError(code, f"{self._address} refused: {text}")
                case Status(encoded):
                    return self._read(encoded)
        raise ServerLost(
            f"{self._address}: no answer for {timeout_seconds:g} s; is v2v-serve running there? Without keys it serves "
            "its own user only"
        )

    def _read(self, encoded: bytes) -> dict[str, Any]:
        try:
            status = parse_json(encoded)
        except ValueError as error:
            raise ProtocolError(f"{self._address} sent a status that is not JSON") from error
        if not isinstance(status, dict) or not isinstance(status.get("version"), int):
            raise ProtocolError(f"{self._address} sent a status without a version")
        return status

    def close(self) -> None:
        """End the connection."""
        self._link.close()
