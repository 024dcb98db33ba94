"""Where the videos of a corpus come from, and what every source can do.

A kind of source is a file beside this one, named in :data:`SOURCE_KINDS`: a subclass of :class:`VideoSource`, and a
function ``open_source(name, options)`` that returns one, or None if the name belongs to another kind.

Errors are the same for every source: :class:`VideoGone` (not there), :class:`VideoDenied` (not permitted),
:class:`VideoChanged` (another file by now), and :class:`VideoUnreadable` for every other fault, which may pass.

On remote storage each question about a file is a round trip, most of it waiting, so several are under way at once
(:func:`by_parts`).

A sidecar is a file or folder beside a video that an array is made from, such as its labels. It has the video's name
with another ending: ``clip.mp4`` has ``clip.boxes.json`` and ``clip.masks/``. An ending with a slash names a folder,
with files at all depths; hidden files are passed over. The known endings are those that ``v2v_protocol.sample.ARRAYS``
states. A sidecar's id is its path, with the slash.

Its fingerprint is ``<size in bytes>-<32 hexadecimal digits>``, from the names and all bytes of its files. It is read
whole when it is listed. Later a file is checked against the fingerprint, and a folder file by file against a table: the
number at the end of a file's name is its frame, so a clip needs few of them.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import math
import os
import re
import stat
import zlib
from abc import ABC, abstractmethod
from array import array
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.resources.abc import Traversable
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, TypeVar
from zipfile import Path as ZipPath
from zipfile import ZipFile

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError, VideoChanged, VideoError, VideoGone, VideoUnreadable
from v2v_protocol.persisted import reader, to_plain
from v2v_protocol.programs import printable
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.labels import frame_of
from v2v_server.store.pixels import VIDEOS, Pixels, VideosKind, kind_of, open_pixels
from v2v_server.video.fingerprint import unreadable
from v2v_server.video.rows import Rows

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
        if stat.S_ISDIR(os.stat(path).st_mode) != id.endswith("/"):
            return ""
        found = ((name, os.stat(str(file))) for name, file in _files(path))
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


_NO_VIDEO_SUFFIXES = frozenset({
    ".7z", ".aac", ".ac3", ".aedat", ".aedat4", ".ass", ".bag", ".bib", ".bin", ".bmp", ".bz2", ".c", ".cfg", ".conf",
    ".cpp", ".csv", ".dat", ".db", ".doc", ".docx", ".exr", ".flac", ".gz", ".h", ".h5", ".hdf5", ".htm", ".html",
    ".info", ".ini", ".ipynb", ".jpeg", ".jpg", ".json", ".jsonl", ".log", ".lst", ".m4a", ".mat", ".md", ".md5",
    ".mp3", ".nfo", ".npy", ".npz", ".ogg", ".opus", ".parquet", ".pdf", ".pickle", ".pkl", ".png", ".pt", ".pth",
    ".py", ".raw", ".rst", ".sh", ".sha256", ".sqlite3", ".srt", ".sub", ".tar", ".tgz", ".thm", ".tif", ".tiff",
    ".tmp", ".toml", ".tsv", ".txt", ".vtt", ".wav", ".webp", ".xlsx", ".xml", ".xz", ".yaml", ".yml", ".zip", ".zst",
})  # fmt: skip
_MOST_SUFFIXES_SHOWN = 10

UNPRINTABLE = "its name is not UTF-8 text, or holds control characters; rename it"
MANIFEST_NAME = "v2v-prepared.jsonl"
"""Name of the file that makes a folder a prepared one."""
LIST_SUFFIXES = frozenset({".txt", ".csv", ".lst"})
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
_SUFFIX = re.compile(r"\.(?=.*[a-z]|26[45]$)[a-z0-9]+", re.IGNORECASE)
_COLUMNS = "path", "frames", "c+", "c-", "rate"


def count_left_out(name: str, left_out: Counter[str]) -> None:
    """Count a file that may be a video of another ending."""
    stem, _, ending = name.rpartition(".")
    suffix = printable(f".{ending.lower()}")
    if stem and len(suffix) <= 12 and suffix not in _NO_VIDEO_SUFFIXES:
        left_out[suffix] += 1


def left_out_note(left_out: Counter[str]) -> str:
    """Return the line that reports folders of outputs, and files with other endings; "" where there are none."""
    folders = sorted(name for name in left_out if name.endswith("/"))
    endings = sorted(item for item in left_out.items() if not item[0].endswith("/"))
    lines = []
    if folders:
        lines.append(
            f"{len(folders)} folders that a v2v command wrote were passed over: {_shown(folders)}. Move videos out of "
            "them to serve them"
        )
    if endings:
        shown = _shown([f"{suffix} ({count})" for suffix, count in endings])
        lines.append(
            f"{sum(count for _, count in endings)} files have endings that are not looked at and were left out: "
            f"{shown}. Name those that are videos in a list file to serve them"
        )
    return ". ".join(lines)


def _shown(names: Sequence[str]) -> str:
    more = len(names) - _MOST_SUFFIXES_SHOWN
    return ", ".join(names[:_MOST_SUFFIXES_SHOWN]) + (f" and {more} others" if more > 0 else "")


@dataclass(frozen=True, slots=True)
class ListEntry:
    """One line of a list file.

    Attributes:
        id: relative POSIX path of the video, normalised ("./a//b.mp4" is "a/b.mp4").
        frames: the frame count the list states, or None.
        threshold_pos, threshold_neg: contrast thresholds the list states, log units, or None.
        rate: frames per second, or None.
    """

    id: str
    frames: int | None = None
    threshold_pos: float | None = None
    threshold_neg: float | None = None
    rate: float | None = None


def read_list(path: str | os.PathLike[str], kind: VideosKind = VIDEOS) -> tuple[ListEntry, ...]:
    """Read the entries of a list file like the paper's, in its order: one video a line, ``path frames c+ c- rate``.

    The columns after the path may be left out from the right. A single threshold holds for both polarities. The rate is
    for picture sequences without time stamps. Paths may hold spaces, since no path ends in a number of its own; ``#``
    at the beginning of a line makes it a comment. In a ``.csv`` file commas separate the columns, which may be empty,
    and a first line whose first column reads ``path`` is its heading. WebVid's own tables
    (``videoid,contentUrl,duration,page_dir,name``) name ``page_dir/videoid.mp4``, as its downloaders write them.

    Args:
        kind: what a video is; a path without an ending names a folder if videos have parts.

    Raises:
        CorpusError: the file cannot be read, is empty, or a line makes no sense; the message gives the line number.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CorpusError(f"list {path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise CorpusError(f"list {path} is not UTF-8 text ({error.reason} at byte {error.start})") from error
    is_csv, most = Path(path).suffix.lower() == ".csv", len(_COLUMNS) - (not kind.has_parts)
    entries: dict[str, int] = {}
    found: list[ListEntry] = []
    webvid: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            fields = _comma_columns(line.strip()) if is_csv else _space_columns(line.strip(), most)
            if not found and fields[0].lower() == "path":
                continue
            if not found and {"videoid", "page_dir"} <= set(fields):
                webvid = [fields.index("page_dir"), fields.index("videoid")]
                continue
            entry = _webvid_entry(fields, *webvid) if webvid else _entry(fields, kind, most)
            if entry.id in entries:
                raise ValueError(f"{entry.id} is listed already in line {entries[entry.id]}")
        except (ValueError, csv.Error) as error:
            raise CorpusError(f"list {path}, line {number}: {error}") from error
        entries[entry.id] = number
        found.append(entry)
    if not found:
        raise CorpusError(f"list {path}: names no video; write one a line: path [frames [c+ [c-]]]")
    return tuple(found)


def _comma_columns(line: str) -> list[str]:
    return [field.strip() for field in next(csv.reader([line], strict=True))]


def _space_columns(line: str, most: int) -> list[str]:
    words = list(_words_from_the_right(line, most))
    return [line[: len(line) - sum(map(len, words))].strip(), *(word.strip() for word in reversed(words))]


def _words_from_the_right(line: str, most: int) -> Iterator[str]:
    """Yield the numbers that end a line, last first, each with the space in front of it; never the whole line."""
    for _ in range(most - 1):
        match = re.search(r"\s+(\S+)$", line)
        if match is None or not _NUMBER.fullmatch(match[1]):
            return
        yield match[0]
        line = line[: match.start()]


def _webvid_entry(fields: list[str], folder: int, video: int) -> ListEntry:
    if len(fields) <= max(folder, video):
        raise ValueError(f"{len(fields)} columns, fewer than the heading has")
    return ListEntry(_relative(f"{fields[folder]}/{fields[video]}.mp4"))


def _entry(fields: list[str], kind: VideosKind, most: int) -> ListEntry:
    if len(fields) > most:
        raise ValueError(f"{len(fields)} columns; there are at most {most}: {' '.join(_COLUMNS[:most])}")
    fields += [""] * (len(_COLUMNS) - len(fields))
    frames, positive, negative, rate = (_number(field) if field else None for field in fields[1:])
    if frames is not None and (frames < 1 or frames != int(frames)):
        raise ValueError(f"{fields[1]} frames; give a whole number from 1")
    for what, value in ("contrast threshold", positive), ("contrast threshold", negative), ("rate", rate):
        if value is not None and value <= 0:
            raise ValueError(f"{what} {value:g}; give one above 0")
    count, negative = None if frames is None else int(frames), positive if negative is None else negative
    return ListEntry(_relative(fields[0], kind), count, positive, negative, rate)


def _number(field: str) -> float:
    if not _NUMBER.fullmatch(field) or not math.isfinite(float(field)):
        raise ValueError(f"{field!r} is not a number")
    return float(field)


def _relative(text: str, kind: VideosKind = VIDEOS) -> str:
    path = PurePosixPath(text.replace("\\", "/"))
    if path.is_absolute() or re.match(r"[A-Za-z]:/", str(path)):
        raise ValueError(f"{text} is absolute; give paths relative to the folder of the videos")
    if ".." in path.parts:
        raise ValueError(f"{text} leaves the folder of the videos")
    is_folder = kind.has_parts and path.suffix.lower() != ".zip"
    if not (is_folder or _SUFFIX.fullmatch(path.suffix)):
        raise ValueError(f"{text!r} does not name a video file")
    if printable(text) != text:
        raise ValueError(f"{printable(text)} holds control characters")
    return f"{path}/" if is_folder else str(path)


Q = TypeVar("Q")
A = TypeVar("A")

Notice = Callable[..., None]
"""Progress callback: a line of text; with ``is_urgent=True`` it is shown at once."""


def silent(*_: object, **__: object) -> None:
    """Report no progress."""


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
_SEQUENCE_READER = 3
"""Raise it with every change of what probing a sequence finds: they are probed again."""
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
    from v2v_server.corpus.sources.prepared import Manifest


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


_REOPENED = tuple[bytes, VideosKind, Mapping[str, float], Path | None, float]
"""What another process opens a source by: its name, kind and rates, the folder for copies, and that folder's limit."""


class VideoSource(ABC):
    """Videos, by id.

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
    _expected: tuple[str, tuple[int, ...]] = "", ()

    def __init__(self, name: str, listed: Callable[[], tuple[ListEntry, ...] | None] = lambda: None) -> None:
        self.name, self._read_list = name, listed
        self.rates: dict[str, float] = {}

    def to_bytes(self) -> bytes:
        """Return what another process opens it by, to open files but not to list them."""
        plain = (os.fsencode(self.name), self.kind, self.rates, *self.copies_options)
        return bytes(msgpack.packb(plain, default=to_plain))

    @staticmethod
    def from_bytes(data: bytes) -> VideoSource:
        """Open the source that :meth:`to_bytes` was called of.

        Raises:
            CorpusError, UsageError: see :func:`open_source`.
            ProtocolError, ValueError: the data is malformed.
        """
        name, kind, rates, copies, gib = reader(_REOPENED)(msgpack.unpackb(data))
        # A list, which is read by listing only: without one the name of a folder can also be that of a video.
        source = open_source(os.fsdecode(name), SourceOptions(os.devnull, copies, gib, kind=kind))
        source.rates = rates
        return source

    @property
    def copies_options(self) -> tuple[Path | None, float]:
        """Return the folder for copies of its files, and that folder's limit, GiB; None without one."""
        return None, COPIES_GIB

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

    def states(self, ids: Sequence[str]) -> array[int]:
        """Return the states of many files, three numbers each. States from a listing suffice. A file without a state
        has :data:`GONE` or :data:`NO_STATE`. Called in threads.
        """
        found = array("q")
        for id in ids:
            try:
                found.extend(self.state(id))
            except VideoUnreadable as error:
                found.extend(GONE if isinstance(error, VideoGone) else NO_STATE)
        return found

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

    def unmarked(self, id: str, state: FileState) -> FileState:
        """Return a state without the mark of a rate, which a worker does not know."""
        return state[0], state[1], state[2] ^ self.mark(id)

    def expect(self, id: str, state: Sequence[int]) -> None:
        """Say in which :meth:`unmarked` state a video was catalogued, before it is opened. A file or object that is in
        it need not be read whole.

        Args:
            id: of the video.
            state: as catalogued; empty if unknown.
        """
        self._expected = id, tuple(state)

    def _is_expected(self, id: str) -> bool:
        return self._expected[0] == id and self._expected[1] == self.unmarked(id, self.state(id))

    def rate(self, id: str) -> float:
        """Return the rate of a video that does not state one, Hz; 0 if it is unknown."""
        return self.kind.rendered_hz if self.kind.is_rendered else self.rates.get(id, self.kind.rate)

    def mark(self, id: str) -> int:
        """Return a number for the state of a video, which changes with what the user states of it."""
        if self.kind.is_rendered:
            return 1 + zlib.crc32(f"{self.kind.rendered_hz} {self.kind.frames}".encode())
        return (
            _SEQUENCE_READER + int(1e6 * self.rate(id)) + (self.kind.picture_bits << 44) if self.kind.has_parts else 0
        )

    def state_of_parts(self, id: str, files: Sequence[tuple[str, FileState]]) -> FileState:
        """Return the state of a folder of pictures from those of its files.

        Raises:
            OSError: it is beyond the limits of :func:`v2v_server.corpus.sources.source.state_text`.
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
            :func:`v2v_server.corpus.sources.source.state_text`.
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
