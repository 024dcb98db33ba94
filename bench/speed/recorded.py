"""Measure the processor time of a sample of a recording, beside one of the paper's recipe from a dense store.

    python -m bench recorded --videos DIR

The recording has 20 million events, a million a second, and 20 pictures a second, of 346 x 260 px; a grid lies between
two pictures. All samples have 40 grids of 128 x 128 px, flipped or not, and are made in this process, decoding
included, in turns. Each time is the mean over the samples of a turn, the fastest turn; a ratio is the median over the
turns.

Bar: ``recording``, at most 1.5 times a sample from the store.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from bench.frame import Report, add_whole, beside, progress
from v2v_protocol.command import Parser
from v2v_protocol.recipe import preset
from v2v_protocol.spec import StreamSpec
from v2v_recordings.block_file import EventFileWriter
from v2v_recordings.items import EventChunk, Picture, SensorSize
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.registry import kind_from
from v2v_server.prepare import prepare
from v2v_tools.remake import Remaker

MOST_TIMES = 1.5
EVENTS_A_SECOND, PICTURE_HZ, WIDTH_PX, HEIGHT_PX = 1_000_000, 20, 346, 260


def write_recording(path: Path, seconds: int) -> None:
    """Write a recording of edges that move over the sensor, and of noise."""
    rng = np.random.default_rng(1)
    with EventFileWriter(path, source=path.name, fingerprint="") as writer:
        writer.add(SensorSize(WIDTH_PX, HEIGHT_PX))
        for second in range(seconds):
            times = (
                1000 * np.sort(rng.integers(0, 10**6, EVENTS_A_SECOND)) + second * 10**9
            )  # cameras tell microseconds
            edge = (
                times // 5_000_000 + 64 * rng.integers(0, 6, len(times)) + rng.integers(0, 3, len(times))
            ) % WIDTH_PX
            x = np.where(rng.random(len(times)) < 0.8, edge, rng.integers(0, WIDTH_PX, len(times)))
            y = rng.integers(0, HEIGHT_PX, len(times))
            writer.add(EventChunk(times, x.astype(np.uint16), y.astype(np.uint16), rng.random(len(times)) < 0.5))
            for number in range(PICTURE_HZ):
                shown = (np.arange(WIDTH_PX) + 10 * number + np.arange(HEIGHT_PX)[:, None]) % 256
                writer.add(Picture(second * 10**9 + number * 10**9 // PICTURE_HZ, shown.astype(np.uint8)))


def seconds_of(remaker: Remaker, samples: int) -> float:
    """Return the mean processor time of the first sample of each seed, decoding included."""
    begun = time.process_time()
    for seed in range(samples):
        remaker.sample(seed, 0, 0)
    return (time.process_time() - begun) / samples


def turns(asked: argparse.Namespace, folder: Path) -> Iterator[dict[str, float]]:
    """Yield the times of each turn, by what is made."""
    with closing(open_catalogue(asked.videos, processes=0)) as videos:
        progress("preparing the dense store")
        prepare(videos, folder / "store", "dense", processes=0)
    progress("writing the recording")
    write_recording(folder / "recordings/a.v2ve", asked.seconds)
    spec, kind = StreamSpec(preset("recordings")), kind_from({"videos_kind": "recordings"})
    noisy = spec.recipe.replace(bin_span="events", added_sigma=(0.0, 0.1), added_hot_share=(0.0, 0.001))
    with (
        closing(open_catalogue(folder / "store", cache_dir=folder, processes=0)) as store,
        closing(open_catalogue(folder / "recordings", cache_dir=folder, kind=kind, processes=0)) as recordings,
    ):
        works = {
            "dense store": Remaker(store, StreamSpec()),
            "recording": Remaker(recordings, spec),
            "recording, interpolated": Remaker(recordings, spec, ("voxels_bilinear", "frames")),
            "recording, events and ages": Remaker(recordings, spec, ("event_counts", "time_surface")),
            "recording, as released": Remaker(recordings, StreamSpec(noisy, voxel_dtype="float32")),
        }
        for remaker in works.values():
            seconds_of(remaker, 1)  # loads or compiles the kernels
        for turn in range(asked.turns):
            progress(f"turn {turn + 1} of {asked.turns}")
            yield {name: seconds_of(remaker, asked.samples) for name, remaker in works.items()}


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--videos", required=True, metavar="DIR", help="videos for the store")
    add_whole(parser, "--samples", 8, "samples of a turn")
    add_whole(parser, "--turns", 5, "turns")
    add_whole(parser, "--seconds", 20, "length of the recording, a million events a second")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with tempfile.TemporaryDirectory(prefix="v2v-recorded-") as folder:
        made = list(turns(asked, Path(folder)))
    return beside(made, "dense store", {"recording": MOST_TIMES})
