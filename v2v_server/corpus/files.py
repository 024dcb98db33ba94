"""Which files a corpus has: found below a folder or named by a list, and asked about many at a time.

On storage elsewhere each question is a round trip, most of it waiting: several are on their way at once.
"""

from __future__ import annotations

import os
import re
import stat
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import TypeVar

from v2v_protocol.errors import CorpusError
from v2v_server.cloud.copies import Copies

Q = TypeVar("Q")
A = TypeVar("A")

Notice = Callable[[str], None]
"""Told again and again what is being looked at, and how far that is."""

_AT_ONCE = 16
_TOGETHER, _MOST_TOGETHER = 64, 1024
"""Files that a thread asks about in one go: to hand them over one by one takes longer than a local disk's answer."""
_SOON_SECONDS = 0.05
_IN_TURN = 256
"""Parts that are asked many at a time before one alone is tried again."""

VIDEO_SUFFIXES = frozenset({
    ".3gp", ".avi", ".flv", ".h264", ".h265", ".hevc", ".ivf", ".m2ts", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov",
    ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".obu", ".ogv", ".ts", ".vob", ".webm", ".wmv", ".y4m",
})  # fmt: skip

_NO_VIDEO_SUFFIXES = frozenset({
    ".7z", ".aac", ".ac3", ".aedat", ".aedat4", ".ass", ".bag", ".bib", ".bin", ".bmp", ".bz2", ".c", ".cfg", ".conf",
    ".cpp", ".csv", ".dat", ".db", ".doc", ".docx", ".exr", ".flac", ".gz", ".h", ".h5", ".hdf5", ".htm", ".html",
    ".info", ".ini", ".ipynb", ".jpeg", ".jpg", ".json", ".jsonl", ".log", ".lst", ".m4a", ".mat", ".md", ".md5",
    ".mp3", ".nfo", ".npy", ".npz", ".ogg", ".opus", ".parquet", ".pdf", ".pickle", ".pkl", ".png", ".pt", ".pth",
    ".py", ".raw", ".rst", ".sh", ".sha256", ".sqlite3", ".srt", ".sub", ".tar", ".tgz", ".thm", ".tif", ".tiff",
    ".tmp", ".toml", ".tsv", ".txt", ".vtt", ".wav", ".webp", ".xlsx", ".xml", ".xz", ".yaml", ".yml", ".zip", ".zst",
})  # fmt: skip
_MOST_SUFFIXES_SHOWN = 10

PSEUDO_FILE_SYSTEMS = frozenset({
    "binfmt_misc", "bpf", "cgroup", "cgroup2", "configfs", "debugfs", "devpts", "devtmpfs", "efivarfs", "fusectl",
    "mqueue", "nsfs", "proc", "pstore", "securityfs", "selinuxfs", "sysfs", "tracefs",
})  # fmt: skip
"""Kinds whose files are the kernel's: reading one may block, end never, or change something."""
PSEUDO = "lies in a file system of the kernel, such as /proc or /sys, where no videos are"
MOST_PATHS = 64
"""Paths with two or more links by which one folder is searched."""

UNPRINTABLE = "its name is not UTF-8 text, or holds control characters; rename it"
# C0 and C1 controls, separators of lines, and what changes the direction of text (Unicode 16, UAX 9).
_STEERING = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")


def video_files(root: Path, refused: dict[str, str], left_out: Counter[str] | None = None) -> Iterator[str]:
    """Return relative POSIX paths of the video files below ``root``, known by their suffixes.

    Links are followed; a link to a folder that it lies in is not. A folder that several links lead to has its videos
    under each path, because each such id is part of the digests of existing corpora. Folders that link to each other
    have a factorial number of paths, so a folder is searched by at most :data:`MOST_PATHS` paths with two or more
    links; paths with fewer links are not limited. Kernel file systems (/proc, /sys, /dev) are not entered. Hidden files
    and folders (".name") are passed over.

    Args:
        root: the folder.
        refused: receives, by relative path, why a folder or file cannot be taken in.
        left_out: counts, by suffix, files that may be videos of other endings.
    """
    walk = _Walk(refused, Counter() if left_out is None else left_out)
    return chain.from_iterable(walk.below(root, "", frozenset(), 0))


def left_out_note(left_out: Counter[str]) -> str:
    """Return the line that reports files with other endings; "" where there is no such file."""
    if not left_out:
        return ""
    shown = ", ".join(f"{suffix} ({count})" for suffix, count in sorted(left_out.items())[:_MOST_SUFFIXES_SHOWN])
    more = len(left_out) - _MOST_SUFFIXES_SHOWN
    return (
        f"{left_out.total()} files have endings that are not looked at and were left out: {shown}"
        f"{f' and {more} other endings' if more > 0 else ''}. Name those that are videos in a list file to serve them"
    )


def _count_left_out(name: str, left_out: Counter[str]) -> None:
    stem, _, ending = name.rpartition(".")
    suffix = printable(f".{ending.lower()}")
    if stem and len(suffix) <= 12 and suffix not in _NO_VIDEO_SUFFIXES:
        left_out[suffix] += 1


def bucket_files(names: Iterable[str], refused: dict[str, str], left_out: Counter[str] | None = None) -> Iterator[str]:
    """Those of the names of objects below an address that :func:`video_files` would take from a folder."""
    for name in names:
        parts = name.split("/")
        if any(part.startswith(".") for part in parts):
            continue
        if f".{name.rpartition('.')[2].lower()}" not in VIDEO_SUFFIXES:
            if left_out is not None:
                _count_left_out(parts[-1], left_out)
            continue
        if printable(name) != name:
            refused[printable(name)] = UNPRINTABLE
        elif "" in parts:
            refused[name] = "has an empty part between two slashes"
        else:
            yield name


class _Walk:
    """One search of a folder for videos.

    Args:
        refused, left_out: as in :func:`video_files`.
    """

    def __init__(self, refused: dict[str, str], left_out: Counter[str]) -> None:
        self._refused, self._left_out = refused, left_out
        self._pseudo = pseudo_devices()
        self._paths = Counter[tuple[int, int]]()

    def below(self, folder: Path, prefix: str, above: frozenset[tuple[int, int]], links: int) -> Iterator[list[str]]:
        """Yield the videos below a folder, some at a time.

        Args:
            prefix: of their ids.
            above: identities (device, inode) of the folders that it lies in.
            links: of the path that leads here.
        """
        refused = self._refused
        name = printable(prefix.rstrip("/") or ".")
        try:
            here = folder.stat()
            if here.st_dev in self._pseudo:
                refused[name] = PSEUDO
                return
            identity = (here.st_dev, here.st_ino)
            if identity in above:
                return
            if links > 1:
                self._paths[identity] += 1
                if (paths := self._paths[identity]) > MOST_PATHS:
                    if paths == MOST_PATHS + 1:
                        refused[name] = f"links lead to this folder by more than {MOST_PATHS} paths: remove some links"
                    return
            with os.scandir(folder) as listing:
                entries = sorted(listing, key=attrgetter("name"))
        except OSError as error:
            refused[name] = f"the folder cannot be read: {error.strerror or error}"
            return
        found: list[str] = []
        for entry in entries:
            if entry.name[0] == ".":
                continue
            relative = prefix + entry.name
            try:
                is_file = entry.is_file()
                is_folder = not is_file and entry.is_dir()
                is_pseudo = is_file and entry.is_symlink() and entry.stat().st_dev in self._pseudo
            except OSError as error:  # a link that leads in a circle, or where this user may not look
                refused[printable(relative)] = f"cannot be looked at: {error.strerror or error}"
                continue
            if is_folder:
                yield found
                found = []
                more = links + entry.is_symlink()
                yield from self.below(folder / entry.name, f"{relative}/", above | {identity}, more)
            elif f".{entry.name.rpartition('.')[2].lower()}" in VIDEO_SUFFIXES and "." in entry.name:
                if printable(relative) != relative:
                    refused[printable(relative)] = UNPRINTABLE
                elif not is_file:
                    refused[relative] = "is no regular file, or a link that leads nowhere"
                elif is_pseudo:
                    refused[relative] = PSEUDO
                else:
                    found.append(relative)
            elif is_file:
                _count_left_out(entry.name, self._left_out)
        yield found


def pseudo_devices() -> frozenset[int]:
    """Return the device numbers (``st_dev``) of the kernel file systems that are mounted here."""
    found = set()
    try:
        mounts = Path("/proc/self/mountinfo").read_bytes().splitlines()
    except OSError:
        return frozenset()
    for mount in mounts:
        before, _, after = mount.partition(b" - ")
        is_dev = before.split()[4] == b"/dev"  # in a container a tmpfs of its own
        if is_dev or after.split()[0].decode("ascii", "replace") in PSEUDO_FILE_SYSTEMS:
            major, _, minor = before.split()[2].partition(b":")
            found.add(os.makedev(int(major), int(minor)))
    return frozenset(found)


def printable(name: str) -> str:
    """The name as it may be shown: what is not UTF-8 text, and what would steer a terminal or turn the text around it
    (control and bidirectional characters), escaped."""
    if name.isascii() and name.isprintable():  # as nearly all are, and there may be a million of them
        return name
    text = os.fsencode(name).decode("utf-8", "backslashreplace")
    return _STEERING.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def corpus_root(source: Path) -> Path:
    """The folder that the ids of a corpus are relative to: itself, or that of the video or list file.

    Raises:
        CorpusError: there is none, or this user may not look at it.
    """
    try:
        if source.is_dir():
            return source.resolve()
        is_file = source.is_file()
    except OSError as error:
        raise CorpusError(f"{source}: cannot be looked at: {error.strerror or error}") from error
    if not is_file:
        raise CorpusError(f"{source}: there is no such folder, video or list file on this host")
    return source.parent.resolve()


def regular_files(
    root: Path | Copies, ids: Sequence[str], refused: dict[str, str], notice: Notice | None = None
) -> tuple[str, ...]:
    """Those of the ids of a list that do not name something else than a file.

    To open a named pipe waits for somebody to write into it, for ever if need be, and a device may not end. An id that
    names nothing stays: whoever reads it says why it cannot.

    Args:
        root: the folder that ids are relative to.
        ids: that the list names.
        refused: receives, by id, why one cannot be taken in.
        notice: told how far it is.
    """

    if isinstance(root, Copies):
        return tuple(ids)

    pseudo = pseudo_devices()

    def may_be_read(id: str) -> bool:
        try:
            status = os.stat(os.path.join(root, id))
        except OSError:
            return True
        return stat.S_ISREG(status.st_mode) and status.st_dev not in pseudo

    found = []
    for done, (id, is_regular) in enumerate(answers(may_be_read, ids), 1):
        if notice is not None:
            notice(f"looking at the list's files: {done} of {len(ids)}")
        if is_regular:
            found.append(id)
        else:
            refused[id] = "is no regular file"
    return tuple(found)


def is_said(done: int) -> bool:
    """Whether progress is told after so many: to tell it a million times takes seconds."""
    return done <= _TOGETHER or done % _TOGETHER == 0


def answers(question: Callable[[Q], A], files: Sequence[Q]) -> Generator[tuple[Q, A], None, None]:
    """(file, answer) for each file, in their order.

    Args:
        question: asked in threads; must not raise.
        files: what to ask it of.
    """
    with closing(by_parts(lambda part: [question(file) for file in part], files)) as answered:
        for part, found in answered:
            yield from zip(part, found, strict=True)


def by_parts(question: Callable[[Sequence[Q]], A], files: Sequence[Q]) -> Generator[tuple[Sequence[Q], A], None, None]:
    """(some of the files, answer) until all were asked about, in their order.

    One part after the other while they are answered at once, for threads that take turns cost more than a local disk's
    answer. When one is waited for, many are asked at a time; whether that is still needed is tried again and again.

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
                    except RuntimeError:  # the system has no room for another thread: then one after the other
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
