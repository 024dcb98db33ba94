"""Writing the manifest of a prepared folder; :mod:`v2v_server.corpus.manifest` says what is in it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.manifest import MANIFEST_NAME, Header, PreparedVideo


class ManifestWriter:
    """Writes a manifest: first afresh and in one piece, then line by line.

    Args:
        root: the prepared folder.
        header: its first line.
        videos: what is known already.
        aside: what is known of videos that the corpus does not have.

    Raises:
        OSError: the folder cannot be written to.
    """

    def __init__(
        self, root: Path, header: Header, videos: Iterable[PreparedVideo], aside: Iterable[PreparedVideo] = ()
    ) -> None:
        path = root / MANIFEST_NAME
        aside_path = path.with_name(f".{MANIFEST_NAME}.new")  # one name, so that killed runs leave one file at most
        with write_aside_and_rename(path, partial=aside_path, durable=True) as fresh, fresh.open("wb") as file:
            file.write(_line(header))
            file.writelines(map(_line, videos))
            file.writelines(_line(video, aside=True) for video in aside)
        self._file = path.open("ab")

    def add(self, video: PreparedVideo) -> None:
        """Append one record, and make sure that it stays."""
        self._file.write(_line(video))
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> ManifestWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _line(item: Header | PreparedVideo, aside: bool = False) -> bytes:
    values = item.to_dict() | ({"aside": True} if aside else {})
    return json.dumps(values, allow_nan=False).encode() + b"\n"
