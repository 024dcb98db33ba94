"""Write luma to a video file that decodes fast, with exactly the given time stamps.

The file holds only full-range luma, in MP4: x264 in true monochrome (4:0:0, so sizes may be odd) with
``tune fastdecode`` (no CABAC, no loop filter, no weighted prediction), constant rate factor, and no psychovisual
optimisation, which spends bits on texture that looks right to people, where accurate pixels are wanted.

Keyframes come only at multiples of the GOP, and not at shot boundaries: with a GOP that divides it, at the first frame
of every sequence. There are no B-frames, so packets leave in order of presentation. The encoder's clock has one tick
per frame, so its rate control treats all frames alike whatever the rate; the source's time stamps are set on the
packets.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from fractions import Fraction

import av
import numpy as np
import numpy.typing as npt
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange
from av.video.stream import VideoStream

from v2v_protocol.errors import VideoError
from v2v_server.store.encoding import Encoding
from v2v_server.video.luma import SDR, TRANSFERS
from v2v_server.video.source import reason

_CODE_POINTS = {name: code for code, name in TRANSFERS.items()}
_NOMINAL_RATE = 25
_OPTIONS = {"preset": "medium", "tune": "fastdecode", "x264-params": "no-psy=1:scenecut=0"}


def encode_luma(
    path: str | os.PathLike[str],
    frames: Iterable[npt.NDArray[np.uint8]],
    encoding: Encoding,
    transfer: str = SDR.transfer,
    *,
    height: int,
    width: int,
    pts: Sequence[int],
    time_base: Fraction,
) -> None:
    """Write a file, overwriting an existing one. Memory does not grow with its length.

    Args:
        path: the file; its suffix does not matter.
        frames: ``len(pts)`` pictures [height, width] uint8, full range.
        encoding: settings of h264.
        transfer: of the pictures, see :class:`v2v_server.video.luma.Signal`; SDR is not stated.
        height, width: size of the pictures, pixels; odd sizes are allowed.
        pts: strictly increasing time stamps in units of ``time_base``.
        time_base: seconds.

    Raises:
        VideoError: the encoder or the container refuses (a picture too small or too large for the codec, a full disk).
    """
    # MP4 stores a first time stamp other than 0 in units of the movie's clock, by default milliseconds.
    container_options = {"movie_timescale": str(time_base.denominator), "movflags": "write_colr"}
    try:
        with av.open(os.fspath(path), "w", format="mp4", options=container_options) as output:
            options = {**_OPTIONS, "crf": str(encoding.quality)}
            stream = output.add_stream("libx264", rate=_NOMINAL_RATE, options=options)
            stream.width, stream.height, stream.pix_fmt = width, height, "gray"
            stream.gop_size, stream.max_b_frames, stream.thread_count = encoding.gop, 0, 1
            stream.color_range = ColorRange.JPEG
            if transfer in _CODE_POINTS:
                stream.codec_context.color_trc = _CODE_POINTS[transfer]
            stream.time_base = time_base
            due = iter(pts)

            def write(packets: Iterable[Packet[VideoStream]]) -> None:
                for packet in packets:
                    packet.time_base = time_base
                    packet.pts = packet.dts = next(due)
                    output.mux(packet)

            for number, luma in enumerate(frames):
                frame = VideoFrame(width, height, "gray")
                frame.color_range = ColorRange.JPEG
                plane = frame.planes[0]
                np.frombuffer(memoryview(plane), np.uint8).reshape(height, -1)[:, :width] = luma
                frame.pts, frame.time_base = number, Fraction(1, _NOMINAL_RATE)
                write(stream.encode(frame))
            write(stream.encode(None))
    except (av.FFmpegError, OSError) as error:
        raise VideoError(os.fspath(path), None, f"cannot be encoded as {encoding}: {reason(error)}") from error
