"""The keys of a fleet whose server requires them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from v2v_server.keys.folder import KeyFolder


@dataclass(frozen=True, slots=True)
class KeyRing:
    """Key files.

    Attributes:
        server: the server's folder.
        consumer, worker: valid keys.
        revoked: a revoked key of a consumer.
    """

    server: Path
    consumer: Path
    worker: Path
    revoked: Path

    @classmethod
    def made(cls, folder: Path) -> KeyRing:
        """Make new keys in a new folder."""
        folder.mkdir()
        server = KeyFolder(folder / "server")
        server.init()
        files = [folder / f"{name}.key" for name in ("consumer", "worker", "revoked")]
        for file, side in zip(files, ("consumer", "worker", "consumer"), strict=True):
            server.new(file.stem, side, file)
        server.revoke("revoked")
        return cls(folder / "server", *files)
