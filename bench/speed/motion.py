"""Measure what sub-steps, or colour, cost a worker: samples with them against those without, from source and store.

    python -m bench motion --video gopro_hero7_walk.mp4 --json motion.json
    python -m bench motion --video gopro_hero7_walk.mp4 --colour

The walking clip is ``--video``; the still one repeats its first frame. Each is decoded from the source, and read from a
store without and with the motion. A turn makes the same samples with and without ``substep_px``; times are processor
times of one thread, and a ratio is the median of those within turns. Baseline: the samples of the same form without
``substep_px``. Bars: 5 for the walking clip from a store with motion, 2 from its source; 1.05 and 1.03 for the still
one. With ``--colour`` the samples have ``frames_rgb`` beside ``frames``; bars: 1.4 from the source, 1.25 from a store
with chroma.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bench.frame import Column, Report, add_whole, progress
from tests.clips import write_clip
from tests.oracles.decoded import decode_luma
from tests.oracles.leases import open_leases, whole_sample
from v2v_protocol.command import Parser
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.prepare import prepare
from v2v_server.video.probe import probe

BARS = {("walking", "source"): 2.0, ("walking", "motion"): 5.0, ("still", "source"): 1.15, ("still", "motion"): 1.05}
COLOUR_BARS = {("walking", "source"): 1.4, ("walking", "chroma"): 1.4}
STILL_FRAMES, SUBSTEP_PX = 240, 1.0
_COLUMNS: tuple[Column, ...] = (
    ("clip", "clip", "{}", 1),
    ("form", "form", "{}", 1),
    ("plain_seconds", "without, ms a sample", "{:.1f}", 1e3),
    ("divided_seconds", "with", "{:.1f}", 1e3),
    ("ratio", "ratio", "{:.2f}", 1),
)


def forms_of(video: Path, folder: Path, colour: bool) -> Iterator[tuple[str, str, Path]]:
    """Yield clip, form and corpus folder of each contender, after making it."""
    facts = probe(video)
    first = decode_luma(video, facts.index, 0, 1).frames
    for clip in ("walking",) if colour else ("walking", "still"):
        source = folder / clip / "source"
        source.mkdir(parents=True)
        if clip == "walking":
            os.symlink(video.resolve(), source / video.name)
        else:
            write_clip(source / "still.mp4", np.repeat(first, STILL_FRAMES, axis=0), gop=250, rate=30)
        yield clip, "source", source
        for form in ("chroma",) if colour else ("store", "motion"):
            progress(f"{clip}: preparing {form}")
            planes = () if form == "store" else (form,)
            with closing(open_catalogue(source, processes=0)) as catalogue:
                target = folder / clip / form
                prepare(catalogue, target, planes=planes, processes=0)
            yield clip, form, target


def sample_seconds(root: Path, leases: Sequence[Lease]) -> float:
    """Return the processor time of a sample, the mean of some."""
    begin = time.process_time()
    for lease in leases:
        whole_sample(lease, root)
    return (time.process_time() - begin) / len(leases)


def compared(asked: argparse.Namespace, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the record of each clip and form."""
    for clip, form, videos in forms_of(asked.video, folder, asked.colour):
        progress(f"{clip}, {form}")
        works = []
        for substep_px, more in (
            (0.0, ()),
            (0.0, ("frames_rgb",)) if asked.colour else (SUBSTEP_PX, ()),
        ):
            with open_leases(videos, "full", StreamSpec(substep_px=substep_px)) as (root, leases):
                taken = [replace(each, arrays=(*each.arrays, *more)) for each in islice(leases, 3)]
                works.append(partial(sample_seconds, root, taken))
        for work in works:
            work()  # loads or compiles the kernels
        turns = [[work() for work in works] for _ in range(asked.turns)]
        yield {
            "measure": "colour" if asked.colour else "sub-steps", "clip": clip, "form": form,
            "substep_px": 0.0 if asked.colour else SUBSTEP_PX,
            "plain_seconds": min(turn[0] for turn in turns), "divided_seconds": min(turn[1] for turn in turns),
            "ratio": statistics.median(turn[1] / turn[0] for turn in turns),
        }  # fmt: skip


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--video", type=Path, required=True, metavar="FILE", help="film of someone who walks")
    parser.add_argument("--colour", action="store_true", help="measure frames_rgb in place of sub-steps")
    add_whole(parser, "--turns", 7, "turns")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with tempfile.TemporaryDirectory(prefix="v2v-motion-") as folder:
        records = list(compared(asked, Path(folder)))
    missed = [
        f"{found['clip']} clip, {found['form']}: {found['ratio']:.2f} times the plain sample; the bar is {bar}"
        for found in records
        if (bar := (COLOUR_BARS if asked.colour else BARS).get((found["clip"], found["form"]))) is not None
        and found["ratio"] > bar
    ]
    return Report(records, [(records, _COLUMNS)], [], missed)
