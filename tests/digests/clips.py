"""Write videos whose every level is a whole number from arithmetic: the same bytes of samples on every host.

a.mkv   zooms in behind a square that moves: every speed; 8 bits, 4:2:0 colour, boxes and masks
b.mkv   pans; 10 bits, PQ; boxes
c.mkv   a still picture in which one corner moves; bars, repeated frames, a cut
"""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, ColorTrc
from av.video.stream import VideoStream
from PIL import Image

from tests.clips import write_clip
from v2v_recordings.block_file import EventFileWriter
from v2v_recordings.items import EventChunk, FlowField, Picture, SensorSize

Longs = npt.NDArray[np.int64]
HEIGHT_PX, WIDTH_PX = 64, 96
RATE = 25
_UNIT = 16
"""Parts of a pixel that positions are counted in."""
_LATTICE = 5 * _UNIT
_SQUARE_PX = 14


def write_clips(folder: Path) -> Path:
    """Write the videos and their sidecars into an existing folder, and return it."""
    luma, chroma = zooming(48)
    write_coloured(folder / "a.mkv", luma, chroma)
    (folder / "a.boxes.json").write_text(boxes_text(len(luma)))
    (folder / "a.masks").mkdir()
    for frame in range(len(luma)):
        top, left = _square(frame)
        mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
        mask[top : top + _SQUARE_PX, left : left + _SQUARE_PX] = 3
        Image.fromarray(mask).save(folder / "a.masks" / f"{frame:04}.png")
    deep = panning(40)
    write_deep(folder / "b.mkv", deep)
    (folder / "b.boxes.json").write_text(boxes_text(len(deep)))
    write_clip(folder / "c.mkv", spoilt(), codec="ffv1", pixel_format="gray", rate=RATE, full_range=True)
    return folder


def write_deep(path: Path, levels: npt.NDArray[np.uint16]) -> None:
    """Write what :func:`panning` returns, losslessly."""
    write_clip(path, levels, codec="ffv1", pixel_format="yuv420p10le", rate=RATE, transfer=ColorTrc.SMPTE2084)


def write_lossy(path: Path) -> None:
    """Write a video in MJPEG, whose decoders round differently from host to host."""
    luma, _ = zooming(30)
    write_clip(path, luma, codec="mjpeg", pixel_format="yuvj420p", rate=RATE, full_range=True)


def zooming(frames: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return luma [n, H, W], and Cb and Cr [n, 2, H / 2, W / 2]."""
    y, x = np.ogrid[:HEIGHT_PX, :WIDTH_PX]
    luma = np.empty((frames, HEIGHT_PX, WIDTH_PX), np.uint8)
    chroma = np.empty((frames, 2, HEIGHT_PX // 2, WIDTH_PX // 2), np.uint8)
    for t in range(frames):
        scale = 400 - 4 * t
        rows, columns = (y - 30) * scale // 16 + 9000, (x - 40) * scale // 16 + 9000
        luma[t] = _texture(rows, columns, 1)
        top, left = _square(t)
        luma[t, top : top + _SQUARE_PX, left : left + _SQUARE_PX] = 255 - _texture(
            _UNIT * np.arange(_SQUARE_PX)[:, None], _UNIT * np.arange(_SQUARE_PX), 2
        )
        for plane in range(2):
            chroma[t, plane] = _texture(rows[::2] + 64 * plane, columns[:, ::2], 3 + plane)
    return luma, chroma


def panning(frames: int) -> npt.NDArray[np.uint16]:
    """Return limited-range levels of 10 bits, [n, H, W]."""
    y, x = np.arange(HEIGHT_PX)[:, None], np.arange(WIDTH_PX)
    shown = [_texture(_UNIT * y + 19 * t, _UNIT * x + 37 * t, 5) for t in range(frames)]
    levels = 64 + np.stack(shown).astype(np.int64) * 876 // 255
    levels[:, :, 1:] += (np.arange(WIDTH_PX - 1) % 4) * (levels[:, :, 1:] < 930)
    return levels.astype(np.uint16)


def spoilt() -> npt.NDArray[np.uint8]:
    """Return two shots of 40 pictures, each second one shown twice, with bars: [120, H, W]."""
    inner = HEIGHT_PX - 16
    y, x = np.arange(inner)[:, None], np.arange(WIDTH_PX)
    pictures = []
    for shot in range(2):
        still = _texture(_UNIT * y, _UNIT * x, 6 + shot) // (1 + shot)
        for t in range(40):
            picture = still.copy()
            corner = _texture(_UNIT * y[:24] + 30 * t, _UNIT * x[:36] + 55 * t, 8)
            picture[shot * 24 : shot * 24 + 24, shot * 60 : shot * 60 + 36] = corner
            pictures += [picture] * (1 + t % 2)
    return np.pad(np.stack(pictures), ((0, 0), (8, 8), (0, 0))).astype(np.uint8)


def _square(frame: int) -> tuple[int, int]:
    """Return top and left of the square, px."""
    return 8 + 2 * frame % 34, 4 + 5 * frame % 70


def _texture(rows: Longs, columns: Longs, key: int) -> Longs:
    """Return grey levels at positions in 1/_UNIT px: a lattice of pseudo-random levels, interpolated."""
    (row, down), (column, right) = np.divmod(rows, _LATTICE), np.divmod(columns, _LATTICE)
    corners = [[_level(row + dy, column + dx, key) for dx in range(2)] for dy in range(2)]
    upper, lower = (near * (_LATTICE - right) + far * right for near, far in corners)
    grey: Longs = (upper * (_LATTICE - down) + lower * down) // _LATTICE**2
    return grey


def _level(row: Longs, column: Longs, key: int) -> Longs:
    mixed = (row * 73856093 ^ column * 19349663 ^ key * 83492791) & 0xFFFFFF
    level: Longs = (mixed * (mixed ^ 0x5BD1E9) >> 13) & 255
    return level


def write_photographs(folder: Path) -> None:
    """Write two photographs, each a texture between coarse tiles."""
    folder.mkdir()
    row, column = np.mgrid[:73, :90].astype(np.int64)
    for key, name in enumerate(("a.png", "b.png"), 5):
        tiles, texture = _level(row // 11, column // 13, key), _level(row // 2, column // 2, key + 9)
        Image.fromarray(((tiles * 3 + texture) // 4).astype(np.uint8)).save(folder / name)


def write_recordings(folder: Path) -> Path:
    """Write two recordings in the form that is served: with pictures and true flow; return the folder."""
    for name, key in (("a.v2ve", 5), ("b.v2ve", 8)):
        number = np.arange(6000, dtype=np.int64)
        times = np.cumsum(1000 * (_level(number, number, key) % 7)) + 13_000_000
        place = _level(number // 2, number, key + 1) * 256 + _level(number, number // 3, key + 2)
        x, y, brighter = place % WIDTH_PX, place // WIDTH_PX % HEIGHT_PX, place % 5 < 2
        marks = np.linspace(times[0] - 1000, times[-1], 12).astype(np.int64)
        with EventFileWriter(folder / name, source=name, fingerprint="", origin_ns=0) as writer:
            writer.add(SensorSize(WIDTH_PX, HEIGHT_PX))
            writer.add(EventChunk(times, x, y, brighter))
            for mark, picture in zip(marks.tolist(), zooming(12)[0], strict=True):
                writer.add(Picture(mark, picture))
                flow = np.stack([picture, 255 - picture]).astype(np.float32) / 64
                flow[:, picture % 17 == 0] = np.nan
                writer.add(FlowField(mark, flow))
    return folder


def boxes_text(frames: int) -> str:
    """Return three boxes a frame, in COCO-VID: the square, and two parts of it."""
    images = [{"id": frame, "frame_id": frame} for frame in range(frames)]
    boxes = [
        {"image_id": frame, "bbox": [*_square(frame)[::-1], side, side], "category_id": 3, "instance_id": number}
        for frame in range(frames)
        for number, side in enumerate((_SQUARE_PX, 9, 6))
    ]
    return json.dumps({"images": images, "annotations": boxes})


def write_coloured(path: Path, luma: npt.NDArray[np.uint8], chroma: npt.NDArray[np.uint8]) -> None:
    """Write what :func:`zooming` returns, losslessly."""
    with av.open(str(path), "w") as output:
        stream = cast(VideoStream, output.add_stream("ffv1", rate=RATE))
        stream.height, stream.width, stream.pix_fmt = *luma.shape[1:], "yuv420p"
        stream.color_range = ColorRange.JPEG
        for number, (grey, colours) in enumerate(zip(luma, chroma, strict=True)):
            frame = VideoFrame(luma.shape[2], luma.shape[1], "yuv420p")
            for plane, values in zip(frame.planes, (grey, *colours), strict=True):
                np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, -1)[:, : values.shape[1]] = values
            frame.color_range, frame.pts, frame.time_base = ColorRange.JPEG, number, Fraction(1, RATE)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
