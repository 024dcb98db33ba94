"""A sidecar: a file or folder beside a video that an array is made from, such as its labels.

It has the video's name with another ending: ``clip.mp4`` has ``clip.boxes.json`` and ``clip.masks/``. An ending with a
slash names a folder, with files at all depths; hidden files are passed over. The known endings are those that
``v2v_protocol.sample.ARRAYS`` states. A sidecar's id is its path, with the slash.

Its fingerprint is ``<size in bytes>-<32 hexadecimal digits>``, from the names and all bytes of its files.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.resources.abc import Traversable
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING
from zipfile import Path as ZipPath
from zipfile import ZipFile

from v2v_protocol.errors import VideoChanged, VideoGone
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.video.fingerprint import unreadable

if TYPE_CHECKING:
    from v2v_server.corpus.sources.source import VideoSource

_BLOCK_BYTES = 1 << 20


def sidecar_id(video: str, ending: str) -> str:
    """Return the id of a video's sidecar."""
    return f"{PurePosixPath(video).with_suffix('')}{ending}"


def is_sidecar(id: str) -> bool:
    """Return whether a file of this id is a sidecar, not a video."""
    return id.endswith(sidecar_endings(tuple(ARRAYS)))


def fingerprint_of(opened: Traversable) -> str:
    """Return the fingerprint of an opened sidecar.

    Raises:
        OSError: it cannot be read.
    """
    total, sha = 0, hashlib.sha256(b"v2v sidecar 1\n")
    for name, file in _files(opened):
        size, content = 0, hashlib.sha256()
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK_BYTES):
                size += len(block)
                content.update(block)
        sha.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape") + content.digest())
        total += size
    return f"{total}-{sha.hexdigest()[:32]}"


def local_state(path: Path, id: str) -> str:
    """Return a text that changes with the files' sizes and times; "" if there is no such sidecar, or no file in it.

    Raises:
        OSError: it cannot be told.
    """
    try:
        if stat.S_ISDIR(os.stat(path).st_mode) != id.endswith("/"):
            return ""
        found = [(name, os.stat(str(file))) for name, file in _files(path)]
    except (FileNotFoundError, NotADirectoryError):
        return ""
    return state_text([(name, (each.st_size, each.st_mtime_ns, each.st_ctime_ns)) for name, each in found])


def state_text(states: list[tuple[str, tuple[int, int, int]]]) -> str:
    """Return a digest of the states of a sidecar's files; "" without files."""
    return hashlib.sha256(repr(states).encode()).hexdigest()[:32] if states else ""


def check_local(path: Path, id: str, fingerprint: str) -> None:
    """Check a sidecar of this host against its fingerprint; "" takes what is there now.

    Raises:
        VideoGone, VideoDenied, VideoChanged, VideoUnreadable: it is gone, another one by now, or cannot be read.
    """
    try:
        state = local_state(path, id)
        found = _fingerprint_at(path, state) if state and fingerprint else ""
    except OSError as error:
        raise unreadable(id, error) from error
    if not state:
        raise VideoGone(id, None, "cannot be read: there is no such sidecar")
    if found != fingerprint:
        raise VideoChanged(id, None, f"changed since it was catalogued: {found} instead of {fingerprint}")


@lru_cache(maxsize=4096)
def _fingerprint_at(path: Path, state: str) -> str:
    """Read a sidecar once for each of its states."""
    return fingerprint_of(path)


@contextmanager
def open_sidecar(source: VideoSource, id: str, fingerprint: str) -> Iterator[Traversable]:
    """Lend a sidecar until the end of the context: a file, or a folder in the manner of ``pathlib``.

    Args:
        source: where it comes from.
        id: of the sidecar.
        fingerprint: as catalogued; "" takes what is there now.

    Raises:
        VideoUnreadable, VideoChanged: it cannot be read, or differs.
    """
    with source.open_local(id, fingerprint) as path:
        if id.endswith("/") and path.is_file():  # a copy from object storage
            with ZipFile(path) as packed:
                yield ZipPath(packed)
        else:
            yield path


def _files(opened: Traversable, name: str = "") -> list[tuple[str, Traversable]]:
    """Return the files below a folder, sorted, with their relative paths; a single file has the path "".

    Raises:
        OSError: one is not a regular file: opening a FIFO blocks until there is a writer. A link that leads in a circle
            ends as such a file, after about 40 folders.
    """
    if opened.is_file():
        return [(name, opened)]
    if not opened.is_dir():
        raise OSError(errno.EINVAL, "not a regular file, or a link that leads nowhere")
    entries = sorted(opened.iterdir(), key=lambda entry: entry.name)
    return [
        file for entry in entries if not entry.name.startswith(".") for file in _files(entry, f"{name}/{entry.name}")
    ]
