"""Read and use the key of a consumer or a worker.

`v2v-keys new` writes a key file. It is JSON: the side it is for, a name, the server's public key, and a key pair of its
own. It serves one side only: the server keeps consumers' and workers' keys apart. ``ipc://`` addresses use no keys:
only our own user can connect to them.
"""

from __future__ import annotations

import json
import os
import socket
import stat
import struct
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

from v2v_protocol.errors import KeyRefused
from v2v_protocol.safe_json import parse_json

SIDES = ("consumer", "worker")
VARIABLE = "V2V_KEYS"
KEY_LETTERS = 40
"""Length of a CURVE key in Z85, characters."""
_Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
HANDSHAKE_EVENTS = 0x0800 | 0x1000 | 0x2000 | 0x4000
"""Handshake events of a socket monitor: failed without detail, succeeded, protocol error, authentication failed."""
_SILENT, _SUCCEEDED, _MECHANISM, _AUTHENTICATION = 0x0800, 0x1000, 0x2000, 0x4000
_MISMATCH = 0x11000002
_MOST_SILENT = 5
"""Consecutive handshakes that the server ended without a reply; a server that is stopping may end one or two."""
_ASK_EVERY = 5
_OUR_SIGNATURE = b"\xff" + bytes(8) + b"\x7f\x03"


@dataclass(frozen=True, slots=True)
class PeerKey:
    """Content of a key file. Its secret is excluded from ``repr``."""

    side: str
    name: str
    server: str
    public: str
    secret: str = field(repr=False)

    def secure(self, socket: Any) -> None:
        """Set this key on a ZeroMQ socket. Call it before the socket connects."""
        socket.curve_serverkey = self.server.encode()
        socket.curve_publickey = self.public.encode()
        socket.curve_secretkey = self.secret.encode()


def key_for(address: str, side: str, file: str | os.PathLike[str] | None) -> PeerKey | None:
    """Return the key to use with an address.

    Args:
        side: "consumer" or "worker".
        file: key file; None uses the file that ``V2V_KEYS`` names, "" uses no key.

    Returns:
        None if no key was given, or the address needs none.

    Raises:
        KeyRefused: the file cannot be read, other users can read it, or it is for the other side.
    """
    named = os.environ.get(VARIABLE, "") if file is None else os.fspath(file)
    if not named or address.startswith("ipc:"):
        return None
    key = read_key(Path(named))
    if key.side != side:
        raise KeyRefused(
            f"key {key.name!r} ({named}) is a {key.side}'s, and this is a {side}: ask for one that "
            f"`v2v-keys new NAME --for {side}` made"
        )
    return key


def read_key(file: Path) -> PeerKey:
    """Read a key file.

    Raises:
        KeyRefused: it cannot be read, other users can read it, or it is not a key file.
    """
    try:
        key = PeerKey(**parse_json(read_private(file)))
    except (ValueError, TypeError):
        raise KeyRefused(f"{file} is not a key file: give one that `v2v-keys new` made") from None
    if key.side not in SIDES or not all(map(is_key, (key.server, key.public, key.secret))):
        raise KeyRefused(f"{file} is not a key file: give one that `v2v-keys new` made")
    return key


def is_key(text: object) -> bool:
    """Return whether a text has the form of half a CURVE pair (Z85, ZeroMQ RFC 32): 5 characters for 4 bytes."""
    if not isinstance(text, str) or len(text) != KEY_LETTERS or set(text) - set(_Z85):
        return False
    groups = (text[at : at + 5] for at in range(0, KEY_LETTERS, 5))
    return all(sum(_Z85.index(each) * 85**place for place, each in enumerate(reversed(g))) < 2**32 for g in groups)


def read_private(file: Path) -> str:
    """Read the text of a file that holds a secret.

    Raises:
        KeyRefused: it cannot be read, or other users can read it.
    """
    try:
        with file.open("rb") as opened:
            mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
            if mode & 0o077:
                raise KeyRefused(
                    f"key file {file} has mode {mode:04o}, so other users may have read it: chmod 600 {file}"
                )
            return opened.read(4096).decode(errors="replace")
    except OSError as error:
        raise KeyRefused(f"key file {file} cannot be read: {error.strerror}") from error


def write_key(file: Path, key: PeerKey) -> None:
    """Write a key file that only its owner can read.

    Raises:
        FileExistsError: the file exists.
    """
    write_private(file, json.dumps(asdict(key), indent=1) + "\n")


def write_private(file: Path, content: str) -> None:
    """Create a file of mode 0600.

    Raises:
        FileExistsError: the file exists.
    """
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as opened:
        opened.write(content)


def nameless_key(key: PeerKey) -> IO[bytes]:
    """Return an open, unnamed key file, in memory if the system supports it. A child process reads it as
    ``/dev/fd/NUMBER``.
    """
    in_memory = hasattr(os, "memfd_create")
    file = os.fdopen(os.memfd_create("v2v-key"), "w+b") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115
    os.fchmod(file.fileno(), 0o600)
    file.write(json.dumps(asdict(key)).encode())
    file.flush()
    return file


class Handshakes:
    """Count the handshakes of a socket that connects, from the events of its monitor.

    Args:
        address, key, side: of the socket, for messages.
    """

    def __init__(self, address: str, key: PeerKey | None, side: str) -> None:
        self.succeeded = 0
        self._is_proven = False  # that the server is the one of the key
        self._silent = 0
        self._address, self._side = address, side
        self._mine = "no key was given" if key is None else f"{side} key {key.name!r}"
        self._has_key = key is not None

    def begin(self) -> None:
        """Start again for a new socket."""
        self.succeeded = 0

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
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    greeting = b""
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=seconds) as peer:
            peer.sendall(_OUR_SIGNATURE)  # send no more: the side that has the whole greeting of the other decides
            while len(greeting) < 64 and (piece := peer.recv(64 - len(greeting))):
                greeting += piece
    except (OSError, ValueError):
        return b""
    return greeting[12:32].rstrip(b"\0") if greeting[:1] == b"\xff" else b""
