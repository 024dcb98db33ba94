"""Picture files as libraries do not write them: tiles, BigTIFF, interlaced PNG, rows that are missing."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from PIL import Image

SHORT, LONG = 3, 4
"""Types of a TIFF tag's values."""


def tiff(pixels: npt.NDArray[Any], tile: int = 0, big: bool = False, **changed: int) -> bytes:
    """Return an uncompressed TIFF file in one strip or in square tiles.

    Args:
        pixels: [H, W] or [H, W, samples], uint8 or uint16.
        tile: side of a tile; 0 writes a strip.
        big: write BigTIFF.
        changed: values of further tags, by "t" and their numbers.
    """
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    (height, width, samples), bits = pixels.shape, 8 * pixels.itemsize
    if tile:
        padded = np.zeros((-(-height // tile) * tile, -(-width // tile) * tile, samples), pixels.dtype)
        padded[:height, :width] = pixels
        corners = [(y, x) for y in range(0, len(padded), tile) for x in range(0, padded.shape[1], tile)]
        parts = [padded[y : y + tile, x : x + tile].tobytes() for y, x in corners]
        layout = {322: (LONG, [tile]), 323: (LONG, [tile])}
    else:
        parts, layout = [pixels.tobytes()], {278: (LONG, [height])}
    at = 16
    places = [at + sum(map(len, parts[:number])) for number in range(len(parts))]
    tags = layout | {
        256: (LONG, [width]), 257: (LONG, [height]), 258: (SHORT, [bits] * samples), 259: (SHORT, [1]),
        262: (SHORT, [2 if samples > 2 else 1]), 277: (SHORT, [samples]), 324 if tile else 273: (LONG, places),
        325 if tile else 279: (LONG, list(map(len, parts))), **({338: (SHORT, [2])} if samples == 4 else {}),
    } | {int(tag[1:]): (SHORT, [value]) for tag, value in changed.items()}  # fmt: skip
    data = b"".join(parts)
    data += bytes(-len(data) % 8)
    entries, more, inline = b"", b"", 8 if big else 4
    behind = at + len(data) + (16 + 20 * len(tags) if big else 6 + 12 * len(tags))
    for tag, (kind, values) in sorted(tags.items()):
        packed = struct.pack(f"<{len(values)}{'HI'[kind == LONG]}", *values)
        if len(packed) > inline:
            place, more = behind + len(more), more + packed + bytes(len(packed) % 2)
            packed = struct.pack("<Q" if big else "<I", place)
        entries += struct.pack("<HHQ" if big else "<HHI", tag, kind, len(values)) + packed.ljust(inline, b"\0")
    count, end = (struct.pack("<Q", len(tags)), bytes(8)) if big else (struct.pack("<H", len(tags)), bytes(4))
    first = (
        struct.pack("<2sHHHQ", b"II", 43, 8, 0, at + len(data))
        if big
        else struct.pack("<2sHI8x", b"II", 42, at + len(data))
    )
    return first + data + count + entries + end + more


def encoded(pixels: npt.NDArray[Any] | Image.Image, form: str, **options: Any) -> bytes:
    file = io.BytesIO()
    picture = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    picture.save(file, form, **options)
    return file.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_parts(data: bytes) -> list[tuple[bytes, bytes]]:
    at, parts = 8, []
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        parts.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return parts


def shortened(data: bytes, kept: Callable[[int], int]) -> bytes:
    """Return a PNG file with right checksums and fewer bytes of its rows."""
    parts = png_parts(data)
    rows = zlib.decompress(b"".join(content for kind, content in parts if kind == b"IDAT"))
    parts = [part for part in parts if part[0] != b"IDAT"]
    parts.insert(-1, (b"IDAT", zlib.compress(rows[: kept(len(rows))])))
    return data[:8] + b"".join(chunk(*part) for part in parts)


def png_of_ffmpeg(pixel_format: str, interlaced: bool, height: int, width: int) -> bytes:
    encoder: Any = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = width, height, pixel_format, Fraction(1)
    encoder.options = {"flags": "+ildct"} if interlaced else {}
    pixels = np.random.default_rng(0).integers(40, 220, (height, width, 3), np.uint8)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format=pixel_format)
    return b"".join(map(bytes, [*encoder.encode(frame), *encoder.encode(None)]))
