"""Archives whose members are videos where they lie: tar files, and zip files without compression.

The id of a member is the archive's path without its ending, a slash, and the member's name: that of the file in the
folder that the archive unpacks to. The state of a member says where it lies (:class:`MemberPlace` of ``source``). So a
job or lease, which has the state of its video, says where to read it, and only the process that makes the table of an
archive parses one.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
import struct
import tarfile
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from importlib.resources.abc import Traversable
from types import SimpleNamespace
from typing import IO, Any, Protocol, Self
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol.programs import printable
from v2v_server.corpus.sources.source import UNPRINTABLE, FileState
from v2v_server.video.file_range import FileRange, open_bytes

MOST_MEMBERS = 1 << 20
MOST_CHARACTERS = 1024
"""Limit of a member's name, characters."""
_LARGEST_TABLE_BYTES = 48 << 20
_LEAVES = re.compile(r"(?:^|[/\n])\.{0,2}(?:[/\n]|$)")
"""A name that is absolute, leads out of its folder, or has an empty part; in one text or in lines."""
ZIP_HEAD_BYTES, _ZIP_HEAD = 30, b"PK\3\4"
DEFLATE_RATIO = 1032
"""Largest number of bytes that a byte of a deflated member may stand for."""
MOST_ZIP_HEAD_BYTES = ZIP_HEAD_BYTES + 2 * 65535
"""Largest header of a member of a zip file: name and extra fields follow the first bytes."""
ZIP_END_BYTES, MOST_DIRECTORY_BYTES = 1 << 17, 256 << 20
"""Of a remote zip file: what is fetched of its end at first, and the limit of what is fetched for its directory."""
_BLOCK_BYTES = 1 << 20
LEAVES = "has a name that leads out of the archive, or an empty part: rename it"
CHANGES_WHILE_READ = "changes while it is read; start again"
CUT = "is cut short, or damaged: fetch it again"


class HasArchives(Protocol):
    """A source that lists archives."""

    def lend_archive(self, archive: str, state: FileState) -> AbstractContextManager[str]:
        """Lend the path of what :func:`read_table` needs of an archive. A confined process opens it.

        Args:
            state: as listed. At the end of the context it is checked.

        Raises:
            VideoUnreadable, VideoChanged, OSError: the archive cannot be read, or is another one by now.
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


def member_id(archive: str, name: str) -> str:
    """Return the id of a member."""
    return f"{archive.rpartition('.')[0]}/{name}"


def name_in(archive: str, id: str) -> str:
    """Return the name in its archive of a member of that id."""
    return id[len(archive.rpartition(".")[0]) + 1 :].rstrip("/")


def find_archive(
    id: str, endings: Sequence[str], is_folder: Callable[[str], bool], is_file: Callable[[str], bool]
) -> str:
    """Return the archive that an id leads into; "" if there is none. Where there is a folder, no archive counts."""
    for slash in re.finditer("/", id):
        stem = id[: slash.start()]
        if not is_folder(stem):
            return next((stem + ending for ending in endings if is_file(stem + ending)), "")
    return ""


def same_ids(archive: str, endings: Sequence[str], is_there: Callable[[str], bool]) -> str:
    """Return why an archive is refused: beside it lies a folder or archive that gives the same ids. "" if none does."""
    stem, dot, ending = archive.rpartition(".")
    others = (stem + other for other in ("", *endings) if dot + ending in endings and other != dot + ending)
    found = next(filter(is_there, others), "").rpartition("/")[2]
    return found and f"would give the same ids as {found} beside it: move one of them away"


def read_table(file: IO[bytes], path: str, is_video: Callable[[str], object], is_remote: bool = False) -> ArchiveTable:
    """Read the table of an archive.

    Args:
        file: the archive.
        path: its path, whose ending tells its form.
        is_video: returns whether a member of a name may be a video: only these are refused one by one.
        is_remote: whether ``file`` is what :meth:`HasArchives.lend_archive` gives of an archive that lies elsewhere: a
            tar file as a stream, a zip file that has its directory only.

    Raises:
        ValueError: it is damaged, not of this form, or beyond the limits.
        OSError: it cannot be read.
    """
    found, refused, notes = dict[str, tuple[int, int]](), dict[str, str](), []
    read = _zip_members if path.endswith(".zip") else _tar_members
    try:
        for name, start, size, problem in read(file, is_remote):
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


class _Header(tarfile.TarInfo):
    """A header of a tar file, which :mod:`tarfile` takes for the end of the archive where it is damaged or missing."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        try:
            return super().frombuf(buf, encoding, errors)
        except tarfile.EOFHeaderError:  # type: ignore[attr-defined]
            raise
        except tarfile.HeaderError as error:
            raise ValueError(f"{CUT}: where a member or the end mark has to be, there is neither ({error})") from error


def _tar_members(file: IO[bytes], is_remote: bool) -> Iterator[tuple[str, int, int, str]]:
    """Yield the members of a tar file that are no folders: name, first byte, size, and why one cannot be read or "".

    Raises:
        ValueError, tarfile.TarError: it is damaged, or has bytes behind its end mark.
    """
    mode: Any = "r|" if is_remote else "r:"
    with tarfile.open(fileobj=file, mode=mode, bufsize=_BLOCK_BYTES, tarinfo=_Header) as tar:
        while (member := tar.next()) is not None:
            tar.members.clear()  # type: ignore[attr-defined]  # of a million members each would take 1 kB
            if member.isdir():
                continue
            problem = "is sparse: unpack the archive and pack it without --sparse" if member.issparse() else ""
            if not member.isreg():
                problem = "is a link, or no regular file: unpack the archive"
            name = re.sub(r"^(?:\./+)+", "", member.name)
            yield name, member.offset_data, member.size, problem
        while rest := tar.fileobj.read(_BLOCK_BYTES):
            if rest.strip(b"\0"):
                raise ValueError(
                    "has bytes behind its end mark: if archives were joined, join them with tar --concatenate, or "
                    "keep each as a file"
                )


def _zip_members(file: IO[bytes], is_remote: bool) -> Iterator[tuple[str, int, int, str]]:
    """Yield the members of a zip file, see :func:`_tar_members`. Where only its directory is there, a member's first
    byte is that of its header.
    """
    end = file.seek(0, os.SEEK_END)
    with ZipFile(file) as packed:
        for entry in packed.infolist():
            if entry.is_dir():
                continue
            start, problem = entry.header_offset, _packed(entry, is_remote)
            if not problem:
                file.seek(start)
                start += 0 if is_remote else ZIP_HEAD_BYTES + zip_head_rest(file.read(ZIP_HEAD_BYTES), end)
                if start + entry.compress_size > end:
                    problem = "lies beyond the end of the archive, or its header is damaged: fetch it again"
            yield entry.filename, start, entry.file_size, problem


def zip_head_rest(head: bytes, otherwise: int) -> int:
    """Return how many bytes lie between the first ones of a member's header and the member.

    Args:
        head: the first :data:`ZIP_HEAD_BYTES`.
        otherwise: what is returned if it is no header.
    """
    return sum(struct.unpack("<HH", head[26:])) if head.startswith(_ZIP_HEAD) and len(head) == 30 else otherwise


def is_deflated(head: bytes) -> bool:
    """Return whether a member of a zip file is deflated, by the first bytes of its header."""
    return int.from_bytes(head[8:10], "little") == ZIP_DEFLATED


def directory_bytes(end: bytes) -> int:
    """Return how many of the last bytes of a zip file hold its directory, by the last :data:`ZIP_END_BYTES`."""
    at = end.rfind(b"PK\5\6")
    length = int.from_bytes(end[at + 12 : at + 16], "little")
    if length == 0xFFFFFFFF:
        long = end.rfind(b"PK\6\6")
        length = int.from_bytes(end[long + 40 : long + 48], "little")
    return len(end) - at + length + 1024 if at >= 0 else 0  # what lies behind the directory has less


def _packed(entry: ZipInfo, is_remote: bool) -> str:
    if entry.flag_bits & 1:
        return "is encrypted: unpack the archive"
    is_stored = entry.compress_type == ZIP_STORED and entry.compress_size == entry.file_size
    if not is_stored and not (is_remote and entry.compress_type == ZIP_DEFLATED):
        return (
            "is compressed, and cannot be read in place: unpack the archive, pack it with zip -0, or name its folder "
            "as file:///PATH, to have deflated videos copied first"
        )
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
