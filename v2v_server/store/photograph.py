"""A photograph whose frames are rendered for each sample: ``--videos-kind photographs``.

The catalogue checks it and hashes its bytes. A worker decodes it once, and renders what the camera of a sample
sees (:mod:`v2v_server.worlds`), with true flow, masks and tracks. Without a sample it stands still.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xxhash

from v2v_server.simulation.intensity import eight_bits
from v2v_server.store.picture_sequence import errors_of_pictures
from v2v_server.video.decode import BIT_EXACT_CODECS, ClipRequest, Cut, DecodedClip, DecodedFrame, DecodedPicture
from v2v_server.video.fingerprint import check_content, check_fingerprint
from v2v_server.video.frame_index import LARGEST_INDEXED_SIDE_PX, FrameIndex, unseekable
from v2v_server.video.picture import MOST_BITS, SDR, LumaFormat, PixelRect, Signal, luma_plane
from v2v_server.video.picture_file import (
    LARGEST_PICTURE_FILE_BYTES,
    check_picture,
    codec_of,
    decode_picture,
    read_head,
)
from v2v_server.video.probe import VideoFacts
from v2v_server.video.source import LARGEST_PICTURE_PX

if TYPE_CHECKING:
    from v2v_server.worlds.render import PhotoPyramid

_LEAST_SIDE_PX = 16
_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16", "I;16B"})
"""Pillow's names of the pixels that are read: grey, palettes and RGB."""
_KEPT_BYTES = 256 << 20
"""Decoded photographs that a worker keeps; one at least."""


class _Still(NamedTuple):
    """A decoded photograph.

    Attributes:
        grey: [H, W] uint8, its usable rows.
        pyramid: the same in the bits that a world is rendered in, from fine to coarse.
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
        """Check the file and hash it. It is one frame, which the catalogue shows for longer."""
        with errors_of_pictures(self._path, lambda: (None, "")):
            return _facts(self._read())

    def check(self, fingerprint: str) -> None:
        """Compare size, head and tail; the rest is compared when it is decoded."""
        self._fingerprint = fingerprint
        check_fingerprint(self._path, fingerprint)

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Render the view of each sample; without views, return the photograph as it stands, in 8 bits."""
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
        index, bits = request.index, request.views[0].spec.recipe.world_bits if request.views else MOST_BITS
        with errors_of_pictures(self._path, lambda: (None, "")):
            status = os.stat(self._path)
            key = self._path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, request.rows, bits
            if key not in kept_photographs:
                data = self._read()
                check_content(self._path, xxhash.xxh3_128(data).hexdigest(), self._fingerprint)
                kept_photographs[key] = _decoded(data, index, request.usable, bits)
            found = kept_photographs[key] = kept_photographs.pop(key)  # the latest is the last one
            while (
                len(kept_photographs) > 1
                and sum(each.grey.nbytes + each.pyramid.grey.nbytes for each in kept_photographs.values()) > _KEPT_BYTES
            ):
                del kept_photographs[next(iter(kept_photographs))]
        return found


def _decoded(data: bytes, index: FrameIndex, usable: PixelRect, bits: int) -> _Still:
    """Decode the usable rows of a photograph; its pyramid has ``bits``.

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
    return _Still(eight_bits(levels, signal), pyramid_of(levels, bits), codec)


def _facts(data: bytes) -> VideoFacts:
    """Return what a file holds.

    Raises:
        ValueError: it is of a form that is not read, or damaged.
        OSError: it is no picture.
    """
    if not codec_of(data):
        raise ValueError("does not begin like a JPEG, PNG, WebP, TIFF or BMP file")
    head = read_head(data)
    if head.mode not in _MODES:
        raise ValueError(f"has {head.mode} pixels: convert it to grey or RGB of 8 or 16 bits")
    if head.has_others:
        raise ValueError("has more than one picture: give one, or serve it as a video")
    width, height = head.width_px, head.height_px
    if (
        not _LEAST_SIDE_PX <= min(width, height) <= max(width, height) <= LARGEST_INDEXED_SIDE_PX
        or width * height > LARGEST_PICTURE_PX
    ):
        raise ValueError(
            f"has {width}x{height} px: give sides from {_LEAST_SIDE_PX} to {LARGEST_INDEXED_SIDE_PX} px and at most "
            f"{LARGEST_PICTURE_PX} pixels"
        )
    check_picture(data, head)
    frame, codec = decode_picture(data)
    lies = head.orientation_of(frame)
    index = unseekable(1, (1, 1), *lies.size(height, width), lies)
    return VideoFacts(
        frames=1,
        height_px=index.height_px,
        width_px=index.width_px,
        codec=codec,
        pixel_format=head.mode,
        frames_per_second=float("nan"),
        rotation_degrees=0,
        full_range=True,
        index=index,
        content=xxhash.xxh3_128(data).hexdigest(),
        remark=head.remark,
    )


def open_pixels(path: str | os.PathLike[str]) -> AbstractContextManager[Photograph]:
    """Return the photograph."""
    return nullcontext(Photograph(path))
