"""The folder of a server's keys. I/O.

    server.key          the server's own key pair, mode 0600
    consumer/NAME       public key of a consumer
    worker/NAME         public key of a worker

The key file of a peer (:mod:`v2v_protocol.keys`) is written elsewhere; its secret is not kept here. Removing a file
revokes its key: a running server checks the folder twice a second. Keys for workers that the server starts on other
hosts exist only in its memory.
"""

from __future__ import annotations

import json
import re
import stat
from pathlib import Path

from v2v_protocol.errors import KeyRefused, UsageError
from v2v_protocol.keys import SIDES, PeerKey, is_key, read_private, write_key, write_private
from v2v_protocol.link.router import new_key_pair
from v2v_protocol.persisted import parse_json

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


class KeyFolder:
    """A folder that :meth:`init` created.

    Args:
        path: path of the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._server = path / "server.key"
        self._lent: dict[str, dict[str, str]] = {side: {} for side in SIDES}

    def init(self) -> None:
        """Create the folder and the server's keys.

        Raises:
            UsageError: there are keys already, or the folder cannot be created.
        """
        public, secret = new_key_pair()
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            for side in SIDES:
                (self.path / side).mkdir(mode=0o700, exist_ok=True)
            write_private(self._server, json.dumps({"public": public, "secret": secret}) + "\n")
        except FileExistsError as error:
            raise UsageError(f"{self._server} exists: replacing it would invalidate all keys made with it") from error
        except OSError as error:
            raise UsageError(f"--dir {self.path}: {error.strerror}") from error

    def server_keys(self) -> tuple[bytes, bytes]:
        """Return the server's public and secret key.

        Raises:
            KeyRefused: there are no keys, other users can read them, or other users can write to the folder and so add
                keys.
        """
        if not self._server.exists():
            raise KeyRefused(f"no keys in {self.path}: create them with v2v-keys init --dir {self.path}")
        text = read_private(self._server)
        for folder in (self.path, *(self.path / side for side in SIDES)):
            mode = stat.S_IMODE(folder.stat().st_mode) if folder.is_dir() else 0
            if mode & 0o022:
                raise KeyRefused(
                    f"others can write to {folder} (mode {mode:04o}), and so add keys: "
                    f"chmod 700 {folder}, and check the keys that `v2v-keys list` shows"
                )
        try:
            keys = parse_json(text)
            public, secret = keys["public"], keys["secret"]
        except (ValueError, KeyError, TypeError):
            public = secret = None
        if not is_key(public) or not is_key(secret):
            raise KeyRefused(f"{self._server} is not a key file: create one with v2v-keys init")
        return public.encode(), secret.encode()

    def new(self, name: str, side: str, out: Path) -> None:
        """Create a key for a peer, and allow it.

        Args:
            side: "consumer" or "worker".
            out: file for the peer.

        Raises:
            UsageError: the name is taken or invalid, or a file cannot be written.
            KeyRefused: the server has no keys.
        """
        if not _NAME.fullmatch(name):
            raise UsageError(f"{name!r}: a key's name is up to 64 letters, digits, dots, dashes and underscores")
        server, _ = self.server_keys()
        public, secret = new_key_pair()
        entry = self.path / side / name
        if entry.exists():
            raise UsageError(f"there is a {side} key {name!r}: revoke it first, or use another name")
        try:
            write_key(out, PeerKey(side, name, server.decode(), public, secret))
            write_private(entry, public + "\n")
        except OSError as error:
            raise UsageError(f"{error.filename}: {error.strerror}") from error

    def lend(self, name: str, side: str) -> PeerKey:
        """Create a key that is not written to disk; it is valid while this object exists.

        Raises:
            KeyRefused: the server has no keys.
        """
        server, _ = self.server_keys()
        public, secret = new_key_pair()
        self._lent[side][public] = name
        return PeerKey(side, name, server.decode(), public, secret)

    def revoke(self, name: str) -> list[str]:
        """Remove the keys with that name; return their sides.

        Raises:
            UsageError: there is no such key.
        """
        sides = [side for side in SIDES if _NAME.fullmatch(name) and (self.path / side / name).exists()]
        if not sides:
            raise UsageError(f"no key {name!r} in {self.path}: v2v-keys list shows all keys")
        for side in sides:
            (self.path / side / name).unlink(missing_ok=True)
        return sides

    def allowed(self) -> dict[str, dict[str, str]]:
        """Return the allowed keys of each side: names by public key."""
        return {side: self._of(side) | self._lent[side] for side in SIDES}

    def _of(self, side: str) -> dict[str, str]:
        found: dict[str, str] = {}
        try:
            entries = sorted((self.path / side).iterdir())
        except OSError:
            return found
        for entry in entries:
            try:
                public = entry.read_text(encoding="ascii").strip()
            except (OSError, ValueError):
                continue  # revoked at this moment, or not a key file
            if _NAME.fullmatch(entry.name) and is_key(public):
                found[public] = entry.name
        return found
