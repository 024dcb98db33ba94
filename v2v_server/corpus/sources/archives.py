"""Archives whose members are videos where they lie: tar files, and zip files without compression.

The id of a member is the archive's path without its ending, a slash, and the member's name: that of the file in the
folder that the archive unpacks to. The state of a member is its size, its first byte in the archive, and a number that
changes with the archive. So a job or lease, which has the state of its video, says where to read it, and only the
process that makes the table of an archive parses one.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import stat
import tarfile
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources.abc import Traversable
from types import SimpleNamespace
from typing import IO, Any, BinaryIO, Protocol
from zipfile import ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol.programs import printable
from v2v_server.corpus.sources.source import UNPRINTABLE
from v2v_server.video.file_range import FileRange, open_bytes

MOST_MEMBERS = 1 << 20
MOST_CHARACTERS = 1024
"""Limit of a member's name, characters."""
_LARGEST_TABLE_BYTES = 48 << 20
_LEAVES = re.compile(r"(?:^|[/\n])\.{0,2}(?:[/\n]|$)")
"""A name that is absolute, leads out of its folder, or has an empty part; in one text or in lines."""
_ZIP_HEAD_BYTES, _ZIP_HEAD = 30, b"PK\3\4"
_BLOCK_BYTES = 1 << 20
_END_MARK = bytes(tarfile.BLOCKSIZE)
LEAVES = "has a name that leads out of the archive, or an empty part: rename it"
CUT = "is cut short, or damaged: fetch it again"


class HasArchives(Protocol):
    """A source that lists archives."""

    def read_table(self, archive: str) -> bytes:
        """Return the encoded :class:`ArchiveTable` of an archive. Called in confined processes.

        Raises:
            ValueError: it is damaged, or of no form that is read.
            VideoUnreadable, OSError: it cannot be read.
        """


@dataclass(frozen=True, slots=True)
class ArchiveTable:
    """What an archive holds.

    Attributes:
        names: of its regular members, without those that are refused or hidden.
        places: of each, [N, 2] int64: size and first byte.
        refused: (name, reason) of members that cannot be read.
        notes: what the user ought to know of it.
    """

    names: tuple[str, ...]
    places: npt.NDArray[np.int64]
    refused: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]

    def place(self, name: str) -> tuple[int, int]:
        """Return size and first byte of a member.

        Raises:
            FileNotFoundError: there is no such member.
        """
        at = bisect_left(self.names, name)
        if at == len(self.names) or self.names[at] != name:
            raise FileNotFoundError(errno.ENOENT, "there is no such member in the archive")
        size, start = self.places[at].tolist()
        return size, start

    def to_bytes(self) -> bytes:
        """Encode it.

        Raises:
            ValueError: it is beyond the limit.
        """
        columns = zip(*self.refused, strict=True) if self.refused else ((), ())
        texts = ("\n".join(each).encode() for each in (self.names, *columns, self.notes))
        data: bytes = msgpack.packb((*texts, self.places.astype("<i8").tobytes()))
        if len(data) > _LARGEST_TABLE_BYTES:
            raise ValueError(f"has a table of {len(data)} bytes; the limit is {_LARGEST_TABLE_BYTES}: split it")
        return data

    @classmethod
    def from_bytes(cls, data: bytes, size: int) -> ArchiveTable:
        """Decode and check a table, which comes from a process that has read an archive that may be hostile.

        Args:
            size: of the archive, bytes.

        Raises:
            ValueError: it is malformed, or names what is not in the archive.
        """
        *texts, places = msgpack.unpackb(data)
        names, refused, reasons, notes = (tuple(text.decode().split("\n")) if text else () for text in texts)
        found = np.frombuffer(places, "<i8").reshape(-1, 2)
        if len(found) != len(names) or (names and _LEAVES.search("\n".join(names))):
            raise ValueError("its table is malformed")
        if (found < 0).any() or (found[:, 1] > size - found[:, 0]).any():
            raise ValueError("its table names bytes that it does not have")
        if any(printable(text) != text for text in (*names, *refused, *reasons, *notes)):
            raise ValueError("its table has control characters")
        return cls(names, found, tuple(zip(refused, reasons, strict=True)), notes)


def archive_mark(path: str, state: Sequence[int]) -> int:
    """Return 62 bits that change with an archive: by its ending and its state."""
    text = repr((path.rpartition(".")[2], *state))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8]) >> 2


def member_id(archive: str, name: str) -> str:
    """Return the id of a member."""
    return f"{archive.rpartition('.')[0]}/{name}"


def find_archive(
    id: str, endings: Sequence[str], is_folder: Callable[[str], bool], is_file: Callable[[str], bool]
) -> str:
    """Return the archive that an id leads into; "" if there is none. Where there is a folder, no archive counts."""
    for slash in re.finditer("/", id):
        stem = id[: slash.start()]
        if not is_folder(stem):
            return next((stem + ending for ending in endings if is_file(stem + ending)), "")
    return ""


def read_table(file: BinaryIO, path: str, is_video: Callable[[str], object]) -> ArchiveTable:
    """Read the table of an archive.

    Args:
        file: the archive; seekable.
        path: its path, whose ending tells its form.
        is_video: returns whether a member of a name may be a video: only these are refused one by one.

    Raises:
        ValueError: it is damaged, not of this form, or beyond the limits.
        OSError: it cannot be read.
    """
    found, refused, notes = dict[str, tuple[int, int]](), dict[str, str](), []
    try:
        for name, start, size, problem in (_zip_members if path.endswith(".zip") else tar_members)(file):
            if len(name) > MOST_CHARACTERS:
                raise ValueError(f"has a name of {len(name)} characters; the limit is {MOST_CHARACTERS}")
            problem = problem or (UNPRINTABLE if printable(name) != name else "")
            if problem := problem or (LEAVES if _LEAVES.search(name) else ""):
                if is_video(name):
                    refused[printable(name)] = problem
                continue
            if any(part.startswith(".") for part in name.split("/")):
                continue
            if found.pop(name, None) is not None and is_video(name):
                notes.append(f"{name} is there more than once: the last one counts, as when it is unpacked")
            found[name] = size, start
            if len(found) > MOST_MEMBERS:
                raise ValueError(f"has more than {MOST_MEMBERS} members, the limit: split it")
    except (tarfile.TarError, BadZipFile, EOFError, NotImplementedError) as error:
        raise ValueError(f"{CUT} ({error})") from error
    folders = {name[: slash.start()] for name in found for slash in re.finditer("/", name)}
    for name in folders & found.keys():
        del found[name]
        refused[name] = "is both a file and a folder: unpack the archive and rename one of them"
    names = tuple(sorted(found))
    places = np.array([found[name] for name in names], np.int64).reshape(-1, 2)
    return ArchiveTable(names, places, tuple(refused.items()), tuple(notes))


def tar_members(file: IO[bytes], mode: str = "r:") -> Iterator[tuple[str, int, int, str]]:
    """Yield the members of a tar file that are no folders: name, first byte, size, and why one cannot be read or "".

    Args:
        mode: of :func:`tarfile.open`; ``r|`` reads a stream.

    Raises:
        ValueError, tarfile.TarError: it is damaged, or has bytes behind its end mark.
    """
    with tarfile.open(fileobj=file, mode=mode) as tar:  # type: ignore[call-overload]
        while (member := tar.next()) is not None:
            tar.members.clear()  # of a million members each would take 1 kB
            if member.isdir():
                continue
            problem = "is sparse: unpack the archive and pack it without --sparse" if member.issparse() else ""
            if not member.isreg():
                problem = "is a link, or no regular file: unpack the archive"
            name = re.sub(r"^(?:\./+)+", "", member.name)
            yield name, member.offset_data, member.size, problem
        reader = tar.fileobj
        if mode == "r:":
            reader.seek(tar.offset)
            at, rest = tar.offset, reader.read(tarfile.BLOCKSIZE)
            if rest != _END_MARK:
                raise ValueError(f"{CUT}: at byte {at} there is neither a member nor the end mark")
            while rest := reader.read(_BLOCK_BYTES):
                if rest.strip(b"\0"):
                    raise ValueError(
                        "has bytes behind its end mark: if archives were joined, join them with tar --concatenate, or "
                        "keep each as a file"
                    )


def _zip_members(file: IO[bytes]) -> Iterator[tuple[str, int, int, str]]:
    end = file.seek(0, os.SEEK_END)
    with ZipFile(file) as packed:
        for entry in packed.infolist():
            if entry.is_dir():
                continue
            start, problem = 0, _packed(entry)
            if not problem:
                file.seek(entry.header_offset)
                head = file.read(_ZIP_HEAD_BYTES)
                lengths = int.from_bytes(head[26:28], "little") + int.from_bytes(head[28:30], "little")
                start = entry.header_offset + _ZIP_HEAD_BYTES + lengths
                if not head.startswith(_ZIP_HEAD) or start + entry.file_size > end:
                    problem = "lies beyond the end of the archive, or its header is damaged: fetch it again"
            yield entry.filename, start, entry.file_size, problem


def _packed(entry: ZipInfo) -> str:
    if entry.flag_bits & 1:
        return "is encrypted: unpack the archive"
    if entry.compress_type != ZIP_STORED or entry.compress_size != entry.file_size:
        return "is compressed, and cannot be read in place: unpack the archive, or pack it with zip -0"
    return "is a link: unpack the archive" if stat.S_ISLNK(entry.external_attr >> 16) else ""


@dataclass(frozen=True)
class MemberPath(Traversable):
    """A sidecar in an archive: a member, or all of a folder.

    Attributes:
        archive: its path.
        mark: see :func:`archive_mark`.
        path: of the member or folder in it.
        table: of the archive.
    """

    archive: str
    mark: int
    path: str
    table: ArchiveTable = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """Return the last part of its path."""
        return self.path.rpartition("/")[2]

    def stat(self) -> SimpleNamespace:
        """Return what tells a change, as for a file: size, first byte and mark.

        Raises:
            FileNotFoundError: there is nothing of this name.
        """
        size, start = (0, 0) if self.is_dir() else self.table.place(self.path)
        mode = stat.S_IFDIR if self.is_dir() else stat.S_IFREG
        return SimpleNamespace(st_mode=mode, st_size=size, st_mtime_ns=start, st_ctime_ns=self.mark)

    def is_file(self) -> bool:
        """Return whether it is a member."""
        return self.path in self.table.names[(at := bisect_left(self.table.names, self.path)) : at + 1]

    def is_dir(self) -> bool:
        """Return whether members lie below it."""
        return next(self._below(), None) is not None

    def iterdir(self) -> Iterator[MemberPath]:
        """Yield what lies in it."""
        for name in dict.fromkeys(name.partition("/")[0] for name in self._below()):
            yield self.joinpath(name)

    def joinpath(self, *parts: str) -> MemberPath:  # type: ignore[override]
        """Return what lies below it."""
        return replace(self, path="/".join(filter(None, (self.path, *parts))))

    def open(self, mode: str = "r", *args: Any, **kwargs: Any) -> IO[Any]:
        """Open a member for reading.

        Raises:
            OSError, VideoUnreadable: it cannot be read.
        """
        size, start = self.table.place(self.path)
        file = open_bytes(FileRange(self.archive, start, start + size))
        return file if "b" in mode else io.TextIOWrapper(file, *args, **kwargs)

    def _below(self) -> Iterator[str]:
        """Yield the members below it, by their paths from there."""
        names, prefix = self.table.names, f"{self.path}/" if self.path else ""
        for at in range(bisect_left(names, prefix), len(names)):
            if not names[at].startswith(prefix):
                return
            yield names[at][len(prefix) :]
