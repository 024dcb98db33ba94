"""Read and use the key of a consumer or a worker; which addresses there are, and which leave this host.

`v2v-keys new` writes a key file. It is JSON: the side it is for, a name, the server's public key, and a key pair of its
own. It serves one side only: the server keeps consumers' and workers' keys apart. ``ipc://`` addresses use no keys:
only our own user can connect to them.
"""

from __future__ import annotations

import ipaddress
import json
import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from v2v_protocol.errors import KeyRefused, ProtocolError, UsageError, system_errors
from v2v_protocol.persisted import Persisted, parse_json

SIDES = ("consumer", "worker")
VARIABLE = "V2V_KEYS"
KEY_LETTERS = 40
"""Length of a CURVE key in Z85, characters."""
_Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"


@dataclass(frozen=True, slots=True)
class PeerKey(Persisted):
    """Content of a key file. Its secret is excluded from ``repr``."""

    side: str
    name: str
    server: str
    public: str
    secret: str = field(repr=False)


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
        key = PeerKey.from_dict(parse_json(read_private(file)))
    except (ValueError, ProtocolError):
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
    with system_errors(KeyRefused, f"key file {file} cannot be read"), file.open("rb") as opened:
        mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
        if mode & 0o077:
            raise KeyRefused(f"key file {file} has mode {mode:04o}, so other users may have read it: chmod 600 {file}")
        return opened.read(4096).decode(errors="replace")


def write_key(file: Path, key: PeerKey) -> None:
    """Write a key file that only its owner can read.

    Raises:
        FileExistsError: the file exists.
    """
    write_private(file, json.dumps(key.to_dict(), indent=1) + "\n")


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
    file.write(json.dumps(key.to_dict()).encode())
    file.flush()
    return file


def addresses(given: str | Sequence[str]) -> tuple[str, ...]:
    """Return the addresses of a list or of a comma-separated text.

    Raises:
        UsageError: there is no address, or one occurs twice.
    """
    texts = given.split(",") if isinstance(given, str) else given if isinstance(given, Sequence) else ()
    found = tuple(str(text).strip() for text in texts)
    if not found or not all(found):
        raise UsageError(f"address {given!r}: give tcp://host:port, or several of them")
    if len(set(found)) < len(found):
        raise UsageError(f"address {given!r}: a broker occurs twice; give each once")
    return found


def is_loopback(host: str) -> bool:
    """Return whether a host name, or an IP address in digits, is certainly this machine."""
    try:
        return ipaddress.ip_address(host.removeprefix("::ffff:")).is_loopback  # IPv4 over a socket for IPv6
    except ValueError:
        return host == "localhost"


def leaves_host(address: str) -> bool:
    """Return whether data sent to a ZeroMQ address may travel over a network: all but ``ipc://`` and loopback."""
    scheme, _, rest = address.partition("://")
    return scheme == "tcp" and not is_loopback(rest.rpartition(":")[0].strip("[]"))
