"""Read a zip file or a folder of files through the same interface."""

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
from v2v_recordings.items import SensorSize


class Archive:
    """Give access to the members of a zip file or folder by their paths, with / as separator.

    Attributes:
        bytes_of: size of each member by its path.

    Raises:
        UsageError: the path is neither a folder nor a complete zip file.
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
            raise UsageError(
                f"{path} is neither a folder nor a complete zip file: {error}; if it was cut, load it again"
            ) from error
        self.bytes_of = _without_hidden(
            {entry.filename: entry.file_size for entry in self._zip.infolist() if not entry.is_dir()}
        )

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def find(self, name: str) -> str | None:
        """Return the member of this name in the outermost folder that has one; None if there is no such member.

        The name is in small letters; a member in capitals is found too.

        Raises:
            UsageError: several folders of that depth have one, so the archive holds several recordings.
        """
        found = self.named(name)
        depth = min((member.count("/") for member in found), default=0)
        outermost = sorted(member for member in found if member.count("/") == depth)
        if len(outermost) > 1:
            folders = ", ".join(posixpath.dirname(member) for member in outermost[:3])
            raise UsageError(f"{self.path} holds {len(outermost)} recordings ({folders}): convert each separately")
        return outermost[0] if outermost else None

    def named(self, name: str) -> list[str]:
        """Return all members of this name, which is in small letters."""
        return [member for member in self.bytes_of if posixpath.basename(member).lower() == name]

    def integers(self, member: str) -> list[int]:
        """Read the numbers of a text, rounded.

        Raises:
            UsageError: as :meth:`open`, or it holds something else.
        """
        with self.open(member) as stream:
            words = stream.read().decode("utf-8-sig", "replace").split()
        try:
            return [round(float(word)) for word in words]
        except (ValueError, OverflowError) as error:
            raise UsageError(f"{self.path}: {member} holds text that is not a number: {error}") from None

    @contextlib.contextmanager
    def open(self, member: str) -> Iterator[IO[bytes]]:
        """Open a stream of a member's bytes.

        Raises:
            UsageError: there is no such member, or it is damaged (on opening or while it is read), encrypted, or
                compressed by a method that Python does not support.
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
        except RuntimeError as error:  # encrypted, or compressed by a method that Python lacks: Windows's Deflate64
            raise UsageError(
                f"{self.path}: {member} cannot be read: {error}; unpack the file, and give the folder"
            ) from error

    def picture(self, member: str) -> npt.NDArray[np.uint8]:
        """Read a PNG or JPEG as grey values, uint8 [H, W].

        Raises:
            UsageError: as :meth:`open`, or the member is not a picture.
        """
        with self.open(member) as stream:
            data = np.frombuffer(stream.read(), np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
        if pixels is None:
            raise UsageError(f"{self.path}: {member} is not a readable picture")
        return np.asarray(pixels, np.uint8)

    def size(self, member: str) -> SensorSize:
        """Return the size of a picture; raises as :meth:`picture`."""
        height, width = self.picture(member).shape
        return SensorSize(width, height)


def _without_hidden(bytes_of: dict[str, int]) -> dict[str, int]:
    """Drop the ``._name`` files that macOS adds for each file, in zips (under ``__MACOSX``) and on other disks."""
    return {member: size for member, size in bytes_of.items() if not posixpath.basename(member).startswith("._")}
