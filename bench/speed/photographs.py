"""Measure the processor time of a sample of photographs, beside one of the paper's recipe from a dense store.

    python -m bench photographs --photographs DIR --videos DIR

Both have voxels and frames, of 128 x 128 px, and are made in this process, decoding included, in turns. Those of
photographs have two patches. With ``truth`` they also have flow, flow_valid, masks and tracks; with ``exposed``, frames
blurred by 10 ms. ``fine`` is the preset ``worlds-fine``, with other shares of the threshold too. Each time is the mean
over the samples of a turn, the fastest turn; a ratio is the median over the turns.

Bar: ``photographs`` and ``fine``, at most 3.5 times a sample from the store.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import count, islice
from pathlib import Path

from bench.frame import Report, add_whole, beside, progress
from v2v_protocol.command import Parser
from v2v_protocol.recipe import preset
from v2v_protocol.sample import DEFAULT_ARRAYS
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.photographs import PhotographKind
from v2v_server.prepare import prepare
from v2v_server.store import photograph
from v2v_server.worlds.clip import TRUTH
from v2v_server.worlds.world import draw_world
from v2v_tools.remake import RemadeSample, Remaker

MOST_TIMES = 3.5
PATCHES = 2
SHARES, EXPOSURE_SECONDS = (1.0, 2.0, 4.0), 0.01


def patches_of(made: RemadeSample) -> int:
    """Return how many patches a sample of a photograph has."""
    clip, params = made.job.clip, made.decoded.plan.params
    size = clip.height_px, clip.width_px
    names = {"seed": clip.seed, "epoch": clip.epoch, "index": made.job.index}
    world = draw_world(clip.spec.recipe, params, **names, picture_px=size, seconds=(0.0, 1.0))
    return len(world.layers) - 1


def seconds_of(remaker: Remaker, seeds: list[int]) -> float:
    """Return the mean processor time of the first sample of each seed, decoding included."""
    begun = time.process_time()
    for seed in seeds:
        photograph.kept_photographs.clear()
        remaker.sample(seed, 0, 0)
    return (time.process_time() - begun) / len(seeds)


def turns(asked: argparse.Namespace, folder: Path) -> Iterator[dict[str, float]]:
    """Yield the times of each turn, by what is made."""
    with closing(open_catalogue(asked.videos, processes=0)) as videos:
        progress("preparing the dense store")
        prepare(videos, folder / "store", "dense", processes=0)
    kind, spec = PhotographKind(), StreamSpec(preset("worlds").replace(world_patches=PATCHES))
    fine = preset("worlds-fine").replace(world_patches=PATCHES)
    exposed = StreamSpec(spec.recipe.replace(exposure_seconds=EXPOSURE_SECONDS))
    with (
        closing(open_catalogue(folder / "store", cache_dir=folder, processes=0)) as store,
        closing(open_catalogue(asked.photographs, cache_dir=folder, kind=kind, processes=0)) as photographs,
    ):
        plain = Remaker(photographs, spec)
        moving = (seed for seed in count() if patches_of(plain.made(seed, 0, 0)) == PATCHES)
        seeds = list(islice(moving, asked.samples))
        works = {
            "dense store": (Remaker(store, StreamSpec()), list(range(asked.samples))),
            "photographs": (plain, seeds),
            "photographs, truth": (Remaker(photographs, spec, (*DEFAULT_ARRAYS, *TRUTH)), seeds),
            "photographs, exposed": (Remaker(photographs, exposed, (*DEFAULT_ARRAYS, "frames_blurred")), seeds),
            **{
                f"photographs, fine, {share:g}": (
                    Remaker(photographs, StreamSpec(fine.replace(world_change_share=share))),
                    seeds,
                )
                for share in (fine.world_change_share, *SHARES)
            },
        }
        for remaker, some in works.values():
            seconds_of(remaker, some)  # loads or compiles the kernels
        for turn in range(asked.turns):
            progress(f"turn {turn + 1} of {asked.turns}")
            yield {name: seconds_of(*work) for name, work in works.items()}


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--photographs", required=True, metavar="DIR", help="photographs")
    parser.add_argument("--videos", required=True, metavar="DIR", help="videos for the store")
    add_whole(parser, "--samples", 24, "samples of a turn")
    add_whole(parser, "--turns", 5, "turns")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with tempfile.TemporaryDirectory(prefix="v2v-photographs-") as folder:
        made = list(turns(asked, Path(folder)))
    judged = "photographs", f"photographs, fine, {preset('worlds-fine').world_change_share:g}"
    return beside(made, "dense store", dict.fromkeys(judged, MOST_TIMES))
