"""Measure what events of whole videos cost: ``v2v-simulate --whole``.

    python -m bench whole --json whole.json
    python -m bench whole --memory

A texture of 720p drifts in a part of the picture, so that a frame has about 0.2 or 1.0 million events. Each turn makes
one recording of every video and form in this process, on one core. Times are processor time, decoding included, and
medians over the turns; the form ``none`` writes nothing. ``--memory`` instead makes recordings of a short and a long
video, each in a process of its own, and compares their largest memory.

Bars: a frame takes at most 36 ms at 0.2 million events and 100 ms at 1.0 million; ten times the frames take at most 1.2
times the memory.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.frame import VideoFrame

from bench.frame import Column, Report, add_whole, beyond, chosen, medians, progress
from v2v_protocol.command import Parser
from v2v_recordings.items import EventChunk
from v2v_recordings.writers import EVENT_FORMS, EventForm
from v2v_tools import simulate

WIDTH, HEIGHT, RATE, PERIOD = 1280, 720, 30, 64
MOVING_PX = {0.2: 70, 1.0: 725}
"""Width of the part that moves, by million events of a frame."""
BARS_SECONDS, MEMORY_BAR, FORMS = {0.2: 0.036, 1.0: 0.1}, 1.2, ("none", "h5", "raw")
SHORT, LONG = 300, 3000
PEAK = """import sys
from v2v_tools.simulate import main
status = main(sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
sys.exit(status)"""
"""Runs the command and says its peak. That of ``getrusage`` begins with the peak of the process that starts it."""
_COLUMNS: tuple[Column, ...] = (
    ("form", "form", "{}", 1),
    ("events_per_frame", "million events a frame", "{:.2f}", 1e-6),
    ("frame_seconds", "CPU ms a frame", "{:.1f}", 1e3),
    ("seconds_per_event", "ms per million events", "{:.1f}", 1e9),
    ("bytes_per_event", "bytes an event", "{:.1f}", 1),
    ("frames", "frames", "{}", 1),
    ("peak_bytes", "peak MiB", "{:.0f}", 1 / (1 << 20)),
    ("memory_ratio", "of the short one", "{:.2f}", 1),
)


def write_nothing(*_: object) -> Generator[None, EventChunk | None, None]:
    """Take the pieces of a recording and drop them."""
    while (yield):
        pass


def write_video(path: Path, frames: int, moving_px: int) -> None:
    """Write a video of a texture that drifts in the left part of the picture."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    drawn = [
        110 + 60 * np.sin(2 * np.pi * (x / 16 + np.where(x < moving_px, number / PERIOD * 4, 0))) + 30 * np.cos(y / 5)
        for number in range(PERIOD)
    ]
    luma = [each.astype(np.uint8) for each in drawn]
    chroma = np.full((HEIGHT // 2, WIDTH), 128, np.uint8)
    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=RATE, options={"preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number in range(frames):
            planes = np.concatenate([luma[number % PERIOD], chroma])
            output.mux(stream.encode(VideoFrame.from_ndarray(planes, format="yuv420p")))
        output.mux(stream.encode(None))


def line_of(video: Path, out: Path, form: str) -> list[str]:
    """Return the arguments of the command."""
    recipe = ["--recipe", "davis346", "--set", "threshold=[0.2,0.2]", "--cache-dir", str(video.parent)]
    return ["--whole", str(video), "--out", str(out), "--events", form, *recipe]


def processor_seconds() -> float:
    """Return the processor time of this process and of those it has started."""
    return sum(os.times()[:4])


def record_of(video: Path, form: str, frames: int) -> dict[str, Any]:
    """Make a recording, and return its figures."""
    with tempfile.TemporaryDirectory(dir=video.parent) as out:
        began, said = processor_seconds(), io.StringIO()
        with contextlib.redirect_stdout(said):
            status = simulate.main(line_of(video, Path(out), form))
        seconds = processor_seconds() - began
        if status != 0:
            raise RuntimeError(said.getvalue())
        events = int(said.getvalue().split(" events of ")[0].rsplit(" ", 1)[-1])
        size = sum(path.stat().st_size for path in Path(out).rglob("*") if path.suffix in (".h5", ".raw"))
    return {
        "events_per_frame": events / frames, "frame_seconds": seconds / frames, "seconds_per_event": seconds / events,
        "bytes_per_event": size / events or None,
    }  # fmt: skip


def times(folder: Path, asked: argparse.Namespace, forms: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield a record for each video and form."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    videos = {load: folder / f"{load}.mp4" for load in MOVING_PX}
    for load, video in videos.items():
        write_video(video, asked.frames, MOVING_PX[load])
        record_of(video, forms[0], asked.frames)  # catalogue and compilation
    pairs = [(load, form) for load in videos for form in forms]
    turns = []
    for turn in range(asked.turns):
        progress(f"turn {turn + 1} of {asked.turns}")
        turns.append({pair: record_of(videos[pair[0]], pair[1], asked.frames) for pair in pairs})
    for load, form in pairs:
        every = [turn[load, form] for turn in turns]
        size = every[0].pop("bytes_per_event")
        yield {"load": load, "form": form, "bytes_per_event": size} | medians(every)


def memory(folder: Path, forms: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Yield a record for each form and number of frames."""
    videos = {frames: folder / f"{frames}.mp4" for frames in (SHORT, LONG)}
    for frames, video in videos.items():
        write_video(video, frames, MOVING_PX[0.2])
        record_of(video, forms[0], frames)
    for form in forms:
        peaks = []
        for frames, video in videos.items():
            command = [sys.executable, "-c", PEAK, *line_of(video, folder / f"{form}-{frames}", form)]
            progress(f"{form}, {frames} frames")
            said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
            peaks.append(int(said.split()[-2]) << 10)
            yield {"form": form, "frames": frames, "peak_bytes": peaks[-1], "memory_ratio": peaks[-1] / peaks[0]}


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--frames", 90, "frames of each video")
    add_whole(parser, "--turns", 5, "turns of each video and form")
    parser.add_argument("--forms", metavar="FORM,FORM", help=f"of none, {', '.join(EVENT_FORMS)} (default none,h5,raw)")
    parser.add_argument("--memory", action="store_true", help="compare the memory of 300 frames and of 3,000 instead")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    EVENT_FORMS["none"] = EventForm("", "npz", write_nothing)
    forms = chosen(asked.forms or ",".join(FORMS[asked.memory :]), EVENT_FORMS, "--forms")
    with tempfile.TemporaryDirectory(prefix="v2v-whole-") as name:
        records = list(memory(Path(name), forms) if asked.memory else times(Path(name), asked, forms))
    missed = []
    for each in records:
        bars = {"memory_ratio": MEMORY_BAR} | ({} if asked.memory else {"frame_seconds": BARS_SECONDS[each["load"]]})
        missed += beyond(each["form"], each, most=bars)
    return Report(records, [(records, _COLUMNS)], missed=missed)
