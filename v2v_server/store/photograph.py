"""A photograph whose frames are rendered for each sample: ``--videos-kind photographs``.

The catalogue reads its head and hashes its bytes. A worker decodes it once, and renders what the camera of a sample
sees (:mod:`v2v_server.worlds`), with true flow, masks and tracks. Without a sample it stands still.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xxhash

from v2v_server.simulation.intensity import eight_bits
from v2v_server.store.picture_sequence import (
    LARGEST_PICTURE_FILE_BYTES,
    ORIENTATION,
    PICTURE_CODECS,
    decode_picture,
    errors_of_pictures,
)
from v2v_server.store.pixels import IMAGE_SUFFIXES
from v2v_server.video.decode import BIT_EXACT_CODECS, ClipRequest, Cut, DecodedClip, DecodedFrame, DecodedPicture
from v2v_server.video.fingerprint import check_content, check_fingerprint
from v2v_server.video.frame_index import LARGEST_INDEXED_SIDE_PX, FrameIndex, unseekable
from v2v_server.video.picture import SDR, LumaFormat, Orientation, PixelRect, Signal, luma_plane
from v2v_server.video.probe import VideoFacts
from v2v_server.video.source import LARGEST_PICTURE_PX

if TYPE_CHECKING:
    from v2v_server.worlds.render import PhotoPyramid

LOOKED_FOR = " ".join(sorted(IMAGE_SUFFIXES))
_LEAST_SIDE_PX = 16
_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16", "I;16B"})
"""Pillow's names of the pixels that are read: grey, palettes and RGB."""
_UPRIGHT = {
    2: Orientation(flip_x=True), 3: Orientation(flip_y=True, flip_x=True), 4: Orientation(flip_y=True),
    5: Orientation(True), 6: Orientation(True, flip_x=True), 7: Orientation(True, True, True),
    8: Orientation(True, flip_y=True),
}  # fmt: skip
"""What turns a picture upright, by its Exif orientation."""
_ENDS = {"mjpeg": b"\xff\xd9", "png": b"IEND"}
_KEPT_BYTES = 256 << 20
"""Decoded photographs that a worker keeps; one at least."""


def id_of(path: str) -> str:
    """Return the id of the photograph in a file, its path; "" for other files."""
    return path if PurePosixPath(path).suffix.lower() in IMAGE_SUFFIXES else ""


class _Still(NamedTuple):
    """A decoded photograph.

    Attributes:
        grey: [H, W] uint8, its usable rows.
        pyramid: the same in 12 bits, from fine to coarse.
        codec: FFmpeg's name of the format.
    """

    grey: npt.NDArray[np.uint8]
    pyramid: PhotoPyramid
    codec: str


kept_photographs = dict[tuple[Any, ...], _Still]()


class Photograph:
    """:class:`v2v_server.store.pixels.Pixels` of a photograph."""

    is_stored = True

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = os.fspath(path)
        self._fingerprint = ""

    def facts(self) -> VideoFacts:
        """Read the head of the file and hash it. It is one frame, which the catalogue shows for longer."""
        with errors_of_pictures(self._path, lambda: (None, "")):
            return _facts(self._read())

    def check(self, fingerprint: str) -> None:
        """Compare size, head and tail; the rest is compared when it is decoded."""
        self._fingerprint = fingerprint
        check_fingerprint(self._path, fingerprint)

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Render the view of each sample, in 12 bits; without views, return the photograph as it stands, in 8 bits."""
        request.check()
        if not request.views:
            return tuple(self._still(request, cut) for cut in request.cuts)
        from v2v_server.worlds.clip import render_clip  # a catalogue must not load numba

        found, samples = self._decoded(request), zip(request.cuts, request.samples, request.views, strict=True)
        return tuple(
            render_clip(found.pyramid, request.usable[2:], request.seconds(cut), sample, view, found.codec)
            for cut, sample, view in samples
        )

    def _still(self, request: ClipRequest, cut: Cut) -> DecodedClip:
        found = self._decoded(request)
        top, left, height, width = request.window(cut)
        top -= request.usable[0]
        frames = np.repeat(found.grey[None, top : top + height, left : left + width], cut.count, axis=0)
        return DecodedClip(frames, request.seconds(cut), found.codec, found.codec in BIT_EXACT_CODECS)

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the photograph as it stands, in 8 bits."""
        (clip,) = self.clips(request)
        for grey in clip.frames:
            yield DecodedPicture(grey, grey, SDR, clip.codec, clip.bit_exact)

    def _read(self) -> bytes:
        with open(self._path, "rb") as file:
            return file.read(min(os.fstat(file.fileno()).st_size, LARGEST_PICTURE_FILE_BYTES))

    def _decoded(self, request: ClipRequest) -> _Still:
        """Return the photograph of an index, which may be kept.

        Raises:
            VideoChanged: it is not the one that was checked.
            VideoError: it is damaged or differs from the index.
        """
        index = request.index
        with errors_of_pictures(self._path, lambda: (None, "")):
            status = os.stat(self._path)
            key = self._path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, request.rows
            if key not in kept_photographs:
                data = self._read()
                check_content(self._path, xxhash.xxh3_128(data).hexdigest(), self._fingerprint)
                kept_photographs[key] = _decoded(data, index, request.usable)
            found = kept_photographs[key] = kept_photographs.pop(key)  # the latest is the last one
            while (
                len(kept_photographs) > 1
                and sum(each.grey.nbytes + each.pyramid.grey.nbytes for each in kept_photographs.values()) > _KEPT_BYTES
            ):
                del kept_photographs[next(iter(kept_photographs))]
        return found


def _decoded(data: bytes, index: FrameIndex, usable: PixelRect) -> _Still:
    """Decode the usable rows of a photograph.

    Raises:
        ValueError: it has another size than the index.
        av.FFmpegError: it is damaged.
    """
    from v2v_server.worlds.render import pyramid_of

    frame, codec = decode_picture(data)
    luma, lies, size = LumaFormat.of(frame), index.orientation, (index.height_px, index.width_px)
    if (found := lies.size(frame.height, frame.width)) != size:
        raise ValueError(f"has {found[1]}x{found[0]} px, and {size[1]}x{size[0]} px by its head")
    signal = SDR if luma.bits == SDR.bits else Signal(16)
    levels = DecodedFrame(frame, luma_plane(frame, luma), luma, lies, *size, signal, codec).part(usable, signal)
    return _Still(eight_bits(levels, signal), pyramid_of(levels), codec)


def _facts(data: bytes) -> VideoFacts:
    """Return what the head of a file says.

    Raises:
        ValueError: it is of a form that is not read, or truncated.
        OSError: it is no picture.
    """
    from PIL import Image  # only a catalogue needs it

    codec = next((codec for magic, codec in PICTURE_CODECS.items() if data.startswith(magic)), "")
    if not codec:
        raise ValueError("does not begin like a JPEG, PNG, WebP, TIFF or BMP file")
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "WEBP", "BMP")) as picture:
        turned = Image.Image.getexif(picture).get(ORIENTATION, 1)  # that of PNG files would decode the picture
        size, mode, transparent = picture.size, picture.mode, picture.has_transparency_data
        is_animated = picture.format != "MPO" and getattr(picture, "is_animated", False)
    if mode not in _MODES:
        raise ValueError(f"has {mode} pixels: convert it to grey or RGB of 8 or 16 bits")
    if is_animated:
        raise ValueError("has more than one picture: give one, or serve it as a video")
    if min(size) < _LEAST_SIDE_PX or max(size) > LARGEST_INDEXED_SIDE_PX or size[0] * size[1] > LARGEST_PICTURE_PX:
        raise ValueError(
            f"has {size[0]}x{size[1]} px: give sides from {_LEAST_SIDE_PX} to {LARGEST_INDEXED_SIDE_PX} px and at most "
            f"{LARGEST_PICTURE_PX} pixels"
        )
    if _is_truncated(data, codec):
        raise ValueError("is truncated: its end is missing")
    lies = _UPRIGHT.get(turned, Orientation())
    index = unseekable(1, (1, 1), *lies.size(size[1], size[0]), lies)
    return VideoFacts(
        frames=1,
        height_px=index.height_px,
        width_px=index.width_px,
        codec=codec,
        pixel_format=mode,
        frames_per_second=float("nan"),
        rotation_degrees=0,
        full_range=True,
        index=index,
        content=xxhash.xxh3_128(data).hexdigest(),
        remark="its transparency is left out" * transparent,
    )


def _is_truncated(data: bytes, codec: str) -> bool:
    """Return whether a JPEG or PNG file lacks the mark of its end, which data behind it may follow."""
    at = 2
    while codec == "mjpeg" and data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")  # the head, where thumbnails lie
    return data.find(_ENDS.get(codec, b""), at) < 0


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[Photograph]:
    """Return the photograph."""
    return nullcontext(Photograph(path))
