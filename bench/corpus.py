"""Make clips like WebVid's from real footage: the corpus of the other benches.

    python -m bench corpus --out DIR --gop 250 --clips 6 --frames 450 SOURCE...

WebVid-10M clips are H.264, 596x336, yuv420p, about 800 kb/s. The x264 settings are those of its usual pipelines (preset
medium, three B-frames), with one encoder thread so that the bytes depend only on the source.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.frame import VideoFrame
from PIL import Image

from bench.frame import Column, Report, add_whole
from v2v_protocol.command import Parser
from v2v_server.video.probe import probe
from v2v_server.video.source import opened, packets

WIDTH_PX, HEIGHT_PX = 596, 336
BITS_PER_SECOND = 800_000
_RATE = Fraction(30000, 1001)
_COLUMNS: tuple[Column, ...] = (
    ("path", "clip", "{}", 1),
    ("frames", "frames", "{}", 1),
    ("bits_per_second", "kb/s", "{:.0f}", 1e-3),
    ("source", "source", "{}", 1),
)


def webvid_like(
    source_videos: Sequence[Path], out_dir: Path, gop: int = 250, frames: int = 450, clips: int = 6
) -> list[dict[str, Any]]:
    """Make clips of 596x336, H.264, yuv420p, about 800 kb/s, scaled and cropped about the centre.

    Clip i shows source i modulo their number; each repetition of a source begins ``frames`` later. At its end, footage
    runs backwards, then forwards again.

    Args:
        source_videos: footage.
        out_dir: folder for the clips; files of the same names are overwritten.
        gop: distance of keyframes (250: x264's default; 12: cheap seeks).
        frames: frames of a clip.
        clips: number of clips.

    Returns:
        one record for each clip.

    Raises:
        VideoError: a source does not decode.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    made = []
    for number in range(clips):
        source = source_videos[number % len(source_videos)]
        path = out_dir / f"clip{number:03d}_gop{gop}.mp4"
        order = _ping_pong(probe(source).frames, frames, first=number // len(source_videos) * frames)
        _encode(path, _pictures(source, order), gop)
        rate = float(path.stat().st_size * 8 * _RATE / frames)
        made.append({"path": str(path), "source": str(source), "frames": frames, "bits_per_second": rate})
    return made


def _ping_pong(available: int, wanted: int, first: int) -> list[int]:
    """Return ``wanted`` frame numbers: 0, 1 .. n-1, n-2 .. 1, 0, 1 .. from position ``first`` on."""
    period = max(1, 2 * (available - 1))
    return [min(at % period, period - at % period) for at in range(first, first + wanted)]


def _pictures(source: Path, order: Sequence[int]) -> Iterator[VideoFrame]:
    """Yield the frames of ``order`` as yuv420p of the target size."""
    wanted = set(order)
    last = max(wanted)
    # Kept as planes (0.3 MB each): a clip of 450 frames takes 135 MB while it is made.
    kept = {}
    with opened(source) as (container, stream):
        frames = chain.from_iterable(stream.decode(packet) for packet in chain(packets(container, stream), [None]))
        for number, frame in enumerate(frames):
            if number in wanted:
                kept[number] = _framed(frame)
            if number == last:
                break
    for number in order:
        # Encoding a frame sets its time stamp: each use needs its own frame.
        yield VideoFrame.from_ndarray(kept[number], format="yuv420p")


def _framed(frame: VideoFrame) -> np.ndarray:
    """Scale the picture to cover the target and crop it about its centre: planar yuv420p [H * 3 / 2, W] uint8."""
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
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=_RATE, options={"preset": "medium", "profile": "high"})
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        stream.gop_size, stream.max_b_frames, stream.bit_rate = gop, 3, BITS_PER_SECOND
        stream.thread_count = 1
        for number, frame in enumerate(frames):
            frame.pts, frame.time_base = number, 1 / _RATE
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def add_source(parser: Parser) -> None:
    """Add ``--videos``, ``--footage`` and ``--keep``, for :func:`run_folder`."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--videos", type=Path, metavar="DIR", help="corpus to serve")
    source.add_argument("--footage", type=Path, nargs="+", metavar="FILE", help="serve small clips made of these")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep logs and outputs in this new folder")


def write_labels(clip: Path, frames: int) -> None:
    """Write boxes and masks beside a clip: one object that moves by 2 px a frame."""
    masks = clip.with_suffix(".masks")
    masks.mkdir(exist_ok=True)
    lines = []
    for frame in range(frames):
        left, top = 20 + 2 * frame % (WIDTH_PX - 120), 30 + frame % 60
        lines.append(f"{frame + 1},1,{left + 1},{top + 1},80,60,1,-1,-1,-1\n")
        mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
        mask[top : top + 60, left : left + 80] = 1
        Image.fromarray(mask).save(masks / f"{frame:06}.png")
    clip.with_suffix(".boxes.txt").write_text("".join(lines), encoding="ascii")


@contextmanager
def run_folder(asked: argparse.Namespace) -> Iterator[tuple[Path, Path]]:
    """Yield a folder for the files of a run, temporary unless kept, and the corpus to serve."""
    with tempfile.TemporaryDirectory(prefix="v2v-bench-") as name:
        folder = Path(name) if asked.keep is None else asked.keep
        videos = asked.videos
        if videos is None:
            videos = folder / "clips"
            webvid_like(asked.footage, videos, gop=12, frames=300, clips=len(asked.footage))
            for clip in [*videos.iterdir()]:
                write_labels(clip, frames=300)
        yield folder, videos


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("sources", nargs="+", type=Path, metavar="SOURCE", help="footage to make the clips from")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the clips")
    add_whole(parser, "--gop", 250, "distance of keyframes, frames")
    add_whole(parser, "--clips", 6, "number of clips")
    add_whole(parser, "--frames", 450, "frames of a clip")


def measure(asked: argparse.Namespace) -> Report:
    """Make the clips."""
    records = webvid_like(asked.sources, asked.out, asked.gop, asked.frames, asked.clips)
    return Report(records, [(records, _COLUMNS)])
