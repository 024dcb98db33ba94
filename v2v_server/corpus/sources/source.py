"""Where the videos of a corpus come from, and what every source can do.

A kind of source is a file beside this one, named in :data:`SOURCE_KINDS`: a subclass of :class:`VideoSource`, and a
function ``open_source(name, options)`` that returns one, or None if the name belongs to another kind.

Errors are the same for every source: :class:`VideoGone` (not there), :class:`VideoDenied` (not permitted),
:class:`VideoChanged` (another file by now), and :class:`VideoUnreadable` for every other fault, which may pass.
"""

from __future__ import annotations

import hashlib
import os
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import msgpack

from v2v_protocol.errors import CorpusError, VideoGone, VideoUnreadable, system_errors
from v2v_protocol.persisted import reader, to_plain
from v2v_server.corpus.sources.copy_folder import CopyFolder
from v2v_server.corpus.sources.listing import ListEntry, read_list
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, kind_from, kind_of
from v2v_server.store.pixels import Pixels

UNPRINTABLE = "its name is not UTF-8 text, or holds control characters; rename it"
MANIFEST_NAME = "v2v-prepared.jsonl"
"""Name of the file that makes a folder a prepared one."""
SOURCE_KINDS = ("copies", "prepared", "folder")
"""Files of the kinds of sources, in the order in which they are asked. The last one takes any name."""
COPIES_GIB = 100.0
"""Default limit of the folder of copies."""
FileState = tuple[int, int, int]
"""Size in bytes, and two numbers that change with the content: the times of the last modification and change of status,
or a mark of an object's ETag and 0."""
NO_STATE: FileState = (-1, 0, 0)
"""The state cannot be told now."""
GONE: FileState = (-2, 0, 0)
"""There is no such file."""
_ARCHIVE_ENDINGS = ".tar", ".zip"
_START_BITS = 48
_IS_MEMBER = 1 << 62
"""Of the last number of a state. A time is below it until 2116, and that of an object is 0."""


@dataclass(frozen=True, slots=True)
class MemberPlace:
    """Where the bytes of a video lie in an archive. Its state says that, so what has the state reads no table.

    Attributes:
        archive: its path below the source.
        size: of the video, bytes.
        start: its first byte in the archive; in a zip file of object storage, that of its header.
        mark: changes with the archive, see :func:`archive_mark`.
    """

    archive: str
    size: int
    start: int
    mark: int

    @property
    def state(self) -> FileState:
        """Return the state of the video, without :func:`mark_of`."""
        stem, dot, ending = self.archive.rpartition(".")
        place = len(stem) * len(_ARCHIVE_ENDINGS) + _ARCHIVE_ENDINGS.index(dot + ending)
        return self.size, place << _START_BITS | self.start, self.mark

    @classmethod
    def of(cls, id: str, state: Sequence[int]) -> MemberPlace | None:
        """Return where a video of that state lies; None if it is a file of its own."""
        if not state or state[2] < _IS_MEMBER:
            return None
        length, ending = divmod(state[1] >> _START_BITS, len(_ARCHIVE_ENDINGS))
        start = state[1] & ((1 << _START_BITS) - 1)
        return cls(id[:length] + _ARCHIVE_ENDINGS[ending], state[0], start, state[2])

    def is_in(self, state: FileState) -> bool:
        """Return whether the archive in this state is the catalogued one."""
        return archive_mark(self.archive, state) == self.mark


def archive_mark(path: str, state: FileState) -> int:
    """Return a number that changes with an archive: by its ending and its state."""
    text = repr((path.rpartition(".")[2], *state))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8]) >> 2 | _IS_MEMBER


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """Settings beside the name of a source.

    Attributes:
        list_file: a list that restricts a folder or an address to the videos that it names.
        copies: folder for copies of videos from object storage; None: a folder where the index lies.
        copies_gib: limit of that folder, GiB.
        cache_dir: see :func:`v2v_server.system.process.cache_folder`.
        kind: what a video is.
    """

    list_file: str | os.PathLike[str] | None = None
    copies: str | os.PathLike[str] | None = None
    copies_gib: float = COPIES_GIB
    cache_dir: str | os.PathLike[str] | None = None
    kind: VideosKind = VIDEOS

    def listed(self) -> tuple[ListEntry, ...] | None:
        """Return the entries of the list; None without one.

        Raises:
            CorpusError: the list cannot be read, or makes no sense.
        """
        return None if self.list_file is None else read_list(self.list_file, self.kind)


_REOPENED = tuple[bytes, Mapping[str, Any], Mapping[str, float], Path | None, float]
"""What another process opens a source by: its name, the flags of its kind, its rates, the folder for copies, and that
folder's limit."""


class VideoSource(ABC):
    """Videos, by id.

    Args:
        name: see Attributes.
        listed: reads the list that restricts it; returns None without one.
        folder: see Attributes.

    Attributes:
        name: names the source for people, and to workers, who open it by this name; equal names share an index.
        is_local: whether the files lie on this host. False: opening one fetches it over the network.
        kind: what a video is, for listing and probing.
        rates: rates of videos that a list states, Hz, by id.
        listed: returns the entries of the list file that restricts the source; None without a list file. Raises
            CorpusError: the list cannot be read, or makes no sense.
        folder: that ids are relative to; None: they are not files of this host.
        copies: the folder for copies of its files; None without one.
        expected: the id of the video that is opened next, and its catalogued state without :func:`mark_of`. A file or
            object that is in this state need not be read whole; that of a member says where it lies in its archive.
        members: states of the videos in archives, by id, without :func:`mark_of`, while the corpus is being opened.
        tables: what its archives hold, by path, for as long (:class:`v2v_server.corpus.sources.archives.ArchiveTable`).
    """

    is_local = True
    kind: VideosKind = VIDEOS
    copies: CopyFolder | None = None
    expected: tuple[str, Sequence[int]] = "", ()

    def __init__(
        self,
        name: str,
        listed: Callable[[], tuple[ListEntry, ...] | None] = lambda: None,
        folder: Path | None = None,
    ) -> None:
        self.name, self.listed, self.folder = name, cache(listed), folder
        self.rates: dict[str, float] = {}
        self.members: dict[str, FileState] = {}
        self.tables: dict[str, Any] = {}

    def __str__(self) -> str:
        return self.name

    def to_bytes(self) -> bytes:
        """Return what another process opens it by, to open files but not to list them."""
        copies = (None, COPIES_GIB) if self.copies is None else (self.copies.folder, self.copies.most_bytes / (1 << 30))
        plain = (os.fsencode(self.name), self.kind.flags, self.rates, *copies)
        return bytes(msgpack.packb(plain, default=to_plain))

    @staticmethod
    def from_bytes(data: bytes) -> VideoSource:
        """Open the source that :meth:`to_bytes` was called of.

        Raises:
            CorpusError, UsageError: see :func:`open_source`.
            ProtocolError, ValueError: the data is malformed.
        """
        name, flags, rates, copies, gib = reader(_REOPENED)(msgpack.unpackb(data))
        # A list, which is read by listing only: without one the name of a folder can also be that of a video.
        source = open_source(os.fsdecode(name), SourceOptions(os.devnull, copies, gib, kind=kind_from(flags)))
        source.rates = rates
        return source

    @abstractmethod
    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the ids of the files that may be videos: those that the list names, or else all of them.

        Args:
            refused: receives, by id, why a file, folder or list entry is refused.
            left_out: counts, by suffix, files that may be videos of other endings.

        Yields:
            ids of videos, and paths of archives that may have videos as members (``kind.archive_endings``).

        Raises:
            CorpusError: the source cannot be listed, or cannot be served.
        """

    def _member(self, id: str, state: Sequence[int] = ()) -> MemberPlace | None:
        """Return where a video lies in an archive; None if it is a file of its own, or this process was not told.

        Args:
            state: as catalogued, without :func:`mark_of`; empty: as this process was told.
        """
        told = self.expected[1] if self.expected[0] == id else ()
        return MemberPlace.of(id, state or self.members.get(id) or told)

    @abstractmethod
    def state(self, id: str) -> FileState:
        """Ask for the state of one file now.

        Raises:
            VideoUnreadable: the file is missing or cannot be read.
        """

    def states(self, ids: Sequence[str]) -> array[int]:
        """Return the states of many files, three numbers each. States from a listing suffice. A file without a state
        has :data:`GONE` or :data:`NO_STATE`. Called in threads.
        """
        found = array("q")
        for id in ids:
            try:
                told = self.members.get(id)
                found.extend(unmarked(self, id, told) if told else self.state(id))
            except VideoUnreadable as error:
                found.extend(GONE if isinstance(error, VideoGone) else NO_STATE)
        return found

    @abstractmethod
    def open_local(self, id: str, fingerprint: str) -> AbstractContextManager[Path]:
        """Lend a file of this host with the bytes of a video or sidecar, until the end of the context. Of a member of
        an archive it is a FileRange or MemberPath, which is read like a file.

        Args:
            fingerprint: as catalogued; "" takes what is there now.

        Raises:
            VideoUnreadable, VideoChanged: the file cannot be read, or differs. A local video may be lent unchecked:
                reading it reports the same errors.
        """

    @contextmanager
    def open_pixels(self, id: str, fingerprint: str) -> Iterator[Pixels]:
        """Lend the frames of a video until the end of the context.

        Args:
            fingerprint: as catalogued; "" takes what is there now.

        Raises:
            VideoUnreadable, VideoChanged: see :meth:`open_local`.
            VideoError: the video is damaged.
        """
        with self.open_local(id, fingerprint) as path, kind_of(id).open_pixels(path) as pixels:
            yield pixels

    @abstractmethod
    def verify(self, id: str, fingerprint: str, state: FileState | str | None) -> None:
        """Check that a video or sidecar is as catalogued. A remote source that gives no answer now raises no error.

        Args:
            fingerprint, state: as catalogued; None: unknown. That of a sidecar is :meth:`sidecar_state`.

        Raises:
            VideoError: it is gone, another one by now, or (on a disk) cannot be read.
        """

    def with_sidecars(self, ids: Sequence[str], endings: Sequence[str]) -> Mapping[str, Sequence[str]]:
        """Return, by ending, those of these videos that may have such a sidecar, in their order."""
        return dict.fromkeys(endings, ids)

    def sidecar_state(self, id: str) -> str | OSError:
        """Return a text that changes with the content of a sidecar; "" if it is not there. Called in threads. A source
        without sidecars need not implement this.

        Returns:
            the text; or an error, if it cannot be told, or the sidecar is beyond the limits of
            :func:`v2v_server.corpus.sources.sidecars.state_text`.
        """
        return ""

    def has(self, files: Mapping[str, str]) -> bool:
        """Return whether :meth:`open_local` finds these files on this host. If so, they stay until the next call with
        other files.

        Args:
            files: their fingerprints, by id.
        """
        return self.copies is None or self.copies.has(files)

    def fetch(self, files: Mapping[str, str]) -> None:
        """Do the part of :meth:`open_local` that needs the network, so that :meth:`has` returns True.

        Raises:
            VideoUnreadable, VideoChanged: a file cannot be fetched, or differs.
        """
        if self.copies is not None:
            self.copies.fetch(files)


def rate_of(source: VideoSource, id: str) -> float:
    """Return the rate of a video that does not state one, Hz; 0 if it is unknown."""
    return source.kind.rate_of(source.rates.get(id))


def mark_of(source: VideoSource, id: str) -> int:
    """Return a number for the state of a video, which changes with what the user states of it."""
    return source.kind.mark(rate_of(source, id))


def unmarked(source: VideoSource, id: str, state: FileState) -> FileState:
    """Return a state without the mark, which a worker does not know: it has no flags of the kind, and no list. Of a
    state without the mark, return that with it.
    """
    return state[0], state[1], state[2] ^ mark_of(source, id)


def is_expected(source: VideoSource, id: str) -> bool:
    """Return whether a video is in the state that :attr:`VideoSource.expected` names."""
    expected, state = source.expected
    return expected == id and tuple(state) == unmarked(source, id, source.state(id))


def open_source(name: str | os.PathLike[str], options: SourceOptions = SourceOptions()) -> VideoSource:
    """Open the source that a user names: a folder, a video, a list file, or an address in object storage.

    Raises:
        CorpusError: there is no such source, or this user may not read it.
        UsageError: an address or a setting is malformed.
    """
    name = os.fspath(name)
    # A folder that this user may not enter, or a share that has gone.
    with system_errors(CorpusError, f"{name}: cannot be read"):
        for kind in SOURCE_KINDS:
            source: VideoSource | None = import_module(f"{__package__}.{kind}").open_source(name, options)
            if source is not None:
                source.kind = options.kind
                return source
    raise CorpusError(f"{name}: neither a folder, a video, a list file nor an address of a known form")
