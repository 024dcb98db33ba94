"""A part of a file that is a file itself, such as a member of a tar archive: read in place, by FFmpeg and by us."""

from __future__ import annotations

import io
import os
import re
import stat
from dataclasses import dataclass
from typing import IO, BinaryIO

from v2v_protocol.errors import VideoUnreadable

_URL = re.compile(r"subfile,,start,(\d+),end,(\d+),,:(/.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class FileRange:
    """Bytes of a file. As a path it is FFmpeg's address of them: opening that by mistake fails, since no absolute path
    has this form.

    Attributes:
        path: of the file, absolute.
        start, end: its first byte, and the byte behind the last.
    """

    path: str
    start: int
    end: int

    def __fspath__(self) -> str:
        return f"subfile,,start,{self.start},end,{self.end},,:{self.path}"

    @classmethod
    def parse(cls, path: str | os.PathLike[str]) -> FileRange | None:
        """Return the part of a file that a path names; None if it names a whole file."""
        found = _URL.fullmatch(os.fspath(path))
        return None if found is None else cls(found[3], int(found[1]), int(found[2]))


def file_of(path: str | os.PathLike[str]) -> str:
    """Return the path of the file that holds the bytes of a path."""
    part = FileRange.parse(path)
    return os.fspath(path) if part is None else part.path


def open_bytes(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file, or a part of one.

    Raises:
        OSError: it cannot be read.
        VideoUnreadable: it is not a regular file (opening a FIFO would block until there is a writer), or ends early.
    """
    part = FileRange.parse(path)
    descriptor = os.open(file_of(path), os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and (part is None or part.end <= status.st_size):
        file = os.fdopen(descriptor, "rb")
        return file if part is None else io.BufferedReader(_Part(file, part))
    os.close(descriptor)
    why = "is not a regular file" if part is None else "its archive ends before it does"
    raise VideoUnreadable(os.fspath(path), None, why)


class _Part(io.RawIOBase):
    def __init__(self, file: IO[bytes], part: FileRange) -> None:
        self._file, self._start, self._size, self._at = file, part.start, part.end - part.start, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, to: int, whence: int = os.SEEK_SET) -> int:
        self._at = max(0, to + (0, self._at, self._size)[whence])
        return self._at

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        view = memoryview(buffer)[: max(0, self._size - self._at)]
        count = os.preadv(self._file.fileno(), [view], self._start + self._at) if len(view) else 0
        self._at += count
        return count

    def close(self) -> None:
        self._file.close()
        super().close()
