"""A video of numbered pictures, in a folder or a ZIP archive: ``--videos-kind sequences``.

A picture's name ends with its number; numbers follow each other, from any one on. All pictures have one size and
format. Their times are those of ``timestamps.txt`` or ``images.txt`` (:mod:`v2v_recordings.time_stamps`), beside them
or beside their folder. Without such a file the rate is unknown.
"""

from __future__ import annotations

import os
import posixpath
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZipFile

import av
import numpy as np
import numpy.typing as npt
import xxhash
from av.video.frame import VideoFrame

from v2v_protocol.errors import VideoChanged, VideoError
from v2v_protocol.programs import printable
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_recordings.time_stamps import read_times
from v2v_server.labels import frame_of
from v2v_server.store.pixels import IMAGE_SUFFIXES
from v2v_server.store.video_file import VideoFile
from v2v_server.video.decode import Stack
from v2v_server.video.fingerprint import (
    TIMES,
    check_fingerprint,
    file_state,
    files_in,
    fingerprint_of,
    times_above,
    unreadable,
)
from v2v_server.video.frame_index import unseekable
from v2v_server.video.picture import LumaFormat, Orientation
from v2v_server.video.picture_file import (
    LARGEST_PICTURE_FILE_BYTES,
    PictureHead,
    check_picture,
    decode_picture,
    read_head,
)
from v2v_server.video.probe import VideoFacts
from v2v_server.video.source import reason

_SIDECAR_FOLDERS = tuple(ending for ending in sidecar_endings(tuple(ARRAYS)) if ending.endswith("/"))
_LOOKED_AT = 16
"""Pictures of 16 bits of which the highest level is looked for."""
_KEPT_FILES, _SETTLED_NS = 1 << 20, 2 * 10**9
"""Files of the listings that a process keeps, of one at least; and age of a state at which it is believed."""


@dataclass(slots=True)
class Files:
    """What a folder or archive holds.

    Attributes:
        states: of itself, and of the files of times above a folder.
        sizes: bytes of each file, by name.
        fingerprint: of a folder, see :mod:`v2v_server.video.fingerprint`; "" of an archive.
        packed: the archive, whose file is closed; None of a folder.
        pictures: names of the pictures by number, once they were asked for.
    """

    states: list[tuple[int, int, int, int]]
    sizes: dict[str, int]
    fingerprint: str = ""
    packed: ZipFile | None = None
    pictures: list[str] = field(default_factory=list)


_kept = dict[str, Files]()


def is_picture(path: str) -> bool:
    """Return whether a file is a picture, and not that of a sidecar, such as masks."""
    is_sidecar = any(ending in f"{posixpath.dirname(path)}/" for ending in _SIDECAR_FOLDERS)
    return PurePosixPath(path).suffix.lower() in IMAGE_SUFFIXES and not is_sidecar


class PictureSequence(VideoFile):
    """:class:`v2v_server.store.pixels.Pixels` of numbered pictures, which are listed once a change.

    Attributes:
        latest_ns: the latest change of status of the files of a folder that were read so far, behind their last byte.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self.ways = (self._frames,)
        self._at: tuple[int | None, str] = None, ""  # frame and file in errors
        self.latest_ns = 0

    def check(self, fingerprint: str) -> None:
        """Compare a folder's names and sizes, as listed when it last changed; an archive's size, head and tail.

        A picture that changed since then is noticed when it is read.
        """
        with self._opened() as (files, _):
            check_fingerprint(self._path, fingerprint, files.fingerprint)

    def facts(self) -> VideoFacts:
        """List, read and check all files, and decode the first picture.

        Raises:
            VideoError: a file cannot be read, is damaged, or differs from the first one in size or format.
        """
        stored, heads, highest = xxhash.xxh3_128(), list[PictureHead](), -1
        _kept.pop(os.fspath(self._path), None)
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for self._at in enumerate(pictures):
                stored.update(data := read(self._at[1]))
                heads.append(read_head(data))
                if heads[-1] != heads[0]:
                    raise ValueError(f"is {heads[-1]}, and {pictures[0]} {heads[0]}: give all one size and format")
                check_picture(data, heads[0])
            self._at = 0, pictures[0]
            frame, codec = decode_picture(read(pictures[0]))
            if levels_of(frame):
                for at in sorted(set(np.linspace(0, len(pictures) - 1, _LOOKED_AT, dtype=int).tolist())):
                    self._at = at, pictures[at]
                    levels = levels_of(decode_picture(read(pictures[at]))[0])
                    highest = max(highest, *(int(each.max()) for each in levels))
            if (lies := heads[0].orientation_of(frame)) != Orientation.turned(frame.rotation):
                stored.update(f"{lies};".encode())  # under the name without it, FFmpeg's orientation was applied
            times, remark = self._times(files, pictures, read)
        index = unseekable(len(pictures), (1, 1), *lies.size(frame.height, frame.width), lies)
        if len(times):
            index = index.timed(times)
            stored.update(times.astype("<i8").tobytes())
        return VideoFacts(
            frames=len(index),
            height_px=index.height_px,
            width_px=index.width_px,
            codec=codec,
            pixel_format=frame.format.name,
            frames_per_second=(len(times) - 1) * 1e9 / int(times[-1] - times[0]) if len(times) > 1 else float("nan"),
            rotation_degrees=frame.rotation,
            full_range=LumaFormat.of(frame).full_range,
            index=index,
            content=stored.hexdigest(),
            remark="; ".join(filter(None, (heads[0].remark, remark))),
            highest_level=highest,
        )

    def _frames(self, stack: Stack) -> Generator[VideoFrame, None, None]:
        """Decode the pictures of a request, and no other."""
        wanted, index = stack.wanted, stack.wanted.index
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for frame in range(wanted.start, index.end, wanted.stride):
                self._at = frame, pictures[frame]
                picture, codec = decode_picture(read(pictures[frame]))
                stretch_levels(picture, index.bits)
                picture.pts = int(index.pts[frame - index.first]) if index.seekable else None
                stack.codec, stack.seen, stack.name = codec, frame, f"{pictures[frame]}: "
                yield picture

    @contextmanager
    def _opened(self) -> Iterator[tuple[Files, Callable[[str], bytes]]]:
        """Lend the files, and what reads one. Any error becomes one of the current picture.

        Raises:
            VideoError: it is neither a folder nor an archive, or the file that is read is damaged.
            VideoChanged: the file that is read has another size than listed.
            VideoUnreadable: the system reports an error.
        """
        path, self._at = os.fspath(self._path), (None, "")
        with errors_of_pictures(path, lambda: self._at):
            files = list_files(path)
            with open(path, "rb") if files.packed else nullcontext() as archive:
                if packed := copy(files.packed):
                    packed.fp = archive  # to open it by its path would read its directory again

                def read(name: str) -> bytes:
                    with packed.open(name) if packed else Path(path, name).open("rb") as file:
                        # Memory for all bytes that are asked for is allocated first, except by zipfile.
                        size = LARGEST_PICTURE_FILE_BYTES if packed else os.fstat(file.fileno()).st_size
                        if packed is None and size != files.sizes[name]:
                            _kept.pop(path, None)
                            why = f"{name}: changed while it is served: {size} bytes instead of {files.sizes[name]}"
                            raise VideoChanged(path, self._at[0], why)
                        data = file.read(min(size, LARGEST_PICTURE_FILE_BYTES))
                        if not packed:
                            self.latest_ns = max(self.latest_ns, os.fstat(file.fileno()).st_ctime_ns)
                        return data

                yield files, read

    def _pictures(self, files: Files) -> list[str]:
        """Return the names of the pictures by number, which follow each other."""
        if files.pictures:
            return files.pictures
        named: dict[str, Any] = {
            name: frame_of(name) for name in files.sizes if is_picture(name) and "/." not in f"/{name}"
        }
        if len(folders := {posixpath.dirname(name) for name in named}) != 1:
            raise ValueError(
                f"holds pictures in {len(folders)} folders, not in one: {', '.join(sorted(folders))[:200]}"
            )
        pictures = sorted(named, key=lambda name: (-1 if named[name] is None else named[name], name))
        for frame, name in enumerate(pictures):
            if named[name] is None or named[name] - named[pictures[0]] != frame or printable(name) != name:
                self._at = frame, name
                after = f"is not the next one after {pictures[frame - 1]}" if frame else "has no number"
                raise ValueError(f"{after}: end all names with numbers that follow each other, in printable text")
        files.pictures = pictures
        return pictures

    def _times(self, files: Files, pictures: list[str], read: Callable[[str], bytes]) -> tuple[Any, str]:
        """Return the times of the pictures, in nanoseconds, and what was assumed of them; empty without a file."""
        places = (posixpath.normpath(posixpath.join(posixpath.dirname(pictures[0]), name)) for name in TIMES)
        self._at = None, next((place for place in places if place in files.sizes), "")
        if not self._at[1]:
            return np.empty(0, np.int64), ""
        times, names, remark = read_times(read(self._at[1]))
        found, there = (
            [posixpath.basename(name.replace("\\", "/")) for name in names],
            list(map(posixpath.basename, pictures)),
        )
        if len(times) != len(pictures) or found not in ([], there):
            first = next(iter(sorted(set(there).difference(found or there))), "")
            why = f"states times of {len(times)} pictures{f'; {first} has none' * bool(first)}"
            raise ValueError(f"{why}: give each of the {len(pictures)} pictures one, in their order")
        return times, remark and f"{self._at[1]}: {remark}"


@contextmanager
def errors_of_pictures(path: str, at: Callable[[], tuple[int | None, str]]) -> Iterator[None]:
    """Turn any error of the system, a decoder or a check into one of a video, until the end of the context.

    Args:
        path: of the video.
        at: returns the current frame, and the name of its picture in the video.

    Raises:
        VideoError: a picture is damaged, or not of a form that is read.
        VideoUnreadable: the system reports an error.
    """
    try:
        yield
    except VideoError:
        raise
    except Exception as error:  # zipfile and Pillow have no common class of them
        if isinstance(error, OSError) and error.errno and not isinstance(error, av.FFmpegError):
            raise unreadable(path, error) from error
        frame, name = at()
        why = "is damaged, or of a format that is not read" if isinstance(error, OSError) else reason(error)
        raise VideoError(path, frame, f"{printable(name)}: {why}".removeprefix(": ")) from None


def list_files(path: str) -> Files:
    """List a folder or archive; while its state stays the same, return what was listed.

    The clock of a file system has steps. A change right behind another one may not show in the state, so that the
    listing of a folder that has just changed is not kept.

    Raises:
        OSError, BadZipFile: it cannot be read.
    """
    states = [file_state(each) for each in (os.stat(path), *(each for _, each in times_above(path)))]
    files, now = _kept.pop(path, None), time.time_ns()
    if (files is None or files.states != states) and os.path.isdir(path):
        sizes = {name: status.st_size for name, status in files_in(path)}
        files = Files(states, sizes, fingerprint_of(sizes))
    elif files is None or files.states != states:
        with open(path, "rb") as archive:
            packed = ZipFile(archive)
        files = Files(states, {each.filename: each.file_size for each in packed.infolist()}, packed=packed)
    if now - max(max(modified, changed) for _, modified, changed, _ in states) > _SETTLED_NS:
        _kept[path] = files  # the latest is the last one
    while len(_kept) > 1 and sum(len(each.sizes) for each in _kept.values()) > _KEPT_FILES:
        del _kept[next(iter(_kept))]
    return files


def levels_of(picture: VideoFrame) -> list[npt.NDArray[np.uint16]]:
    """Return the levels of each plane of a picture of 16 bits, [h, w, channels], in the picture's memory; without its
    transparency. Other pictures have none.
    """
    form, channels = picture.format, picture.format.components
    if channels[0].bits != 16:
        return []
    opaque, each = sum(not channel.is_alpha for channel in channels), len(channels) // len(picture.planes)
    size, sample = (picture.height, picture.width, each), np.dtype(">u2" if form.is_big_endian else "<u2")
    return [
        np.ndarray(size, sample, plane, strides=(plane.line_size, 2 * each, 2))[..., :opaque]  # type: ignore[arg-type]
        for plane in picture.planes[:opaque]
    ]


def stretch_levels(picture: VideoFrame, bits: int) -> None:
    """Stretch the levels of a picture of 16 bits that hold fewer, in place; 0 bits and other pictures stay as they are.

    Raises:
        ValueError: a level needs more bits.
    """
    for levels in levels_of(picture) if bits else ():
        white = (1 << bits) - 1
        if (highest := int(levels.max())) > white:
            raise ValueError(f"has a level of {highest}, beyond {white}, the highest of --picture-bits {bits}")
        levels[...] = ((levels.astype(np.uint32) * 65535 + white // 2) // white).astype(np.uint16)


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[PictureSequence]:
    """Return the sequence in a folder or archive."""
    return nullcontext(PictureSequence(path))
