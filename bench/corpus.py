"""The corpus of the throughput benchmark: clips like WebVid's, made from real footage.

WebVid-10M clips are H.264, 596x336, yuv420p, about 800 kb/s. The x264 settings are those of its usual pipelines (preset
medium, three B-frames), with one encoder thread so that the bytes depend on nothing but the source.

    python -m bench.corpus --out DIR --gop 250 --clips 6 --frames 450 SOURCE...
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.records import write_json
from v2v_server.video.probe import probe
from v2v_server.video.source import opened, pictures

WIDTH_PX, HEIGHT_PX = 596, 336
BITS_PER_SECOND = 800_000
_RATE = Fraction(30000, 1001)


@dataclass(frozen=True, slots=True)
class Clip:
    """One clip that was made.

    Attributes:
        path: the file.
        source: the footage it was made from.
        frames: number of frames.
        size_bytes: of the file.
        bits_per_second: achieved average rate.
    """

    path: str
    source: str
    frames: int
    size_bytes: int
    bits_per_second: float


def webvid_like(
    source_videos: Sequence[Path], out_dir: Path, gop: int = 250, frames: int = 450, clips: int = 6
) -> list[Clip]:
    """Make clips of 596x336, H.264, yuv420p, about 800 kb/s, scaled and cropped about the centre.

    Clip i shows source i modulo their number; every time a source comes again, it begins ``frames`` later. Where
    footage ends, it runs backwards and forwards by turns.

    Args:
        source_videos: footage.
        out_dir: folder for the clips; made if missing. Files of the same names are overwritten.
        gop: distance of keyframes (250: x264's default; 12: seeks cheaply).
        frames: frames of a clip.
        clips: how many clips.

    Raises:
        UsageError: no source, or a number below 1.
        VideoError: a source that does not decode.
    """
    if not source_videos or min(gop, frames, clips) < 1:
        raise UsageError(
            f"{len(source_videos)} sources, gop {gop}, {frames} frames, {clips} clips: each has to be 1 or more"
        )
    out_dir.mkdir(parents=True, exist_ok=True)
    made = []
    for number in range(clips):
        source = source_videos[number % len(source_videos)]
        path = out_dir / f"clip{number:03d}_gop{gop}.mp4"
        order = _ping_pong(probe(source).frames, frames, first=number // len(source_videos) * frames)
        _encode(path, _pictures(source, order), gop)
        size = path.stat().st_size
        made.append(Clip(str(path), str(source), frames, size, float(size * 8 * _RATE / frames)))
    return made


def _ping_pong(available: int, wanted: int, first: int) -> list[int]:
    """``wanted`` frame numbers: 0, 1 .. n-1, n-2 .. 1, 0, 1 .. from position ``first`` on."""
    period = max(1, 2 * (available - 1))
    return [min(at % period, period - at % period) for at in range(first, first + wanted)]


def _pictures(source: Path, order: Sequence[int]) -> Iterator[VideoFrame]:
    """The asked frames as yuv420p of the target size, in that order."""
    wanted = set(order)
    last = max(wanted)
    # Kept as planes (0.3 MB each): a clip of 450 frames takes 135 MB while it is made.
    kept = {}
    with opened(source) as (container, stream):
        for number, frame in enumerate(pictures(container, stream)):
            if number in wanted:
                kept[number] = _framed(frame)
            if number == last:
                break
    for number in order:
        # Whoever encodes a frame sets its time stamp: each use needs a frame of its own.
        yield VideoFrame.from_ndarray(kept[number], format="yuv420p")


def _framed(frame: VideoFrame) -> np.ndarray:
    """The picture scaled to cover the target and cropped about its centre: planar yuv420p [H * 3 / 2, W] uint8."""
    scale = max(WIDTH_PX / frame.width, HEIGHT_PX / frame.height)
    width, height = (2 * -(-round(side * scale) // 2) for side in (frame.width, frame.height))
    scaled = frame.reformat(width, height, format="yuv420p", dst_color_range="MPEG").to_ndarray()
    luma, chroma = scaled[:height], scaled[height:].reshape(2, height // 2, width // 2)
    top, left = (height - HEIGHT_PX) // 4, (width - WIDTH_PX) // 4  # in chroma samples, so that both planes agree
    return np.concatenate(
        [
            luma[2 * top : 2 * top + HEIGHT_PX, 2 * left : 2 * left + WIDTH_PX].reshape(-1),
            chroma[:, top : top + HEIGHT_PX // 2, left : left + WIDTH_PX // 2].reshape(-1),
        ]
    ).reshape(HEIGHT_PX * 3 // 2, WIDTH_PX)


def _encode(path: Path, frames: Iterator[VideoFrame], gop: int) -> None:
    options = {"preset": "medium", "profile": "high"}
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=_RATE, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        stream.gop_size, stream.max_b_frames, stream.bit_rate = gop, 3, BITS_PER_SECOND
        stream.thread_count = 1
        for number, frame in enumerate(frames):
            frame.pts, frame.time_base = number, 1 / _RATE
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit status: 0, or 2 for wrong usage or input."""
    parser = argparse.ArgumentParser(prog="python -m bench.corpus", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sources", nargs="+", type=Path, metavar="SOURCE", help="footage to make the clips from")
    parser.add_argument("--out", required=True, type=Path, help="folder for the clips")
    parser.add_argument("--gop", type=int, default=250, help="distance of keyframes (default 250)")
    parser.add_argument("--clips", type=int, default=6, help="how many clips (default 6)")
    parser.add_argument("--frames", type=int, default=450, help="frames of a clip (default 450)")
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    asked = parser.parse_args(arguments)
    try:
        made = webvid_like(asked.sources, asked.out, asked.gop, asked.frames, asked.clips)
    except (V2VError, OSError) as error:
        print(f"bench.corpus: {error}", file=sys.stderr)
        return 2
    for clip in made:
        print(f"{clip.path}  {clip.frames} frames  {clip.bits_per_second / 1e3:.0f} kb/s  from {clip.source}")
    if asked.json is not None:
        write_json(asked.json, [asdict(clip) for clip in made])
    return 0


if __name__ == "__main__":
    sys.exit(main())
