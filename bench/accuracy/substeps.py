"""Error of voxels between frames, with and without sub-steps.

Scenes that are rendered at any time (``tests/oracles/rendered.py``) are seen as 8-bit frames. Their events, one by one
with exact times, are compared with those of the frames, linear in time, and with those of the frames and the levels
between them that ``substep_px`` makes. "count" is the error of the number of events, "signed" that of signed bins,
"split" that of both polarities apart; all as shares of the truth. ``--video`` adds a film of high frame rate: the truth
is then all of its frames, and every n-th one is seen.

Bars: moving photographs (mean of three) at substep_px 1: 10 % signed and 30 % split in bins of a frame at 4.8 and 12 px
a frame; in bins of 10 ms at 30 frames a second 45, 38 and 50 % signed at 2, 4 and 10 px, and never worse than linear at
0.3 and 0.8 px.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.accuracy.physics import VIDEO_SIDE_PX, liveliest
from bench.frame import Column, Report, beyond, progress
from tests.oracles.decoded import decode_luma
from tests.oracles.rendered import (
    NAMES,
    PHOTOGRAPHS,
    Counts,
    Errors,
    Reals,
    counts_of,
    errors,
    log_levels,
    rendered_scene,
)
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_server.motion import levels_between, motions
from v2v_server.simulation.voxel import FINE_STEPS, Levels
from v2v_server.video.probe import probe

Records = list[dict[str, Any]]
Frames = npt.NDArray[np.uint8]
SUBSTEP_PX, THRESHOLD, FRAMES_PER_SECOND, BIN_SECONDS = 1.0, 0.2, 30.0, 0.01
SPEEDS_PX = (0.3, 0.8, 2.0, 4.0, 4.8, 10.0, 12.0)
OTHER_SPEEDS_PX = (1.5, 6.0)
BARS = {
    ("frame", 4.8): (0.10, 0.30), ("frame", 12.0): (0.10, 0.30), ("10 ms", 2.0): (0.45, 9.0),
    ("10 ms", 4.0): (0.38, 9.0), ("10 ms", 10.0): (0.50, 9.0),
}  # fmt: skip
SLOW_PX = 1.0
EVERY, VIDEO_STEPS = (4, 8), 8
_COLUMNS: tuple[Column, ...] = (
    ("scene", "scene", "{}", 1),
    ("px_per_frame", "px a frame", "{:g}", 1),
    ("frames_per_second", "frames/s", "{:g}", 1),
    ("bin", "bin", "{}", 1),
    ("count_linear", "count", "{:+.0%}", 1),
    ("signed_linear", "signed", "{:.1%}", 1),
    ("split_linear", "split", "{:.1%}", 1),
    ("substeps", "sub-steps", "{:.1f}", 1),
    ("count_divided", "count", "{:+.0%}", 1),
    ("signed_divided", "signed", "{:.1%}", 1),
    ("split_divided", "split", "{:.1%}", 1),
)


def light_of(frames: Frames, levels: Levels | None, seconds: Reals) -> tuple[Reals, Reals]:
    """Return light [n, pixels] and its n times, of frames and the levels between them."""
    light = frames.reshape(len(frames), -1) / 255.0
    if levels is None:
        return light, seconds
    moments = seconds[levels.at.step] + levels.at.share * np.diff(seconds)[levels.at.step]
    between = levels.grey.reshape(len(levels.grey), -1) / (255.0 * FINE_STEPS)
    moments, light = np.concatenate([seconds, moments]), np.concatenate([light, between])
    order = np.argsort(moments)
    return light[order], moments[order]


def compared(frames: Frames, seconds: Reals, edges: Reals, true: Counts) -> dict[str, float]:
    """Return the errors of frames alone and with sub-steps."""
    levels = levels_between(frames, (0, 0, *frames.shape[1:]), np.arange(len(frames)), SUBSTEP_PX, motions(frames))
    found: dict[str, float] = {"substeps": 1 + (0 if levels is None else len(levels.grey) / (len(frames) - 1))}
    for name, between in (("linear", None), ("divided", levels)):
        light, moments = light_of(frames, between, seconds)
        wrong: Errors = errors(counts_of(log_levels(light), moments, edges, THRESHOLD), true)
        found |= {f"{key}_{name}": value for key, value in asdict(wrong).items()}
    return found


def rendered(side: int = 160, steps: int = 4) -> Iterator[dict[str, Any]]:
    """Yield one record for each scene, speed and bin."""
    seconds = np.arange(steps + 1) / FRAMES_PER_SECOND
    bins = {"frame": seconds, "10 ms": np.arange(0.0, seconds[-1] + 1e-9, BIN_SECONDS)}
    for name in NAMES:
        for px in SPEEDS_PX if name in PHOTOGRAPHS else OTHER_SPEEDS_PX:
            progress(f"{name}, {px:g} px a frame")
            scene = rendered_scene(name, side, side, px * FRAMES_PER_SECOND)
            frames = scene.frames(FRAMES_PER_SECOND, steps + 1)
            for size, edges in bins.items():
                true = scene.counts(edges, THRESHOLD, FRAMES_PER_SECOND * max(24, round(8 * px)))
                found = compared(frames, seconds, edges, true)
                yield {
                    "measure": "rendered", "scene": name, "px_per_frame": px, "bin": size,
                    "frames_per_second": FRAMES_PER_SECOND,
                    **found,
                }  # fmt: skip


def filmed(path: Path) -> Iterator[dict[str, Any]]:
    """Yield one record for each n: every n-th frame against all of them, in bins of n frames, where most changes.

    Raises:
        V2VError: the video cannot be read, or is too short or too small.
    """
    facts, count = probe(path), max(EVERY) * VIDEO_STEPS + 1
    if facts.frames < count:
        raise UsageError(f"--video {path}: {facts.frames} frames; give {count} or more")
    frames = liveliest(decode_luma(path, facts.index, 0, count).frames, VIDEO_SIDE_PX)
    seconds = np.arange(count) / facts.frames_per_second
    for every in EVERY:
        true = counts_of(log_levels(frames.reshape(count, -1) / 255.0), seconds, seconds[::every], THRESHOLD)
        found = compared(frames[::every], seconds[::every], seconds[::every], true)
        yield {
            "measure": "film", "scene": path.name, "bin": "frame",
            "frames_per_second": facts.frames_per_second / every, **found,
        }  # fmt: skip


def missed(records: Records) -> list[str]:
    """Return the bars that the mean of the moving photographs misses."""
    texts: list[str] = []
    cells: dict[tuple[str, float], Records] = {}
    for record in records:
        if record.get("scene") in PHOTOGRAPHS:
            cells.setdefault((record["bin"], record["px_per_frame"]), []).append(record)
    for (size, px), found in cells.items():
        mean = {key: float(np.mean([each[key] for each in found])) for key in found[0] if key.endswith(("ear", "ded"))}
        signed, split = BARS.get((size, px), (9.0, 9.0))
        if px < SLOW_PX:
            signed = mean["signed_linear"] + 1e-9
        texts += beyond(f"bins of {size} at {px:g} px", mean, most={"signed_divided": signed, "split_divided": split})
    return texts


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--video", action="append", default=[], type=Path, metavar="FILE", help="film of high rate")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    scenes = list(rendered())
    records = scenes + [each for path in asked.video for each in filmed(path)]
    return Report(records, [(records, _COLUMNS)], missed=missed(scenes))
