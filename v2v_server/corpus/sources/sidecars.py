"""Sidecars: files and folders beside a video that arrays are made from, such as its labels.

A sidecar has the video's name with another ending: ``clip.mp4`` has ``clip.boxes.json`` and ``clip.masks/``. An ending
with a slash names a folder, with files at all depths; hidden files are passed over. The known endings are those that
``v2v_protocol.sample.ARRAYS`` states. A sidecar's id is its path, with the slash.

Its fingerprint is ``<size in bytes>-<32 hexadecimal digits>``, from the names and all bytes of its files. It is read
whole when it is listed. Later a file is checked against the fingerprint, and a folder file by file against a table: the
number at the end of a file's name is its frame, so a clip needs few of them.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from importlib.resources.abc import Traversable
from pathlib import Path, PurePosixPath
from typing import cast
from zipfile import Path as ZipPath
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoChanged, VideoError, VideoGone
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.corpus.sources.source import GONE, FileState, VideoSource, mark_of
from v2v_server.labels import frame_of
from v2v_server.video.fingerprint import unreadable

LARGEST_FILE_BYTES, MOST_BYTES, MOST_FILES, MOST_FOLDERS = 4 << 30, 64 << 30, 1 << 20, 1 << 12
"""Limits of one sidecar. A larger one is not read."""
MOST_LENT_BYTES = 256 << 20
"""Limit of the files of a folder that one clip needs: they are held in memory."""
_BLOCK_BYTES = 1 << 20
_LARGEST_TABLE_BYTES = 63 << 20
_EVERY_FRAME = -1
"""Stands for the frame of a file whose name has no number: every clip needs it."""
_DIGEST = 16
"""Bytes of the digest of a file."""


def sidecar_id(video: str, ending: str) -> str:
    """Return the id of a video's sidecar."""
    return f"{video.rstrip('/') if video.endswith('/') else PurePosixPath(video).with_suffix('')}{ending}"


def is_sidecar(id: str) -> bool:
    """Return whether a file of this id is a sidecar, not a video."""
    return id.endswith(sidecar_endings(tuple(ARRAYS)))


def read_files(opened: Traversable) -> tuple[str, bytes]:
    """Return the fingerprint of an opened sidecar, and a table of its files for :func:`files_between`.

    Raises:
        OSError: it cannot be read.
    """
    total, sha, rows = 0, hashlib.sha256(b"v2v sidecar 1\n"), []
    for name, file in _files(opened):
        size, content = 0, hashlib.sha256()
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK_BYTES):
                size += len(block)
                content.update(block)
        sha.update(f"{name}\0{size}\0".encode("utf-8", "surrogateescape") + content.digest())
        total += size
        frame = frame_of(name)
        rows.append((_EVERY_FRAME if frame is None else frame, os.fsencode(name[1:]), content.digest()[:_DIGEST]))
    longest = max(1, *(len(name) for _, name, _ in rows), 1)
    table = longest.to_bytes(2, "little") + np.array(rows, _row(longest)).tobytes()
    if len(table) > _LARGEST_TABLE_BYTES:
        raise OSError(errno.EFBIG, f"has {len(rows)} files, whose names are too long: shorten the paths")
    return f"{total}-{sha.hexdigest()[:32]}", table


def sidecar_fingerprint(opened: Traversable) -> str:
    """Return the fingerprint of an opened sidecar. Raises: see :func:`read_files`."""
    return read_files(opened)[0]


def files_between(table: bytes, first: int, end: int) -> bytes:
    """Return the part of a table with the files of frames first .. end - 1, and those without a frame.

    Raises:
        ValueError: the table is damaged.
    """
    rows = _rows(table)
    frames = rows["frame"]
    part: bytes = rows[(frames == _EVERY_FRAME) | ((frames >= first) & (frames < end))].tobytes()
    return table[:2] + part


def _rows(table: bytes) -> npt.NDArray[np.void]:
    return np.frombuffer(table, _row(int.from_bytes(table[:2], "little")), offset=2)


def _row(longest: int) -> np.dtype[np.void]:
    return np.dtype([("frame", "<i8"), ("name", f"S{longest}"), ("digest", f"V{_DIGEST}")])


def local_state(path: Path, id: str) -> str:
    """Return a text that changes with the files' sizes and times; "" if there is no such sidecar, or no file in it.

    Raises:
        OSError: it cannot be told, or the sidecar is beyond the limits.
    """
    try:
        if stat.S_ISDIR(path.stat().st_mode) != id.endswith("/"):
            return ""
        found = ((name, cast(Path, file).stat()) for name, file in _files(path))
        return state_text((name, (each.st_size, each.st_mtime_ns, each.st_ctime_ns)) for name, each in found)
    except (FileNotFoundError, NotADirectoryError):
        return ""


def state_text(states: Iterable[tuple[str, tuple[int, int, int]]]) -> str:
    """Return a digest of the states of a sidecar's files; "" without files.

    Raises:
        OSError: there are too many, or they are too large.
    """
    found, total = list[tuple[str, tuple[int, int, int]]](), 0
    for name, state in states:
        found.append((name, state))
        total += state[0]
        if len(found) > MOST_FILES or state[0] > LARGEST_FILE_BYTES or total > MOST_BYTES:
            what = f"has {len(found)} files or more, with {total} bytes or more: the limit is {MOST_FILES} files of"
            raise OSError(errno.EFBIG, f"{what} {LARGEST_FILE_BYTES >> 30} GiB each, and {MOST_BYTES >> 30} GiB in all")
    return hashlib.sha256(repr(found).encode()).hexdigest()[:32] if found else ""


def check_local(path: Path, id: str, fingerprint: str, state: str | None = None) -> None:
    """Check a sidecar of this host.

    Args:
        path, id: where it is.
        fingerprint: of a file; a folder is not read.
        state: as listed, to be compared instead of the fingerprint.

    Raises:
        VideoGone, VideoDenied, VideoChanged, VideoUnreadable: it is gone, another one by now, or cannot be read.
    """
    try:
        now = local_state(path, id)
        is_read = now and state is None and not id.endswith("/")
        found = _fingerprint_at(path, now) if is_read else fingerprint
    except OSError as error:
        raise unreadable(id, error) from error
    if not now:
        raise VideoGone(id, None, "cannot be read: there is no such sidecar")
    if found != fingerprint or now != (state or now):
        raise VideoChanged(id, None, f"changed since it was catalogued: {found} instead of {fingerprint}")


@lru_cache(maxsize=4096)
def _fingerprint_at(path: Path, state: str) -> str:
    """Read a sidecar once for each of its states."""
    return sidecar_fingerprint(path)


@contextmanager
def open_sidecar(source: VideoSource, id: str, fingerprint: str, table: bytes = b"") -> Iterator[Traversable]:
    """Lend a sidecar until the end of the context: a file, or a folder in the manner of ``pathlib``.

    Args:
        source: where it comes from.
        id: of the sidecar.
        fingerprint: as catalogued; "" takes what is there now.
        table: the files that a folder is lent with, see :func:`files_between`; not used without a fingerprint.

    Raises:
        VideoUnreadable, VideoChanged: it cannot be read, or differs.
        VideoError: the files of the table are too large.
        ValueError: the table is damaged.
    """
    with source.open_local(id, fingerprint) as path:
        if id.endswith("/"):
            with ZipFile(path) if path.is_file() else nullcontext() as packed:  # a copy from object storage
                folder = path if packed is None else ZipPath(packed)
                yield _checked(folder, id, table) if fingerprint else folder
        else:
            yield path


def _checked(folder: Traversable, id: str, table: bytes) -> Traversable:
    """Read the files of a table into memory, so that what was checked is what is used.

    Raises:
        VideoError, ValueError: see :func:`open_sidecar`.
    """
    memory, left = io.BytesIO(), MOST_LENT_BYTES
    with ZipFile(memory, "w") as packed:
        for _, raw, digest in _rows(table).tolist():
            file = folder.joinpath(name := os.fsdecode(raw))
            try:
                if not file.is_file():  # opening a FIFO blocks until there is a writer
                    raise FileNotFoundError(errno.ENOENT, f"there is no file {name}")
                with file.open("rb") as stream:
                    data = stream.read(left + 1)
            except OSError as error:
                raise unreadable(id, error) from error
            left -= len(data)
            if left < 0:
                raise VideoError(id, None, f"the files of one clip have more than {MOST_LENT_BYTES} bytes, the limit")
            if hashlib.sha256(data).digest()[:_DIGEST] != digest:
                raise VideoChanged(id, None, f"changed since it was catalogued: {name} is another file")
            packed.writestr(name, data)
    return ZipPath(ZipFile(memory))


def _files(opened: Traversable, name: str = "", folders: list[str] | None = None) -> Iterator[tuple[str, Traversable]]:
    """Yield the files below a folder, sorted, with their relative paths; a single file has the path "".

    Args:
        folders: of the whole sidecar so far. Links may lead to one folder by many paths, each of which counts.

    Raises:
        OSError: there are too many folders, or a file is not a regular one: opening a FIFO blocks until there is a
            writer. A link that leads in a circle ends as such a file, after about 40 folders.
    """
    if opened.is_file():
        yield name, opened
        return
    if not opened.is_dir():
        raise OSError(errno.EINVAL, "not a regular file, or a link that leads nowhere")
    folders = [] if folders is None else folders
    folders.append(name)
    if len(folders) > MOST_FOLDERS:
        raise OSError(
            errno.EFBIG, f"has more than {MOST_FOLDERS} folders, the limit; do links lead to some repeatedly?"
        )
    for entry in sorted(opened.iterdir(), key=lambda entry: entry.name):
        if not entry.name.startswith("."):
            yield from _files(entry, f"{name}/{entry.name}", folders)


def state_of_parts(source: VideoSource, id: str, files: Sequence[tuple[str, FileState]]) -> FileState:
    """Return the state of a folder of pictures from those of its files.

    Raises:
        OSError: it is beyond the limits of a sidecar.
    """
    size = sum(state[0] for _, state in files)
    return (size, int(state_text(files)[:15], 16), mark_of(source, id)) if files else GONE
