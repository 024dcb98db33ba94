"""A video of numbered pictures, in a folder or a ZIP archive: ``--videos-kind sequences``.

A picture's name ends with its number; numbers follow each other, from any one on. All pictures have one size and
format. Their times are those of ``timestamps.txt`` or ``images.txt``, beside them or beside their folder: a line for
each picture, with seconds and, if given, its name. Without such a file the rate is unknown.
"""

from __future__ import annotations

import io
import os
import posixpath
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZipFile

import av
import numpy as np
import numpy.typing as npt
import xxhash
from av.packet import Packet
from av.video.frame import VideoFrame

from v2v_protocol.errors import VideoError
from v2v_protocol.programs import printable
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.labels.formats import frame_of
from v2v_server.store.video_file import VideoFile
from v2v_server.video.collect import Stack
from v2v_server.video.decode import Way
from v2v_server.video.fingerprint import TIMES, files_in, unreadable
from v2v_server.video.frame_index import unseekable
from v2v_server.video.luma import LumaFormat
from v2v_server.video.orientation import Orientation
from v2v_server.video.probe import VideoFacts, average_rate
from v2v_server.video.source import LARGEST_PICTURE_PX, reason

_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
LOOKED_FOR = f"folders and .zip archives of numbered {' '.join(sorted(_SUFFIXES))}"
_CODECS = {
    b"\x89PNG": "png", b"\xff\xd8\xff": "mjpeg", b"II*\0": "tiff", b"MM\0*": "tiff", b"RIFF": "webp", b"BM": "bmp",
}  # fmt: skip
"""FFmpeg's name of the decoder, by the first bytes of a file."""
_LARGEST_FILE_BYTES = 8 * LARGEST_PICTURE_PX + (1 << 20)
"""Most bytes that are read of a file: a picture of the most pixels and 16 bits without compression."""
_MOST_SECONDS = 2.0**33


def id_of(path: str) -> str:
    """Return the id of the sequence that a file belongs to: an archive's own path, or a picture's folder with a slash;
    "" for other files, and for the pictures of a sidecar, such as masks.
    """
    suffix, folder = PurePosixPath(path).suffix.lower(), f"{posixpath.dirname(path)}/"
    if suffix == ".zip":
        return path
    folders = tuple(ending for ending in sidecar_endings(tuple(ARRAYS)) if ending.endswith("/"))
    return folder if suffix in _SUFFIXES and not any(ending in folder for ending in folders) else ""


class PictureSequence(VideoFile):
    """:class:`v2v_server.store.pixels.Pixels` of numbered pictures."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self.ways: Sequence[Way] = (self._frames,)
        self._frame: int | None = None  # with the name of its file in errors
        self._name = ""

    def facts(self) -> VideoFacts:
        """Read all files; decode the first picture, and the heads of the others."""
        stored, looks = xxhash.xxh3_128(), list[str]()
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for self._frame, self._name in enumerate(pictures):
                data = read(self._name)
                stored.update(b"%d;" % len(data) + data)
                looks = [*looks[:1], _look(data)]
                if looks[-1] != looks[0]:
                    raise ValueError(f"is {looks[-1]}, and {pictures[0]} {looks[0]}: give all one size and format")
                if not self._frame:
                    head, codec = _decoded(data)
            times = self._times(files, pictures, read)
        lies = Orientation.of(head)
        height, width = lies.size(head.height, head.width)
        index = unseekable(len(pictures), (1, 1), height, width, lies)
        if times is not None:
            index = index.timed(times, (1, 10**9))
            stored.update(times.astype("<i8").tobytes())
        return VideoFacts(
            frames=len(index),
            height_px=height,
            width_px=width,
            codec=codec,
            pixel_format=head.format.name,
            frames_per_second=average_rate(index),
            rotation_degrees=head.rotation,
            full_range=LumaFormat.of(head).full_range,
            index=index,
            content=stored.hexdigest(),
            remark=looks[0].partition("; ")[2],
        )

    def _frames(self, stack: Stack) -> Iterator[VideoFrame]:
        """Decode the pictures of a request, and no other."""
        wanted, index = stack.wanted, stack.wanted.index
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for self._frame in range(wanted.start, index.end, wanted.stride):
                self._name = pictures[self._frame]
                picture, codec = _decoded(read(self._name))
                if Orientation.of(picture) != index.orientation or codec != (stack.codec or codec):
                    raise ValueError("has another format than the pictures before it, or is turned another way")
                picture.pts = int(index.pts[self._frame - index.first]) if index.seekable else None
                stack.codec, stack.seen, stack.name = codec, self._frame, f"{self._name}: "
                yield picture

    @contextmanager
    def _opened(self) -> Iterator[tuple[list[str], Callable[[str], bytes]]]:
        """Lend the names of all files, and what reads one. Errors name the current picture.

        Raises:
            VideoError: it is neither a folder nor an archive, or the file that is read is damaged.
            VideoUnreadable: the system reports an error.
        """
        path, self._frame, self._name = os.fspath(self._path), None, ""
        try:
            with nullcontext() if os.path.isdir(path) else ZipFile(path) as packed:

                def read(name: str) -> bytes:
                    with packed.open(name) if packed else Path(path, name).open("rb") as file:
                        return file.read(_LARGEST_FILE_BYTES)

                yield packed.namelist() if packed else [name for name, _ in files_in(path)], read
        except VideoError:
            raise
        except Exception as error:  # zipfile and Pillow have no common class of them
            if isinstance(error, OSError) and error.errno and not isinstance(error, av.FFmpegError):
                raise unreadable(path, error) from error
            raise VideoError(path, self._frame, f"{printable(self._name)}: {reason(error)}".strip(": ")) from error

    def _pictures(self, files: list[str]) -> list[str]:
        """Return the names of the pictures by number, which follow each other."""
        named = {name: frame_of(name) for name in files if id_of(name).endswith("/") and "/." not in f"/{name}"}
        if len(folders := {posixpath.dirname(name) for name in named}) != 1:
            raise ValueError(
                f"holds pictures in {len(folders)} folders, not in one: {', '.join(sorted(folders))[:200]}"
            )
        for self._name, number in named.items():
            if number is None or printable(self._name) != self._name:
                raise ValueError("no number ends its name: rename it, or move it away")
        pictures = sorted(named, key=lambda name: (named[name], name))
        for self._frame, self._name in enumerate(pictures):
            if (missing := named[pictures[0]] + self._frame) != named[self._name]:
                before = pictures[self._frame - 1]
                raise ValueError(f"follows {before}, and number {missing} is missing: number them one after the other")
        return pictures

    def _times(
        self, files: list[str], pictures: list[str], read: Callable[[str], bytes]
    ) -> npt.NDArray[np.int64] | None:
        """Return the times of the pictures, in nanoseconds; None without a file of times."""
        places = (posixpath.normpath(posixpath.join(posixpath.dirname(pictures[0]), name)) for name in TIMES)
        self._frame, self._name = None, next((place for place in places if place in files), "")
        if not self._name:
            return None
        lines = [line.split() for line in read(self._name).decode().splitlines() if line.partition("#")[0].strip()]
        if len(lines) != len(pictures):
            raise ValueError(f"states {len(lines)} times for {len(pictures)} pictures: give each picture a line")
        for (_, *named), picture in zip(lines, pictures, strict=True):
            if named and posixpath.basename(named[0]) != posixpath.basename(picture):
                raise ValueError(f"names {named[0]:.80} in the place of {picture}")
        seconds = np.array([line[0] for line in lines], float)
        times = np.rint(seconds * 1e9).astype(np.int64) if np.all(np.abs(seconds) < _MOST_SECONDS) else seconds[:0]
        if len(times) < len(lines) or np.any(times[1:] <= times[:-1]):
            raise ValueError(f"states times that do not increase, or lie beyond {_MOST_SECONDS:.0f} s")
        return times


def _decoded(data: bytes) -> tuple[VideoFrame, str]:
    """Return a decoded picture, and FFmpeg's name of its format."""
    codec = next((codec for magic, codec in _CODECS.items() if data.startswith(magic)), "png")
    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.thread_type, decoder.thread_count = "NONE", 1
    # Without "explode" a truncated JPEG is filled up with grey.
    strict = {"err_detect": "explode"} if codec == "mjpeg" else {}
    decoder.options = {"max_pixels": str(LARGEST_PICTURE_PX), **strict}
    (picture,) = decoder.decode(Packet(data))
    # swscale rounds the grey of a palette to the levels of limited range.
    return picture.reformat(format="rgb24") if picture.format.name == "pal8" else picture, codec


def _look(data: bytes) -> str:
    """Return size and format of a picture, by its head."""
    from PIL import Image  # only a catalogue needs it

    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "WEBP", "BMP")) as picture:
        transparent = "; its transparency is left out" if picture.has_transparency_data else ""
        return f"{picture.width}x{picture.height} px of {picture.format} {picture.mode}{transparent}"


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[PictureSequence]:
    """Return the sequence in a folder or archive."""
    return nullcontext(PictureSequence(path))
