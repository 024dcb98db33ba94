"""Read a zip file, a folder of files, or a single file through the same interface."""

from __future__ import annotations

import contextlib
import io
import posixpath
import zipfile
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from v2v_protocol.errors import UsageError
from v2v_protocol.programs import name_extra
from v2v_recordings.items import SensorSize

ZIPS = (".zip", ".npz")
MOST_TIMES, ALWAYS_BYTES, LARGEST_PIECE = 256, 1 << 24, 1 << 29
"""What a file states of its content may take this many times the file's size, or ALWAYS_BYTES; a piece of it that is
unpacked at once, at most LARGEST_PIECE as well. Event data and pictures pack to a hundredth at best.
"""


class Archive(contextlib.AbstractContextManager["Archive"]):
    """Give access to the members of a zip file or folder by their paths, with / as separator.

    Any other file is its own only member. The ``._name`` files that macOS adds for each file, in zips and on other
    disks, are no members.

    Attributes:
        folder: where the members are, unless they are in a zip file.
        is_single: whether the path is the only member.
        bytes_of: size of each member by its path.

    Raises:
        UsageError: the path is neither a folder nor a complete zip file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder, self._zip = path, None
        self.is_single = path.is_file() and path.suffix.lower() not in ZIPS and not zipfile.is_zipfile(path)
        if path.is_dir():
            files = sorted(file for file in path.rglob("*") if file.is_file())
            found = {file.relative_to(path).as_posix(): file.stat().st_size for file in files}
        elif self.is_single:
            self.folder, found = path.parent, {path.name: path.stat().st_size}
        else:
            try:
                self._zip = zipfile.ZipFile(path)
            except (OSError, zipfile.BadZipFile) as error:
                raise UsageError(
                    f"{path} is neither a folder nor a complete zip file: {error}; if it was cut, download it again"
                ) from error
            found = {entry.filename: entry.file_size for entry in self._zip.infolist() if not entry.is_dir()}
        self.bytes_of = {name: size for name, size in found.items() if not posixpath.basename(name).startswith("._")}

    def __exit__(self, *_: object) -> None:
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

    def where(self, member: str) -> str:
        """Return the name of a member for messages."""
        return str(self.path) if self.is_single else f"{self.path}: {member}"

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
            raise UsageError(f"{self.where(member)} holds text that is not a number: {error}") from None

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
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"{self.where(member)} cannot be read: {reason}") from error

    def _open(self, member: str) -> IO[bytes]:
        if self._zip is None:
            return (self.folder / member).open("rb")
        check_stated_bytes(self.bytes_of[member], self.path, self.where(member))
        try:
            return self._zip.open(member)
        except RuntimeError as error:  # encrypted, or compressed by a method that Python lacks: Windows's Deflate64
            raise UsageError(
                f"{self.where(member)} cannot be read: {error}; unpack the file, and give the folder"
            ) from error

    def picture(self, member: str) -> npt.NDArray[np.uint8]:
        """Read a PNG or JPEG as grey values, uint8 [H, W].

        Raises:
            UsageError: as :meth:`open`, or the member is not a picture.
        """
        with self.open(member) as stream:
            data, pixels = stream.read(), None
        with contextlib.suppress(OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            # This reads the head only.
            SensorSize(*Image.open(io.BytesIO(data)).size).require_usable(self.where(member))
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise UsageError(f"{self.where(member)} is not a readable picture")
        return np.asarray(pixels, np.uint8)

    def size(self, member: str) -> SensorSize:
        """Return the size of a picture; raises as :meth:`picture`."""
        height, width = self.picture(member).shape
        return SensorSize(width, height)


def check_stated_bytes(stated: int, path: Path, what: str, *, is_piece: bool = False) -> None:
    """Check the size that a file states for something in it, before memory is taken for it.

    Args:
        stated: bytes.
        path: the file.
        what: beginning of the error message.
        is_piece: whether it is unpacked at once, as a chunk of HDF5 is.

    Raises:
        UsageError: it is larger than MOST_TIMES the file and ALWAYS_BYTES, or than LARGEST_PIECE.
    """
    most = min(max(MOST_TIMES * path.stat().st_size, ALWAYS_BYTES), LARGEST_PIECE if is_piece else stated)
    if stated > most:
        raise UsageError(
            f"{what} is stated to be {stated:,} bytes, and at most {most:,} are read of this file: it is damaged, or "
            "not a recording"
        )


def package(name: str, what: str) -> Any:
    """Import a package that only some forms need.

    Args:
        name: of the module.
        what: needs it, for the error message.

    Raises:
        UsageError: it is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise UsageError(name_extra(what, name, "convert")) from error


def holds(path: Path, check: Callable[[Archive], Any], suffix: str = ".zip") -> bool:
    """Return whether the path is a folder, or a file with this suffix, whose members pass a check."""
    if not (path.is_dir() or (path.is_file() and path.suffix.lower() == suffix)):
        return False
    with Archive(path) as archive:
        return bool(check(archive))


def starts_with(path: Path, magic: bytes) -> bool:
    """Return whether the path is a file that starts with these bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(magic)) == magic
