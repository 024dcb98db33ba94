"""Which files a corpus has: found below a folder or named by a list, and asked about many at a time.

On storage elsewhere each question is a round trip, most of it waiting: several are on their way at once.
"""

from __future__ import annotations

import os
import re
import stat
from collections import deque
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

UNPRINTABLE = "its name is not UTF-8 text, or holds control characters; rename it"
# C0 and C1 controls, separators of lines, and what changes the direction of text (Unicode 16, UAX 9).
_STEERING = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")


def video_files(root: Path, refused: dict[str, str]) -> Iterator[str]:
    """Relative POSIX paths of the video files below ``root``, known by their suffixes.

    Links are followed; a link to a folder that it lies in is not. Hidden files and folders (".name") are passed over.

    Args:
        root: the folder.
        refused: receives, by relative path, why a folder or file cannot be taken in.
    """
    return chain.from_iterable(_below(root, "", frozenset(), refused))


def bucket_files(names: Iterable[str], refused: dict[str, str]) -> Iterator[str]:
    """Those of the names of objects below an address that :func:`video_files` would take from a folder."""
    for name in names:
        parts = name.split("/")
        if f".{name.rpartition('.')[2].lower()}" not in VIDEO_SUFFIXES or any(part.startswith(".") for part in parts):
            continue
        if printable(name) != name:
            refused[printable(name)] = UNPRINTABLE
        elif "" in parts:
            refused[name] = "has an empty part between two slashes"
        else:
            yield name


def _below(
    folder: Path, prefix: str, above: frozenset[tuple[int, int]], refused: dict[str, str]
) -> Iterator[list[str]]:
    try:
        here = folder.stat()
        with os.scandir(folder) as listing:
            entries = sorted(listing, key=attrgetter("name"))
    except OSError as error:
        refused[printable(prefix.rstrip("/") or ".")] = f"the folder cannot be read: {error.strerror or error}"
        return
    identity = (here.st_dev, here.st_ino)
    if identity in above:
        return
    found: list[str] = []
    for entry in entries:
        name = entry.name
        if name[0] == ".":
            continue
        relative = prefix + name
        try:
            is_file = entry.is_file()
            is_folder = not is_file and entry.is_dir()
        except OSError as error:  # a link that leads in a circle, or where this user may not look
            refused[printable(relative)] = f"cannot be looked at: {error.strerror or error}"
            continue
        if is_folder:
            yield found
            found = []
            yield from _below(folder / name, f"{relative}/", above | {identity}, refused)
        elif f".{name.rpartition('.')[2].lower()}" in VIDEO_SUFFIXES and "." in name:
            if printable(relative) != relative:
                refused[printable(relative)] = UNPRINTABLE
            elif not is_file:
                refused[relative] = "is no regular file, or a link that leads nowhere"
            else:
                found.append(relative)
    yield found


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

    def may_be_read(id: str) -> bool:
        try:
            return stat.S_ISREG(os.stat(os.path.join(root, id)).st_mode)
        except OSError:
            return True

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
