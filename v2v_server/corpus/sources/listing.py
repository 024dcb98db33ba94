"""What listing videos takes: list files, which name them; files beside them that nothing asks for; and asking something
of many files.

On remote storage each question about a file is a round trip, most of it waiting, so several are under way at once.
"""

from __future__ import annotations

import csv
import math
import os
import re
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

from v2v_protocol.errors import CorpusError
from v2v_protocol.programs import counted, printable
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS

_NO_VIDEO_SUFFIXES = frozenset({
    ".7z", ".aac", ".ac3", ".aedat", ".aedat4", ".ass", ".bag", ".bib", ".bin", ".bmp", ".bz2", ".c", ".cfg", ".conf",
    ".cpp", ".csv", ".dat", ".db", ".doc", ".docx", ".exr", ".flac", ".gz", ".h", ".h5", ".hdf5", ".htm", ".html",
    ".info", ".ini", ".ipynb", ".jpeg", ".jpg", ".json", ".jsonl", ".log", ".lst", ".m4a", ".mat", ".md", ".md5",
    ".mp3", ".nfo", ".npy", ".npz", ".ogg", ".opus", ".parquet", ".pdf", ".pickle", ".pkl", ".png", ".pt", ".pth",
    ".py", ".raw", ".rst", ".sh", ".sha256", ".sqlite3", ".srt", ".sub", ".tar", ".tgz", ".thm", ".tif", ".tiff",
    ".tmp", ".toml", ".tsv", ".txt", ".vtt", ".wav", ".webp", ".xlsx", ".xml", ".xz", ".yaml", ".yml", ".zip", ".zst",
})  # fmt: skip
_MOST_SUFFIXES_SHOWN = 10
_UNREAD_ARCHIVES = (
    (
        re.compile(r".+\.(tar\.[a-z0-9]+|tgz|tbz2?|txz|tzst)", re.IGNORECASE),
        "compressed tar archives cannot be read in place: decompress them, with gunzip or zstd -d",
    ),
    (
        re.compile(r"(?P<whole>.+?)(\.zip)?([._-]part[._-]?[a-z]{2}|(?<=\.zip)\.\d{3})"),
        "parts of a split archive: join them, with cat {prefix}* > {whole}.zip",
    ),
    (
        re.compile(r"(?P<whole>.+)\.z\d\d"),
        "parts of a split archive: join them, with zip -s 0 {whole}.zip --out whole.zip",
    ),
)
_PARQUET = "videos in parquet are not read: write their values to the members of tar archives"

LIST_SUFFIXES = frozenset({".txt", ".csv", ".lst"})
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
_COLUMNS = "path", "frames", "c+", "c-", "rate"


def count_left_out(name: str, left_out: Counter[str]) -> None:
    """Count a file that may be a video of another ending, or an archive of videos."""
    for form, text in _UNREAD_ARCHIVES:
        if (found := form.fullmatch(name)) is not None:
            prefix = name[: -2 if name[-1].isalpha() else -3]
            left_out[printable(text.format(prefix=prefix, **found.groupdict()))] += 1
            return
    if name.endswith(".parquet"):
        left_out[_PARQUET] += 1
    stem, _, ending = name.rpartition(".")
    suffix = printable(f".{ending.lower()}")
    if stem and len(suffix) <= 12 and suffix not in _NO_VIDEO_SUFFIXES:
        left_out[suffix] += 1


def left_out_note(left_out: Counter[str], has_videos: bool = True) -> str:
    """Return the line that reports folders of outputs, and files with other endings; "" where there are none. Files of
    parquet, which may be tables, count where there are no videos.
    """
    archives = {text: n for text, n in left_out.items() if n and " " in text and not (has_videos and text == _PARQUET)}
    left_out = Counter({name: count for name, count in left_out.items() if " " not in name})
    folders = sorted(name for name in left_out if name.endswith("/"))
    endings = sorted(item for item in left_out.items() if not item[0].endswith("/"))
    lines = [f"{counted(count, 'file')} left out: {text}" for text, count in sorted(archives.items())]
    del lines[_MOST_SUFFIXES_SHOWN:]
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


def format_problems(problems: Mapping[str, str]) -> str:
    """Return the first few reasons, for an error message; "" without one."""
    if not problems:
        return ""
    shown = "; ".join(f"{id}: {problems[id]}" for id in sorted(problems)[:3])
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return f" ({shown}{more})"


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
    is_csv, most = Path(path).suffix.lower() == ".csv", len(_COLUMNS) - (not kind.has_listed_rates)
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
    if not (id := kind.listed_id(path)):
        raise ValueError(f"{text!r} does not name a video file")
    if printable(text) != text:
        raise ValueError(f"{printable(text)} holds control characters")
    return id


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
