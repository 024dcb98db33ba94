"""A zip file or a folder of files, read the same way."""

from __future__ import annotations

import contextlib
import posixpath
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError


class Archive:
    """Members by their paths, with / between the parts.

    Args:
        path: a zip file or a folder.

    Raises:
        UsageError: neither of them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        if path.is_dir():
            files = sorted(file for file in path.rglob("*") if file.is_file())
            self.bytes_of = _without_hidden({file.relative_to(path).as_posix(): file.stat().st_size for file in files})
            return
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise UsageError(f"{path} is neither a folder nor a whole zip file: {error}") from error
        self.bytes_of = _without_hidden(
            {entry.filename: entry.file_size for entry in self._zip.infolist() if not entry.is_dir()}
        )

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def find(self, name: str) -> str | None:
        """The member of this name in the outermost folder that has one; None without any.

        Raises:
            UsageError: several folders of that depth have one, so these are several recordings.
        """
        found = [member for member in self.bytes_of if member == name or member.endswith(f"/{name}")]
        depth = min((member.count("/") for member in found), default=0)
        outermost = sorted(member for member in found if member.count("/") == depth)
        if len(outermost) > 1:
            folders = ", ".join(member.removesuffix(f"/{name}") for member in outermost[:3])
            raise UsageError(f"{self.path} holds {len(outermost)} recordings ({folders}): give each by itself")
        return outermost[0] if outermost else None

    @contextlib.contextmanager
    def open(self, member: str) -> Iterator[IO[bytes]]:
        """A stream of its bytes.

        Raises:
            UsageError: no such member, or it is damaged (on opening or while it is read), encrypted, or packed by a
                method that Python has not.
        """
        if member not in self.bytes_of:
            raise UsageError(f"{self.path} has no {member}")
        try:
            with self._open(member) as stream:
                yield stream
        except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise UsageError(f"{self.path}: {member} cannot be read: {error}") from error

    def _open(self, member: str) -> IO[bytes]:
        if self._zip is None:
            return (self.path / member).open("rb")
        try:
            return self._zip.open(member)
        except RuntimeError as error:  # encrypted, or packed by a method that Python has not: Deflate64 of Windows
            raise UsageError(
                f"{self.path}: {member} cannot be read: {error}; unpack it, and give the folder"
            ) from error

    def picture(self, member: str) -> npt.NDArray[np.uint8]:
        """A PNG or JPEG as grey values, uint8 [H, W].

        Raises:
            UsageError: as :meth:`open`, or no picture.
        """
        with self.open(member) as stream:
            data = np.frombuffer(stream.read(), np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
        if pixels is None:
            raise UsageError(f"{self.path}: {member} is no picture that can be read")
        return np.asarray(pixels, np.uint8)


def _without_hidden(bytes_of: dict[str, int]) -> dict[str, int]:
    """Without the ``._name`` that macOS puts beside each file, in zips (under ``__MACOSX``) and on foreign disks."""
    return {member: size for member, size in bytes_of.items() if not posixpath.basename(member).startswith("._")}
