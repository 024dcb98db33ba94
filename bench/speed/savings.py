"""Measure what each saving saves that models only what a scene requires, and what it costs.

    python -m bench savings --video FILE --videos DIR --json savings.json

In turns, with processor times of one thread: the paper's kernel against the general one, both in float32, and float32
against float64, on the same clip with noise; a sample with sub-steps of a still clip, the first frame of ``--video``,
from a store with motion, against one that reads the margin for sub-steps all the same; and the flow of ``--videos``
with scene "auto" against "off" (``bench scene``). "saved" is the median over the turns of the time that is left, taken
from 1. "cost" is the share of bins that differ, for flow the median of the endpoint error that is added, px.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from bench.accuracy import scene
from bench.frame import Column, Report, add_videos, add_whole, progress, ratios
from bench.speed.kernel import SIDE_PX, STEPS, textured_frames
from bench.speed.motion import STILL_FRAMES, SUBSTEP_PX, sample_seconds
from tests.clips import write_clip
from tests.oracles.decoded import decode_luma
from tests.oracles.leases import open_leases, whole_sample
from v2v_protocol.command import Parser
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.prepare import prepare
from v2v_server.simulation import Voxels, simulate
from v2v_server.video.probe import probe
from v2v_server.worker.making import read
from v2v_server.worker.making.plan import SamplePlan, plan_sample

_COLUMNS: tuple[Column, ...] = (
    ("saving", "saving", "{}", 1),
    ("beside", "beside", "{}", 1),
    ("saved", "saved", "{:.0%}", 1),
    ("bins_share", "bins that differ", "{:.4%}", 1),
    ("added_px", "added error px", "{:+.3f}", 1),
)


def compared(mine: Callable[[], object], other: Callable[[], object], turns: int) -> dict[str, float]:
    """Return the share of the processor time of ``other`` that ``mine`` saves."""
    seconds: list[list[float]] = [[], []]
    for turn in range(turns + 1):
        for work, taken in list(zip((mine, other), seconds, strict=True))[:: 1 - 2 * (turn % 2)]:
            begin = time.process_time()
            work()
            taken.append(time.process_time() - begin)
    found = ratios("left", *(taken[1:] for taken in seconds))  # the first turn compiles
    return {"saved": 1.0 - found["left"]}


def of_kernels(turns: int) -> Iterator[dict[str, Any]]:
    """Yield the records of the kernels."""
    camera: dict[str, Any] = {"threshold_pos": 0.2, "noise_sigma": 0.05, "seed": 1}
    frames = textured_frames()

    def general(made: Voxels) -> np.ndarray[Any, Any]:
        counts = made.array("event_counts").astype(np.int64)
        return counts[:, 1] - counts[:, 0]

    made = simulate(frames, **camera, precision="float32")
    wide = partial(simulate, frames, **camera, precision="float64")
    for saving, beside, work, other in (
        ("the paper's kernel", "the general kernel", lambda: made.array("voxels"), lambda: general(made)),
        ("float32", "float64", partial(simulate, frames, **camera, precision="float32"), wide),
    ):
        differ = np.asarray(general(made) if other is not wide else wide().voxels) != made.voxels
        yield {"saving": saving, "beside": beside, **compared(work, other, turns), "bins_share": float(differ.mean())}


def of_margins(video: Path, turns: int) -> dict[str, Any]:
    """Return the record of the margin of a still clip."""

    def reading_all(*args: Any) -> SamplePlan:
        plan = plan_sample(*args)
        return dataclasses.replace(plan, cut=dataclasses.replace(plan.cut, still=None))

    with tempfile.TemporaryDirectory(prefix="v2v-savings-") as name:
        source, store = Path(name) / "source", Path(name) / "store"
        first = decode_luma(video, probe(video).index, 0, 1).frames
        write_clip(source / "still.mp4", np.repeat(first, STILL_FRAMES, axis=0), gop=250, rate=30)
        with closing(open_catalogue(source, processes=0)) as catalogue:
            prepare(catalogue, store, planes=("motion",), processes=0)
        with open_leases(store, "full", StreamSpec(substep_px=SUBSTEP_PX)) as (root, leases):
            taken = list(islice(leases, 3))

            def with_margin() -> None:
                with mock.patch.object(read, "plan_sample", reading_all):
                    sample_seconds(root, taken)

            found = compared(partial(sample_seconds, root, taken), with_margin, turns)
            mine = whole_sample(taken[0], root).arrays["voxels"]
            with mock.patch.object(read, "plan_sample", reading_all):
                differ = whole_sample(taken[0], root).arrays["voxels"] != mine
    return {"saving": "no margin of a still clip", "beside": "its margin", **found, "bins_share": float(differ.mean())}


def of_scenes(asked: argparse.Namespace) -> dict[str, Any]:
    """Return the record of ``scene: auto``, from ``bench scene``."""
    total = scene.measure(argparse.Namespace(videos=asked.videos, sequences=1)).records[0]
    return {
        "saving": "flow with scene auto", "beside": "scene off", "saved": total["saved_share"],
        "added_px": total["added_error_median_px"],
    }  # fmt: skip


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--video", type=Path, required=True, metavar="FILE", help="its first frame is the still clip")
    add_videos(parser, "videos whose flow is measured")
    add_whole(parser, "--turns", 7, "turns")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = list(of_kernels(asked.turns))
    progress("still clip")
    records.append(of_margins(asked.video, asked.turns))
    progress("flow")
    records.append(of_scenes(asked))
    return Report(records, [(records, _COLUMNS)], [f"the clip of the kernels: {STEPS} steps of {SIDE_PX}x{SIDE_PX} px"])
