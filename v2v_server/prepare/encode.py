"""Writing luma to a file that decodes fast, with exactly the time stamps it is given.

What is written is full-range luma and nothing else, in MP4:

* ``h264``: x264 in true monochrome (4:0:0, so sizes may be odd) with ``tune fastdecode`` (no CABAC, no loop filter, no
  weighted prediction), constant rate factor, no psychovisual optimisation: that spends bits on texture that looks right
  to a person, where pixels that are right are wanted.
* ``mpeg4``, ``mpeg2``, ``mjpeg``: FFmpeg's own encoders at a constant quantiser, chroma flat.

Keyframes come at multiples of the GOP and nowhere else, at cuts neither: the same in all tiles of a picture, and, with
a GOP that divides it, at the first frame of every sequence.

No codec uses B-frames, so packets leave in order of presentation. The encoder runs on a clock of its own: one tick a
frame. So its rate control treats every frame alike whatever the rate, and codecs that know only certain rates take any
source; the source's time stamps are put onto the packets.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import cast

import av
import numpy as np
import numpy.typing as npt
from av.container import OutputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange
from av.video.stream import VideoStream

from v2v_protocol.errors import UsageError, VideoError
from v2v_server.video.source import reason
from v2v_server.video.tiles import KEY, NARROWEST_PX, columns, note, split

_NOMINAL_RATE = 25
_MIDDLE_GREY = 128
_LONGEST_GOP = 600  # the MPEG-4 encoder's limit


@dataclass(frozen=True, slots=True)
class Codec:
    """How one codec is used.

    Attributes:
        encoder: FFmpeg's name of the encoder.
        pixel_format: what it is given.
        options: its private options.
        constant_rate_factor: whether quality is x264's rate factor; otherwise it is the quantiser.
        lowest, highest: limits of ``quality``; lower is better.
        default: the quality where none is asked for.
        limited_range: the codec cannot state that its luma spans 0 .. 255, so it stores 16 .. 235. For a source of
            limited range nothing is lost by it; for others at most one level.
    """

    encoder: str
    pixel_format: str
    options: tuple[tuple[str, str], ...]
    constant_rate_factor: bool
    lowest: int
    highest: int
    default: int
    limited_range: bool = False


_NO_CUTS = (("sc_threshold", "1000000000"),)

CODECS = {
    "h264": Codec(
        "libx264", "gray", (("preset", "medium"), ("tune", "fastdecode"), ("x264-params", "no-psy=1:scenecut=0")),
        True, 1, 51, 18,
    ),
    "mpeg4": Codec("mpeg4", "yuv420p", _NO_CUTS, False, 1, 31, 2),
    "mpeg2": Codec("mpeg2video", "yuv420p", _NO_CUTS, False, 1, 31, 2, limited_range=True),
    "mjpeg": Codec("mjpeg", "yuvj420p", (), False, 1, 31, 3),
}  # fmt: skip

DEFAULT_CODEC = "h264"
DEFAULT_GOP = 25


@dataclass(frozen=True, slots=True)
class Encoding:
    """Codec settings of a prepared corpus.

    Attributes:
        codec: a key of :data:`CODECS`.
        quality: see :class:`Codec`; lower is better and larger.
        gop: distance of keyframes in frames; decoding a random range begins up to so many frames early.
        tile_px: the picture is cut into columns of about so many pixels, each in a track of its own (see
            :mod:`v2v_server.video.tiles`); 0 leaves it whole.
        tile_overlap_px: of which each shares so many with the next.

    Raises:
        UsageError: an unknown codec, or a number outside its limits.
    """

    codec: str
    quality: int
    gop: int
    tile_px: int = 0
    tile_overlap_px: int = 0

    def __post_init__(self) -> None:
        if self.codec not in CODECS:
            raise UsageError(f"codec {self.codec!r}: choose one of {', '.join(CODECS)}")
        kind = CODECS[self.codec]
        if not kind.lowest <= self.quality <= kind.highest:
            name = "rate factor" if kind.constant_rate_factor else "quantiser"
            raise UsageError(f"quality {self.quality}: {self.codec} takes a {name} of {kind.lowest} .. {kind.highest}")
        if not 1 <= self.gop <= _LONGEST_GOP:
            raise UsageError(f"gop {self.gop}: give 1 .. {_LONGEST_GOP} frames")
        if self.tile_px and self.tile_px < NARROWEST_PX:
            raise UsageError(f"tiles of {self.tile_px} px: give 0 (none), or {NARROWEST_PX} and more")
        if not 0 <= self.tile_overlap_px <= max(0, self.tile_px - NARROWEST_PX):
            raise UsageError(
                f"tiles of {self.tile_px} px that share {self.tile_overlap_px} with the next: leave each at least "
                f"{NARROWEST_PX} of its own"
            )

    def __str__(self) -> str:
        tiles = f" tiles {self.tile_px} px" if self.tile_px else ""
        if self.tile_overlap_px:
            tiles += f" overlap {self.tile_overlap_px} px"
        return f"{self.codec} quality {self.quality} gop {self.gop}{tiles}"


def encode_luma(
    path: str | os.PathLike[str],
    frames: Iterable[npt.NDArray[np.uint8]],
    encoding: Encoding,
    *,
    height: int,
    width: int,
    pts: Sequence[int],
    time_base: Fraction,
    codec: Codec | None = None,
) -> None:
    """Write a file; any that stands there is overwritten. Memory does not grow with its length.

    Args:
        path: the file; its suffix does not matter.
        frames: ``len(pts)`` pictures [height, width] uint8, full range.
        encoding: the codec settings.
        height, width: of the pictures, pixels; odd ones too.
        pts: strictly increasing time stamps in units of ``time_base``.
        time_base: seconds.
        codec: how to use the codec, where that is not to be ``CODECS[encoding.codec]``.

    Raises:
        VideoError: the encoder or the container refuses (a picture too small or too large for the codec, a full disk).
    """
    kind = codec or CODECS[encoding.codec]
    # A first time stamp other than 0 is stored in units of the movie's clock: by default milliseconds. And some of
    # these codecs leave it to the container to say that their luma has full range.
    container_options = {"movie_timescale": str(time_base.denominator), "movflags": "write_colr"}
    try:
        with av.open(os.fspath(path), "w", format="mp4", options=container_options) as output:
            tiles = split(width, encoding.tile_px, encoding.tile_overlap_px)
            if tiles:
                output.metadata[KEY] = note(tiles)
            widths = [tile.width_px for tile in tiles] or [width]
            tracks = [_Track(output, kind, encoding, height, size, pts, time_base) for size in widths]
            for number, luma in enumerate(frames):
                for track, column in zip(tracks, columns(luma, tiles), strict=True):
                    track.add(number, column)
            for track in tracks:
                track.close()
    except (av.FFmpegError, OSError) as error:
        raise VideoError(os.fspath(path), None, f"cannot be encoded as {encoding}: {reason(error)}") from error


class _Track:
    """One track of a file, and the pictures on their way into it."""

    def __init__(
        self,
        output: OutputContainer,
        kind: Codec,
        encoding: Encoding,
        height: int,
        width: int,
        pts: Sequence[int],
        time_base: Fraction,
    ) -> None:
        options = dict(kind.options)
        if kind.constant_rate_factor:
            options["crf"] = str(encoding.quality)
        stream = cast(VideoStream, output.add_stream(kind.encoder, rate=_NOMINAL_RATE, options=options))
        if not kind.constant_rate_factor:
            # A constant quantiser; the encoders ignore an option of that name.
            stream.codec_context.qmin = stream.codec_context.qmax = encoding.quality
        stream.width, stream.height, stream.pix_fmt = width, height, kind.pixel_format
        stream.gop_size, stream.max_b_frames, stream.thread_count = encoding.gop, 0, 1
        stream.color_range = ColorRange.MPEG if kind.limited_range else ColorRange.JPEG
        stream.time_base = time_base
        self._output, self._stream, self._kind = output, stream, kind
        self._due, self._time_base = iter(pts), time_base

    def add(self, number: int, luma: npt.NDArray[np.uint8]) -> None:
        """Encode the next picture."""
        frame = _frame(luma, self._kind)
        frame.pts, frame.time_base = number, Fraction(1, _NOMINAL_RATE)
        self._write(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder still holds."""
        self._write(self._stream.encode(None))

    def _write(self, packets: Iterable[Packet[VideoStream]]) -> None:
        for packet in packets:
            packet.time_base = self._time_base
            packet.pts = packet.dts = next(self._due)
            self._output.mux(packet)


def _frame(luma: npt.NDArray[np.uint8], kind: Codec) -> VideoFrame:
    height, width = luma.shape
    frame = VideoFrame(width, height, kind.pixel_format)
    frame.color_range = ColorRange.MPEG if kind.limited_range else ColorRange.JPEG
    for number, plane in enumerate(frame.planes):
        samples = np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, -1)
        if number:
            samples[...] = _MIDDLE_GREY
        else:
            samples[:, :width] = limited_table()[luma] if kind.limited_range else luma
    return frame


@cache
def limited_table() -> npt.NDArray[np.uint8]:
    """[256] uint8: the limited-range luma of every full-range grey, Y = round(16 + 219 grey / 255).

    Decoding it (:func:`v2v_server.video.luma.range_table`) gives back every grey that limited-range luma can show, and
    for the others a neighbour.
    """
    grey = np.arange(256, dtype=np.int64)
    table: npt.NDArray[np.uint8] = (16 + (438 * grey + 255) // 510).astype(np.uint8)
    table.flags.writeable = False
    return table
