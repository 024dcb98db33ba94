"""A video of numbered pictures, in a folder or a ZIP archive: ``--videos-kind sequences``.

A picture's name ends with its number; numbers follow each other, from any one on. All pictures have one size and
format. Their times are those of ``timestamps.txt`` or ``images.txt``, beside them or beside their folder: a line for
each picture, with seconds and, if given, its name. Without such a file the rate is unknown.
"""

from __future__ import annotations

import io
import os
import posixpath
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZipFile

import av
import numpy as np
import xxhash
from av.packet import Packet
from av.video.frame import VideoFrame

from v2v_protocol.errors import VideoError
from v2v_protocol.programs import printable
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.labels import frame_of
from v2v_server.store.pixels import IMAGE_SUFFIXES
from v2v_server.store.video_file import VideoFile
from v2v_server.video.decode import Stack
from v2v_server.video.fingerprint import TIMES, files_in, unreadable
from v2v_server.video.frame_index import unseekable
from v2v_server.video.picture import LumaFormat, Orientation
from v2v_server.video.probe import VideoFacts
from v2v_server.video.source import LARGEST_PICTURE_PX, reason

LOOKED_FOR = f"folders and .zip archives of numbered {' '.join(sorted(IMAGE_SUFFIXES))}"
PICTURE_CODECS = {
    b"\x89PNG": "png", b"\xff\xd8\xff": "mjpeg", b"II*\0": "tiff", b"MM\0*": "tiff", b"RIFF": "webp", b"BM": "bmp",
}  # fmt: skip
"""FFmpeg's name of the decoder, by the first bytes of a file."""
ORIENTATION = 0x0112
"""Exif's tag of the orientation."""
_MIRRORED = (2, 4, 5, 7)
"""Orientations that PyAV cannot tell from turned ones."""
LARGEST_PICTURE_FILE_BYTES = 8 * LARGEST_PICTURE_PX + (1 << 20)
"""Most bytes that are read of a file: a picture of the most pixels and 16 bits without compression."""


def id_of(path: str) -> str:
    """Return the id of the sequence that a file belongs to: an archive's own path, or a picture's folder with a slash;
    "" for other files, and for the pictures of a sidecar, such as masks.
    """
    suffix, folder = PurePosixPath(path).suffix.lower(), f"{posixpath.dirname(path)}/"
    is_sidecar = any(ending in folder for ending in sidecar_endings(tuple(ARRAYS)) if ending.endswith("/"))
    return path if suffix == ".zip" else folder if suffix in IMAGE_SUFFIXES and not is_sidecar else ""


class PictureSequence(VideoFile):
    """:class:`v2v_server.store.pixels.Pixels` of numbered pictures.

    Attributes:
        latest_ns: the latest change of status of the files of a folder that were read so far, behind their last byte.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self.ways = (self._frames,)
        self._at: tuple[int | None, str] = None, ""  # frame and file in errors
        self.latest_ns = 0

    def facts(self) -> VideoFacts:
        """Read all files; decode the first picture, and the heads of the others.

        Raises:
            VideoError: a file cannot be read, or differs from the first one in size or format.
        """
        stored, looks = xxhash.xxh3_128(), list[str]()
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for self._at in enumerate(pictures):
                stored.update(data := read(self._at[1]))
                looks.append(_look(data))
                if looks[-1] != looks[0]:
                    raise ValueError(f"is {looks[-1]}, and {pictures[0]} {looks[0]}: give all one size and format")
            self._at = 0, pictures[0]
            head, codec = decode_picture(read(pictures[0]))
            times = self._times(files, pictures, read)
        lies = Orientation.of(head)
        index = unseekable(len(pictures), (1, 1), *lies.size(head.height, head.width), lies)
        if len(times):
            index = index.timed(times)
            stored.update(times.astype("<i8").tobytes())
        return VideoFacts(
            frames=len(index),
            height_px=index.height_px,
            width_px=index.width_px,
            codec=codec,
            pixel_format=head.format.name,
            frames_per_second=(len(times) - 1) * 1e9 / int(times[-1] - times[0]) if len(times) > 1 else float("nan"),
            rotation_degrees=head.rotation,
            full_range=LumaFormat.of(head).full_range,
            index=index,
            content=stored.hexdigest(),
            remark=looks[0].partition("; ")[2],
        )

    def _frames(self, stack: Stack) -> Generator[VideoFrame, None, None]:
        """Decode the pictures of a request, and no other."""
        wanted, index = stack.wanted, stack.wanted.index
        with self._opened() as (files, read):
            pictures = self._pictures(files)
            for frame in range(wanted.start, index.end, wanted.stride):
                self._at = frame, pictures[frame]
                picture, codec = decode_picture(read(pictures[frame]))
                picture.pts = int(index.pts[frame - index.first]) if index.seekable else None
                stack.codec, stack.seen, stack.name = codec, frame, f"{pictures[frame]}: "
                yield picture

    @contextmanager
    def _opened(self) -> Iterator[tuple[list[str], Callable[[str], bytes]]]:
        """Lend the names of all files, and what reads one. Any error becomes one of the current picture.

        Raises:
            VideoError: it is neither a folder nor an archive, or the file that is read is damaged.
            VideoUnreadable: the system reports an error.
        """
        path, self._at = os.fspath(self._path), (None, "")
        is_folder = os.path.isdir(path)
        with errors_of_pictures(path, lambda: self._at), nullcontext() if is_folder else ZipFile(path) as packed:

            def read(name: str) -> bytes:
                with packed.open(name) if packed else Path(path, name).open("rb") as file:
                    # Memory for all bytes that are asked for is allocated first, except by zipfile.
                    size = LARGEST_PICTURE_FILE_BYTES if packed else os.fstat(file.fileno()).st_size
                    data = file.read(min(size, LARGEST_PICTURE_FILE_BYTES))
                    if not packed:
                        self.latest_ns = max(self.latest_ns, os.fstat(file.fileno()).st_ctime_ns)
                    return data

            yield packed.namelist() if packed else [name for name, _ in files_in(path)], read

    def _pictures(self, files: list[str]) -> list[str]:
        """Return the names of the pictures by number, which follow each other."""
        named: dict[str, Any] = {
            name: frame_of(name) for name in files if id_of(name).endswith("/") and "/." not in f"/{name}"
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
        return pictures

    def _times(self, files: list[str], pictures: list[str], read: Callable[[str], bytes]) -> Any:
        """Return the times of the pictures, in nanoseconds; empty without a file of times."""
        places = (posixpath.normpath(posixpath.join(posixpath.dirname(pictures[0]), name)) for name in TIMES)
        self._at = None, next((place for place in places if place in files), "")
        text = read(self._at[1]).decode() if self._at[1] else ""
        lines = [line.split() for line in text.splitlines() if line.partition("#")[0].strip()]
        names = [posixpath.basename(line[1]) for line in lines if len(line) > 1]
        if self._at[1] and (len(lines) != len(pictures) or names not in ([], list(map(posixpath.basename, pictures)))):
            raise ValueError(f"has {len(lines)} lines: give each of the {len(pictures)} pictures one, in their order")
        times = np.rint(1e9 * np.array([line[0] for line in lines], float))
        if not np.all(np.abs(times) < 2**62) or np.any(times[1:] <= times[:-1]):
            raise ValueError("states times that do not increase, or are beyond 4e9 s")
        return times.astype(np.int64)


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


def decode_picture(data: bytes) -> tuple[VideoFrame, str]:
    """Return a decoded picture, and FFmpeg's name of its format."""
    codec = next((codec for magic, codec in PICTURE_CODECS.items() if data.startswith(magic)), "png")
    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.thread_type, decoder.thread_count = "NONE", 1
    # Without "explode" the rest of a truncated JPEG is filled up with grey; with it, some sound TIFF files fail.
    strict = "explode" if codec == "mjpeg" else "crccheck"
    decoder.options = {"max_pixels": str(LARGEST_PICTURE_PX), "err_detect": strict}
    (picture,) = decoder.decode(Packet(data))
    # swscale rounds the grey of a palette to the levels of limited range.
    return picture.reformat(format="rgb24") if picture.format.name == "pal8" else picture, codec


def _look(data: bytes) -> str:
    """Return size and format of a picture, by its head."""
    from PIL import Image  # only a catalogue needs it

    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "WEBP", "BMP")) as picture:
        turned = Image.Image.getexif(picture).get(ORIENTATION, 1)  # that of PNG files would decode the picture
        if turned in _MIRRORED:
            raise ValueError("is mirrored by its Exif orientation: convert it to a plain one")
        transparent = "; its transparency is left out" if picture.has_transparency_data else ""
        form = f"{picture.format} {picture.mode}{f' with Exif orientation {turned}' * (turned != 1)}"
        return f"{picture.width}x{picture.height} px of {form}{transparent}"


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[PictureSequence]:
    """Return the sequence in a folder or archive."""
    return nullcontext(PictureSequence(path))
