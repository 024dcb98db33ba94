"""Where the videos of a corpus come from, and what every source can do.

A kind of source is a file beside this one, named in :data:`SOURCE_KINDS`: a subclass of :class:`VideoSource`, and a
function ``open_source(name, options)`` that returns one, or None if the name belongs to another kind.

Errors are the same for every source: :class:`VideoGone` (not there), :class:`VideoDenied` (not permitted),
:class:`VideoChanged` (another file by now), and :class:`VideoUnreadable` for every other fault, which may pass.

On remote storage each question about a file is a round trip, most of it waiting, so several are under way at once
(:func:`by_parts`).
"""

from __future__ import annotations

import os
import zlib
from abc import ABC, abstractmethod
from array import array
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.sources.listfile import ListEntry, read_list
from v2v_server.corpus.sources.sidecar import state_text
from v2v_server.store.pixels import VIDEOS, Pixels, VideosKind, kind_of, open_pixels
from v2v_server.video.rows import Rows

Q = TypeVar("Q")
A = TypeVar("A")

Notice = Callable[..., None]
"""Progress callback: a line of text; with ``is_urgent=True`` it is shown at once."""

_AT_ONCE = 16
_TOGETHER, _MOST_TOGETHER = 64, 1024
"""Files per task of a thread: passing them one by one takes longer than a local disk's answer."""
_SOON_SECONDS = 0.05
_IN_TURN = 256
"""Parts that are asked many at a time before one alone is tried again."""
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


def is_said(done: int) -> bool:
    """Return whether progress is reported after this number of files: a million reports take seconds."""
    return done <= _TOGETHER or done % _TOGETHER == 0


def answers(question: Callable[[Q], A], files: Sequence[Q]) -> Generator[tuple[Q, A], None, None]:
    """Yield (file, answer) for each file, in their order.

    Args:
        question: asked in threads; must not raise.
        files: what to ask it of.
    """
    with closing(by_parts(lambda part: [question(file) for file in part], files)) as answered:
        for part, found in answered:
            yield from zip(part, found, strict=True)


def by_parts(question: Callable[[Sequence[Q]], A], files: Sequence[Q]) -> Generator[tuple[Sequence[Q], A], None, None]:
    """Yield (some of the files, answer) until all were asked about, in their order.

    While answers are fast, one part is asked at a time, because switching threads costs more than a local disk's
    answer. After a slow answer many parts are asked at a time; later a single one is tried again.

    Args:
        question: asked of a part of the files in threads; must not raise.
        files: what to ask it of.
    """
    asked: deque[tuple[Sequence[Q], Future[A] | None]] = deque()
    at, together, at_once, in_turn = 0, _TOGETHER, 1, 0
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        try:
            while asked or at < len(files):
                while at < len(files) and len(asked) < at_once:
                    part = files[at : at + together]
                    at += len(part)
                    try:
                        asked.append((part, threads.submit(question, part)))
                    except RuntimeError:  # no further thread can be started: continue without threads
                        threads.shutdown(cancel_futures=True)
                        asked.append((part, None))
                part, answer = asked[0]
                if answer is None or answer.cancelled():
                    found = question(part)
                else:
                    try:
                        found = answer.result(_SOON_SECONDS if at_once == 1 else None)
                    except TimeoutError:
                        together, at_once, in_turn = _TOGETHER, 2 * _AT_ONCE, _IN_TURN
                        continue
                asked.popleft()
                yield part, found
                if at_once == 1:
                    together = min(2 * together, _MOST_TOGETHER)
                elif (in_turn := in_turn - 1) <= 0:
                    at_once = 1
        finally:
            threads.shutdown(cancel_futures=True)


if TYPE_CHECKING:
    from v2v_server.corpus.manifest import Manifest


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


class VideoSource(ABC):
    """Videos, by id. Can be pickled; what arrives in another process opens files, but does not list them.

    Args:
        name: see Attributes.
        listed: reads the list that restricts it, when it is first needed; returns None without one.

    Attributes:
        name: names the source for people, and to workers, who open it by this name; equal names share an index.
        is_local: whether the files lie on this host. False: opening one fetches it over the network.
        kind: what a video is, for listing and probing.
        rates: rates of videos that a list states, Hz, by id.
    """

    is_local = True
    kind = VIDEOS

    def __init__(self, name: str, listed: Callable[[], tuple[ListEntry, ...] | None] = lambda: None) -> None:
        self.name, self._read_list = name, listed
        self.rates: dict[str, float] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only lists: it may be large."""
        return {name: value for name, value in vars(self).items() if name not in ("_read_list", "listed", "manifest")}

    @cached_property
    def listed(self) -> tuple[ListEntry, ...] | None:
        """Return the entries of the list file that restricts the source; None without a list file.

        Raises:
            CorpusError: the list cannot be read, or makes no sense.
        """
        return self._read_list()

    def __str__(self) -> str:
        return self.name

    @property
    def folder(self) -> Path:
        """Return the folder that ids are relative to.

        Raises:
            CorpusError: there is no such folder on this host.
        """
        raise CorpusError(f"{self}: not a folder of this host; copy the videos to one first")

    @property
    def manifest(self) -> Manifest | None:
        """Manifest of a prepared corpus; None for any other."""
        return None

    def make(self) -> None:  # noqa: B027 - a local source writes nothing
        """Create what opening files needs on this host. Listing and opening files come after it.

        Raises:
            CorpusError: it cannot be created or written to.
        """

    @abstractmethod
    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the ids of the files that may be videos: those that the list names, or else all of them.

        Args:
            refused: receives, by id, why a file, folder or list entry is refused.
            left_out: counts, by suffix, files that may be videos of other endings.

        Raises:
            CorpusError: the source cannot be listed, or cannot be served.
        """

    @abstractmethod
    def states(self, ids: Sequence[str]) -> array[int]:
        """Return the states of many files, three numbers each. States from a listing suffice. A file without a state
        has :data:`GONE` or :data:`NO_STATE`. Called in threads.
        """

    @abstractmethod
    def state(self, id: str) -> FileState:
        """Ask for the state of one file now.

        Raises:
            VideoUnreadable: the file is missing or cannot be read.
        """

    @abstractmethod
    def open_local(self, id: str, fingerprint: str) -> AbstractContextManager[Path]:
        """Lend a file of this host with the bytes of a video or sidecar, until the end of the context.

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
        with self.open_local(id, fingerprint) as path, open_pixels(path, kind_of(id)) as pixels:
            yield pixels

    def rate(self, id: str) -> float:
        """Return the rate of a video that does not state one, Hz; 0 if it is unknown."""
        return self.kind.rendered_hz if self.kind.is_rendered else self.rates.get(id, self.kind.rate)

    def mark(self, id: str) -> int:
        """Return a number for the state of a video, which changes with the rate that is stated for it."""
        if self.kind.is_rendered:
            return 1 + zlib.crc32(f"{self.kind.rendered_hz} {self.kind.frames}".encode())
        return 1 + int(1e6 * self.rate(id)) if self.kind.has_parts else 0

    def state_of_parts(self, id: str, files: Sequence[tuple[str, FileState]]) -> FileState:
        """Return the state of a folder of pictures from those of its files.

        Raises:
            OSError: it is beyond the limits of :func:`v2v_server.corpus.sources.sidecar.state_text`.
        """
        size = sum(state[0] for _, state in files)
        return (size, int(state_text(files)[:15], 16), self.mark(id)) if files else GONE

    def file_of(self, id: str) -> str:
        """Return the path of a video's file or folder from :attr:`folder`."""
        return id

    def keep_as(self, id: str, found: str, fingerprint: str) -> None:  # noqa: B027 - a local source has no copies
        """Let the copy that was made for probing be found under the video's full fingerprint.

        Args:
            found: fingerprint of the file, its size, head and tail.
            fingerprint: the full one.
        """

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
            :func:`v2v_server.corpus.sources.sidecar.state_text`.
        """
        return ""

    def has(self, files: Mapping[str, str]) -> bool:
        """Return whether :meth:`open_local` finds these files on this host. If so, they stay until the next call with
        other files.

        Args:
            files: their fingerprints, by id.
        """
        return True

    def fetch(self, files: Mapping[str, str]) -> None:  # noqa: B027 - a local source has nothing to fetch
        """Do the part of :meth:`open_local` that needs the network, so that :meth:`has` returns True.

        Raises:
            VideoUnreadable, VideoChanged: a file cannot be fetched, or differs.
        """

    def release(self) -> None:  # noqa: B027 - a local source keeps nothing
        """Release the files that :meth:`has` or :meth:`fetch` keeps."""

    def rows(self, asked: Rows | None) -> Rows:
        """Return which rows of the pictures may be used.

        Args:
            asked: rows that the user asks for; None: all that there are.

        Raises:
            CorpusError: the source does not have them.
        """
        return asked or Rows()

    def worker_flags(self) -> list[str]:
        """Return the flags of ``v2v-worker`` with which another process opens this source, beside its name."""
        return []


def open_source(name: str | os.PathLike[str], options: SourceOptions = SourceOptions()) -> VideoSource:
    """Open the source that a user names: a folder, a video, a list file, or an address in object storage.

    Raises:
        CorpusError: there is no such source, or this user may not read it.
        UsageError: an address or a setting is malformed.
    """
    name = os.fspath(name)
    try:
        for kind in SOURCE_KINDS:
            source: VideoSource | None = import_module(f"{__package__}.{kind}").open_source(name, options)
            if source is not None:
                source.kind = options.kind
                return source
    except OSError as error:  # a folder that this user may not enter, a share that has gone
        raise CorpusError(f"{name}: cannot be read: {error.strerror or error}") from error
    raise CorpusError(f"{name}: neither a folder, a video, a list file nor an address of a known form")
