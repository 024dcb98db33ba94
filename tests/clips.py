"""Write small video files for tests: a photograph panned by whole pixels, in any codec and container of PyAV."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import cast

import av
import numpy as np
import numpy.typing as npt
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, ColorTrc
from av.video.stream import VideoStream

TIME_BASE = Fraction(1, 1000)
"""Clock of the clips that state their time stamps; containers may choose another one."""

_TEXTURED = (140, 200)
"""Row and column of the photograph where the pan begins: man and camera, not sky."""


@cache
def _photograph() -> npt.NDArray[np.uint8]:
    from skimage import data  # clips of other pictures are written without it

    # A copy: the reader hands out a read-only or shared array in some versions.
    return np.array(data.camera(), np.uint8)  # type: ignore[no-untyped-call]


def panned_luma(
    frames: int, height: int = 48, width: int = 64, step: tuple[int, int] = (1, 2), full_range: bool = True
) -> npt.NDArray[np.uint8]:
    """Pan a window over a photograph by ``step`` = (down, right) whole pixels per frame, wrapping around.

    Returns:
        [frames, height, width] uint8; spans 16 .. 235 unless ``full_range``.
    """
    picture = _photograph()
    if not full_range:
        picture = (16 + np.rint(picture * (219 / 255))).astype(np.uint8)
    top, left = _TEXTURED
    rows = (top + np.arange(frames)[:, None] * step[0] + np.arange(height)) % picture.shape[0]
    columns = (left + np.arange(frames)[:, None] * step[1] + np.arange(width)) % picture.shape[1]
    panned: npt.NDArray[np.uint8] = picture[rows[:, :, None], columns[:, None, :]]
    return panned


def write_clip(
    path: Path,
    luma: npt.NDArray[np.integer],
    *,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    options: Mapping[str, str] | None = None,
    gop: int = 12,
    b_frames: int = 0,
    rate: Fraction | int = 25,
    full_range: bool | None = False,
    transfer: ColorTrc | None = None,
    rotation_degrees: int = 0,
    hflip: bool = False,
    pts: Sequence[int] | None = None,
    container: str | None = None,
    audio: bool = False,
) -> Path:
    """Encode pictures of the given luma and neutral chroma.

    Args:
        path: the file to write, in a folder that need not exist; its suffix chooses the container.
        luma: [n, height, width]; uint8, or wider for pixel formats of more than 8 bits.
        codec: PyAV's name of the encoder.
        pixel_format: any planar YUV or grey format, or an RGB one (which then shows ``luma`` as grey).
        options: options of the encoder.
        gop: distance of keyframes.
        b_frames: most consecutive B-frames.
        rate: frames per second, where ``pts`` is not given.
        full_range: the range to state; None states none.
        transfer: the transfer characteristic to state.
        rotation_degrees, hflip: display matrix to write.
        pts: time stamps in units of TIME_BASE, one a frame.
        container: FFmpeg's name of the container, if the suffix does not determine it.
        audio: add a tone.
    """
    n, height, width = luma.shape
    if codec == "libx264":
        # Its code for AVX-512 reads memory that it has not written: one clip of 150 becomes another.
        options = {**(options or {}), "x264-params": f"asm=ssse3:{(options or {}).get('x264-params', '')}"}
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format=container) as output:
        stream = cast(VideoStream, output.add_stream(codec, rate=rate, options=dict(options or {})))
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.gop_size = gop
        stream.max_b_frames = b_frames
        stream.thread_count = 1
        if full_range is not None:
            stream.color_range = ColorRange.JPEG if full_range else ColorRange.MPEG
        if transfer is not None:
            stream.codec_context.color_trc = transfer
        if pts is not None:
            stream.codec_context.time_base = TIME_BASE
        if rotation_degrees or hflip:
            stream.set_display_rotation(rotation_degrees, hflip=hflip)
        # Every track must be there before the first packet is written.
        sound = output.add_stream("aac", rate=16000) if audio else None
        for number in range(n):
            frame = _frame(luma[number], pixel_format, full_range)
            frame.pts = number if pts is None else pts[number]
            frame.time_base = 1 / Fraction(rate) if pts is None else TIME_BASE
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
        if sound is not None:
            output.mux(sound.encode(_tone(math.ceil(n / rate * 16000))))
            output.mux(sound.encode(None))
    return path


def write_panned(folder: Path, count: int, frames: int, height: int = 48, width: int = 64, *, gop: int = 12) -> Path:
    """Write the clips 0.mp4, 1.mp4 ... to a folder, each panned faster than the one before; return the folder."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        write_clip(folder / f"{number}.mp4", panned_luma(frames, height, width, step=(1, 1 + number)), gop=gop)
    return folder


def _frame(luma: npt.NDArray[np.integer], pixel_format: str, full_range: bool | None) -> VideoFrame:
    height, width = luma.shape
    if "yuv" not in pixel_format and "gray" not in pixel_format:
        return VideoFrame.from_ndarray(luma.astype(np.uint8), format="gray").reformat(format=pixel_format)
    frame = VideoFrame(width, height, pixel_format)
    bits = frame.format.components[0].bits
    for number, plane in enumerate(frame.planes):
        dtype = np.dtype(np.uint8 if bits == 8 else "<u2")
        samples = np.frombuffer(memoryview(plane), dtype).reshape(plane.height, -1)
        if number == 0:
            samples[:, :width] = luma
        else:
            samples[...] = 2 ** (bits - 1)
    if full_range is not None:
        frame.color_range = ColorRange.JPEG if full_range else ColorRange.MPEG
    return frame


def _tone(samples: int) -> av.AudioFrame:
    wave = (8000 * np.sin(np.arange(samples) * (2 * np.pi * 440 / 16000))).astype(np.int16)
    tone = av.AudioFrame.from_ndarray(wave[None], format="s16", layout="mono")
    tone.sample_rate = 16000
    return tone


def truncated(source: Path, target: Path, share: float) -> Path:
    """Keep the first ``share`` of a file's bytes."""
    content = source.read_bytes()
    target.write_bytes(content[: int(len(content) * share)])
    return target


def damaged(source: Path, target: Path, packet: int) -> Path:
    """Overwrite the video packet of that number (stored order) by noise, apart from its first bytes."""
    with av.open(str(source)) as container:
        wanted = [(p.pos, p.size) for p in container.demux(video=0) if p.size][packet]
    if wanted[0] is None or wanted[0] < 0:
        raise ValueError(f"{source}: its container does not say where packets lie")
    content = bytearray(source.read_bytes())
    begin, end = wanted[0] + 8, wanted[0] + wanted[1]
    content[begin:end] = np.random.default_rng(packet).integers(0, 256, end - begin, np.uint8).tobytes()
    target.write_bytes(content)
    return target
