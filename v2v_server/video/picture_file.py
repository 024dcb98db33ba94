"""One picture in a file: its head, its decoder, and a check of what the decoder delivers.

FFmpeg decodes pictures. Of some TIFF files it returns black places, or nothing: tiles, JPEG, Zstandard, LZMA, BigTIFF.
These are Pillow's, where it keeps all bits. Which one decodes is a matter of tags, so every process decides alike.

FFmpeg also decodes damaged pictures without a word. While a catalogue is made, a second reader checks each one:

    JPEG        libjpeg, by OpenCV: it warns of damage on standard error, which Pillow suppresses
    PNG         zlib: the data of all rows is there, and their filters are known
    TIFF, BMP   Pillow, which fails where libtiff does; grey levels are equal (OpenCV returns damaged TIFF pictures)
    WebP        libwebp, by Pillow: FFmpeg fills up what lossy data does not hold
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO, NamedTuple

import av
import numpy as np
from av.packet import Packet
from av.video.frame import VideoFrame

from v2v_server.video.picture import Orientation
from v2v_server.video.source import LARGEST_PICTURE_PX

PICTURE_CODECS = {
    b"\x89PNG": "png", b"\xff\xd8\xff": "mjpeg", b"II*\0": "tiff", b"MM\0*": "tiff", b"II+\0": "tiff",
    b"RIFF": "webp", b"BM": "bmp",
}  # fmt: skip
"""FFmpeg's name of the decoder, by the first bytes of a file."""
LARGEST_PICTURE_FILE_BYTES = 8 * LARGEST_PICTURE_PX + (1 << 20)
"""Most bytes that are read of a file: a picture of the most pixels and 16 bits without compression."""

_UPRIGHT = {
    2: Orientation(flip_x=True), 3: Orientation(flip_y=True, flip_x=True), 4: Orientation(flip_y=True),
    5: Orientation(True), 6: Orientation(True, flip_x=True), 7: Orientation(True, True, True),
    8: Orientation(True, flip_y=True),
}  # fmt: skip
"""What turns a picture upright, by its Exif orientation."""
_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _EXTRA_SAMPLES = 256, 257, 258, 259, 262, 274, 338
_SAMPLE_FORMAT, _UNSIGNED = 339, frozenset({1, 4})
"""Tag of what the numbers of a TIFF picture are, and those that no decoder takes for others: 4 is "not stated"."""
_STRIPS, _TILES = (273, 279), (324, 325)
"""Tags of their places and sizes, bytes."""
_BLACK_IS_ZERO, _PREMULTIPLIED, _BIG_TIFF = 1, 1, b"II+\0"
_FFMPEGS_COMPRESSIONS = frozenset({1, 2, 3, 4, 5, 8, 32773, 32946})
"""None, CCITT, LZW, Deflate and PackBits, by their numbers in TIFF files."""
_JPEGS, _DEFLATES = (6, 7), (8, 32946)
_GREY, _COLOUR, _DEEP = frozenset({"1", "L", "LA"}), frozenset({"P", "RGB", "RGBA"}), frozenset({"I;16", "I;16B"})
_TOLERANCE = 16
"""Difference of grey levels between two readers that comes from rounding: pixels may have 5 bits a colour."""
_DAMAGE = re.compile(
    r"Corrupt JPEG data: (?!\d+ extraneous bytes before marker 0x(c0|c1|c2|db|e.|fe)).*|Premature end.*"
)
"""What libjpeg says of damage. Bytes between the segments of a head spoil no pixel."""
_PNG_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Samples of a pixel, by the type of colour."""
_LAST_PNG_FILTER = 4
_ADAM7 = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
"""First row and column, and steps from row to row and column to column, of each pass of an interlaced PNG picture."""


class PictureHead(NamedTuple):
    """What the head of a file states of its picture.

    Attributes:
        form, mode: Pillow's names of the format and the pixels.
        height_px, width_px: as the decoder delivers it.
        exif: its orientation, 1 to 8; 1 where the decoder turns it upright.
        remark: what is left out; "" if nothing is.
        has_others: whether the file has more pictures.
    """

    form: str
    mode: str
    height_px: int
    width_px: int
    exif: int
    remark: str
    has_others: bool

    def __str__(self) -> str:
        turned = f" with Exif orientation {self.exif}" * (self.exif != 1) + f"; {self.remark}" * bool(self.remark)
        return f"{self.width_px}x{self.height_px} px of {self.form} {self.mode}{turned}"

    def orientation_of(self, frame: VideoFrame) -> Orientation:
        """Compare a decoded picture with this head, and return how it is turned upright.

        Raises:
            ValueError: it has another size.
        """
        if (frame.width, frame.height) != (self.width_px, self.height_px):
            raise ValueError(
                f"has {frame.width}x{frame.height} px, and {self.width_px}x{self.height_px} px by its head"
            )
        # FFmpeg also finds what a PNG file states behind its picture, but only the angle of it is known.
        return _UPRIGHT.get(self.exif, Orientation.turned(frame.rotation))


def codec_of(data: bytes) -> str:
    """Return FFmpeg's name of a picture's format, by its first bytes; "" if it is not read."""
    return next((codec for magic, codec in PICTURE_CODECS.items() if data.startswith(magic)), "")


def read_head(data: bytes) -> PictureHead:
    """Return what the head of a file states.

    Raises:
        OSError: it is no picture.
    """
    from PIL.Image import Image  # most workers need no Pillow

    with _opened(data) as picture:
        (width, height), exif = picture.size, Image.getexif(picture).get(_ORIENTATION, 1)  # PNG's own method decodes
        if picture.format == "TIFF":  # Pillow may state the size of the upright picture
            height, width = picture.tag_v2[_HEIGHT], picture.tag_v2[_WIDTH]
            if _is_left_to_pillow(picture, data):  # which turns it upright
                (height, width), exif = _UPRIGHT.get(exif, Orientation()).size(height, width), 1
        has_others = picture.format != "MPO" and getattr(picture, "is_animated", False)
        left_out = ["its transparency is left out"] * picture.has_transparency_data
        left_out += ["its other pictures are left out"] * has_others
        return PictureHead(str(picture.format), picture.mode, height, width, exif, "; ".join(left_out), has_others)


def decode_picture(data: bytes) -> tuple[VideoFrame, str]:
    """Return a decoded picture, and FFmpeg's name of its format.

    Raises:
        ValueError: it is of a form that neither FFmpeg nor Pillow reads exactly.
        av.FFmpegError, OSError: it is damaged.
    """
    codec = codec_of(data) or "png"
    if codec == "tiff":
        with _opened(data) as picture:
            if not _UNSIGNED.issuperset(formats := picture.tag_v2.get(_SAMPLE_FORMAT, (1,))):
                raise ValueError(
                    f"has numbers of TIFF's sample format {formats[0]}, signed or real: write levels from 0 on"
                )
            if _is_left_to_pillow(picture, data):
                stored = picture.tag_v2.get(_COMPRESSION)
                if (frame := _frame_of(picture)) is None:
                    what = f"has {picture.mode} pixels in a TIFF file in tiles or of compression {stored}"
                    raise ValueError(
                        f"{what}, of which 8 bits a sample and 16 bits of grey are read: write it in strips"
                    )
                return frame, "mjpeg" if stored in _JPEGS else codec
    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.thread_type, decoder.thread_count = "NONE", 1
    # Without "explode" the rest of a truncated JPEG is filled up with grey; with it, some sound TIFF files fail.
    strict = "explode" if codec == "mjpeg" else "crccheck"
    decoder.options = {"max_pixels": str(LARGEST_PICTURE_PX), "err_detect": strict}
    (decoded,) = decoder.decode(Packet(data))
    # swscale rounds the grey of a palette to the levels of limited range.
    return decoded.reformat(format="rgb24") if decoded.format.name == "pal8" else decoded, codec


def check_picture(data: bytes, head: PictureHead) -> None:
    """Compare a picture with what a second reader says of it.

    Raises:
        ValueError: it is damaged, or FFmpeg reads it wrong.
        av.FFmpegError, OSError, zlib.error: it is damaged.
    """
    is_compared = head.form in ("TIFF", "BMP")
    frame, codec = decode_picture(data) if is_compared else (None, codec_of(data))
    if codec == "png":
        check_rows(data)
    with _diverted_stderr() as said:
        if codec == "mjpeg" and (warning := _warning_of_libjpeg(data, head, said)):
            raise ValueError(f"is truncated or damaged: libjpeg says {warning!r}")
        if head.form not in ("TIFF", "BMP", "WEBP"):
            return
        with _opened(data) as picture:
            if head.form == "TIFF" and picture.tag_v2.get(_COMPRESSION) in _DEFLATES:
                spans = (picture.tag_v2[tag] for tag in (_TILES if _TILES[0] in picture.tag_v2 else _STRIPS))
                for at, size in zip(*spans, strict=True):
                    zlib.decompressobj().decompress(data[at : at + size])  # compares the checksum, as libtiff does not
            picture.load()  # libtiff fails where a strip is damaged, libwebp where the coded data ends elsewhere
            other = _frame_of(picture)
    if frame is not None and other is not None:
        levels, expected = (each.reformat(format="gray").to_ndarray().astype(np.int16) for each in (frame, other))
        levels = _UPRIGHT.get(head.exif, Orientation()).upright(levels[None])[0]
        if levels.shape != expected.shape or abs(levels - expected).max() > _TOLERANCE:
            raise ValueError("has other levels in FFmpeg than in Pillow: write it again as PNG")


@contextmanager
def _diverted_stderr() -> Iterator[BinaryIO]:
    """Lend a file that receives what libraries print to standard error until the end of the context."""
    with os.fdopen(os.memfd_create("stderr"), "r+b") as said, os.fdopen(os.dup(2), "wb") as before:
        os.dup2(said.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(before.fileno(), 2)


def _opened(data: bytes) -> Any:
    """Return a picture that Pillow has read the head of."""
    from PIL import Image

    return Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF", "WEBP", "BMP"))


def _is_left_to_pillow(picture: Any, data: bytes) -> bool:
    """Return whether FFmpeg does not decode a TIFF picture."""
    return (
        _TILES[0] in picture.tag_v2
        or data.startswith(_BIG_TIFF)
        or picture.tag_v2.get(_COMPRESSION, 1) not in _FFMPEGS_COMPRESSIONS
    )


def _frame_of(picture: Any) -> VideoFrame | None:
    """Return a picture as Pillow decodes it, upright, grey or RGB; None where Pillow changes its levels."""
    tags = getattr(picture, "tag_v2", {})
    bits = max(tags.get(_BITS, (8,)))
    if picture.mode in _DEEP and (bits, tags.get(_PHOTOMETRIC)) == (16, _BLACK_IS_ZERO):
        return VideoFrame.from_ndarray(np.asarray(picture).astype("<u2"), format="gray16le")
    if picture.mode in _GREY | _COLOUR and bits <= 8 and _PREMULTIPLIED not in tags.get(_EXTRA_SAMPLES, ()):
        mode, form = ("L", "gray") if picture.mode in _GREY else ("RGB", "rgb24")
        return VideoFrame.from_ndarray(np.asarray(picture.convert(mode)), format=form)
    return None


def _warning_of_libjpeg(data: bytes, head: PictureHead, said: BinaryIO) -> str:
    """Return what libjpeg says of damage in a JPEG or TIFF picture; "" if nothing.

    Args:
        said: receives standard error.
    """
    import cv2  # only a catalogue of JPEG pictures needs it

    # An eighth of the size: all data is decoded, and little else is done.
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_8 | cv2.IMREAD_IGNORE_ORIENTATION
    found = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    said.seek(0)
    warning = _DAMAGE.search(said.read().decode(errors="replace"))
    is_cut = found is None and head.form != "TIFF"  # OpenCV does not read all TIFF files
    return warning[0] if warning else "no end of image" * is_cut


def check_rows(data: bytes) -> None:
    """Check that a PNG picture has the data of all its rows, by known filters. Decoders fill the others with anything.

    Raises:
        ValueError: it has not.
        zlib.error: the data is damaged.
    """
    width, height, depth, colour, _, _, is_interlaced = struct.unpack_from(">2I5B", data, 16)
    bits, passes, wanted = depth * _PNG_SAMPLES[colour], list[slice](), 0
    for top, left, down, across in _ADAM7 if is_interlaced else ((0, 0, 1, 1),):
        rows, columns = -((top - height) // down), -((left - width) // across)
        stride, begin = 1 + (columns * bits + 7) // 8, wanted  # each row begins with its filter
        wanted += rows * stride * (columns > 0)
        passes.append(slice(begin, wanted, stride))
    parts, at = list[bytes](), 8
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        parts += [data[at + 8 : at + 8 + length]] * (kind == b"IDAT")
        at += 12 + length
    found = zlib.decompressobj().decompress(b"".join(parts), wanted)
    if len(found) < wanted:
        raise ValueError(f"is truncated or damaged: it has {len(found)} of {wanted} bytes of its rows")
    if (last := max(max(found[rows], default=0) for rows in passes)) > _LAST_PNG_FILTER:
        raise ValueError(f"is damaged: a row has the filter {last}, and PNG has 0 to {_LAST_PNG_FILTER}")
