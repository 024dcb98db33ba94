"""Measure what a sample of a folder of pictures costs, by the number of pictures (``--videos-kind sequences``).

    python -m bench sequences --json sequences.json

Samples of small pictures, from folders that the bench writes, by a worker's code in this process: in turns, processor
time after the first sample of each folder, which lists it.

Bar: a sample of the largest folder takes at most 1.2 times the time of one of the smallest, the median of the turns.
"""

from __future__ import annotations

import argparse
import io
import itertools
import tempfile
import time
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
from PIL import Image

from bench.frame import Column, Report, add_whole, beyond, medians, ratios
from v2v_protocol.command import Parser
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.sequences import SequenceKind
from v2v_tools.remake import Remaker

HEIGHT_PX, WIDTH_PX, PATTERNS, MOST_RATIO = 64, 96, 50, 1.2
SETTLED_SECONDS = 2.5
"""A folder that has just changed is listed for each sample."""
_COLUMNS: tuple[Column, ...] = (
    ("pictures", "pictures", "{}", 1),
    ("open_seconds", "first start s", "{:.1f}", 1),
    ("first_seconds", "first sample ms", "{:.1f}", 1e3),
    ("sample_seconds", "sample ms", "{:.2f}", 1e3),
    ("ratio", "of fewest", "{:.2f}", 1),
    ("ratio_lowest", "lowest", "{:.2f}", 1),
    ("ratio_highest", "highest", "{:.2f}", 1),
)


def write_pictures(folder: Path, count: int) -> None:
    """Write pictures of a pattern that moves."""
    folder.mkdir(parents=True)
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    encoded = []
    for number in range(PATTERNS):
        file, wave = io.BytesIO(), 110 + 60 * np.sin(x / 6 + 2 * np.pi * number / PATTERNS) + 30 * np.cos(y / 5)
        Image.fromarray(wave.astype(np.uint8)).save(file, "png")
        encoded.append(file.getvalue())
    for number, data in zip(range(count), itertools.cycle(encoded)):
        (folder / f"{number:06}.png").write_bytes(data)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--fewest", 500, "pictures of the smallest folder")
    add_whole(parser, "--most", 100_000, "pictures of the largest folder")
    add_whole(parser, "--turns", 9, "turns of ten samples of each folder")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench: medians over the turns."""
    recipe = {"preset": "clean", "voxels_per_clip": 4, "crop_height_px": HEIGHT_PX, "crop_width_px": WIDTH_PX}
    spec, records, remakers = StreamSpec.from_dict({"recipe": recipe}), list[dict[str, float]](), list[Remaker]()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        counts = asked.fewest, asked.most
        for count in counts:
            write_pictures(Path(folder, f"{count}", "pictures"), count)
        time.sleep(SETTLED_SECONDS)
        for count in counts:
            began, kind = time.perf_counter(), SequenceKind(25.0)
            catalogue = open_catalogue(Path(folder, f"{count}"), cache_dir=folder, kind=kind, processes=0)
            remakers.append(Remaker(opened.enter_context(closing(catalogue)), spec, ("voxels",)))
            middle = time.perf_counter()
            remakers[-1].sample(0, 0, 0)
            first_seconds = time.perf_counter() - middle
            records.append({"pictures": count, "open_seconds": middle - began, "first_seconds": first_seconds})
        turns = [[seconds_of(remaker, turn + 1) for remaker in remakers] for turn in range(asked.turns)]
    fewest, most = ([{"sample_seconds": seconds} for seconds in of] for of in zip(*turns, strict=True))
    records = [record | medians(runs) for record, runs in zip(records, (fewest, most), strict=True)]
    records[1] |= ratios("ratio", *([run["sample_seconds"] for run in runs] for runs in (most, fewest)))
    return Report(
        records, [(records, _COLUMNS)], missed=beyond(f"{asked.most} pictures", records[1], most={"ratio": MOST_RATIO})
    )


def seconds_of(remaker: Remaker, epoch: int) -> float:
    """Return the processor time of one sample, the mean of ten."""
    began = time.process_time()
    for index in range(10):
        remaker.sample(0, epoch, index % remaker.count)
    return (time.process_time() - began) / 10
