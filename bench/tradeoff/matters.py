"""What of the stream matters to a network: the same small FireNet, trained with one thing of the stream changed.

    v2v-bench matters --videos DIR --held-out OTHER --lpips squeeze BACKBONE HEADS --seeds 0,1,2 --json FILE

`firenet-cpu` (trainer/configs) from random weights, on smaller and shorter samples (4 x 10 voxel grids of 48 x 48 px,
one sample a decode), for a fixed number of batches. Each row changes one thing of that stream: one camera for all
samples instead of random thresholds, no noise, a corpus through H.264 (made here by `v2v-prepare --codec h264`), four
samples a decode, the effects of the preset `davis346` added. All rows of a seed begin with the same weights.
`--set` changes something in every row, such as the width of the network.

Every network is judged as by `v2v-bench learn`, on the same exact samples of videos that it never saw, under ordinary
cameras and under the paper's. A row is better or worse than the first one, by LPIPS or by correlation, if its values of
all seeds lie on one side of all of the first one's; everything else is not separated from what another seed does. With
three seeds each that happens by chance in one of ten comparisons.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import torch

from bench.accuracy.learn import held_out, score
from bench.records import Column, Record, at_least, plain_parser, run, show, write
from bench.tradeoff.training_trade import seeds, train
from trainer.config_file import load_config
from trainer.losses.lpips import LPIPS
from trainer.run.checkpoint import LAST
from trainer.weights import load_network
from v2v_client.local_server import LocalServer, recipe_flags
from v2v_protocol.errors import V2VError
from v2v_protocol.presets import PRESET_FIELDS
from v2v_protocol.recipe import EFFECTS, Recipe
from v2v_protocol.settings import settings_of

CONFIGURATION = "firenet-cpu"
STREAM: Mapping[str, Any] = {
    "stream.batch_size": 4,
    "stream.recipe.voxels_per_clip": 10,
    "stream.recipe.crop_height_px": 48,
    "stream.recipe.crop_width_px": 48,
    "stream.spec.samples_per_decode": 1,
    "stream.timeout_seconds": 3600,
    "optimizer.learning_rate": 2e-3,
    "optimizer.learning_rate_decay": 1.0,
    "optimizer.ema_decay": 0.97,
    "run.judge_every": 0,
    "run.preview_every": 0,
}
"""What differs from the configuration in every row, so that a run takes a minute."""


class Change(NamedTuple):
    """One row.

    Attributes:
        settings: of `v2v-train`.
        lossy: through H.264.
    """

    settings: Mapping[str, Any]
    lossy: bool = False


def _effects() -> dict[str, Any]:
    names = {name for name, setting in settings_of(Recipe).items() if setting.group == EFFECTS}
    return {f"stream.recipe.{name}": list(span) for name, span in PRESET_FIELDS["davis346"].items() if name in names}


def _flags(settings: Mapping[str, Any]) -> list[str]:
    return [f"{key}={json.dumps(value)}" for key, value in settings.items()]


AS_IT_IS = "as it is"
CHANGES: Mapping[str, Change] = {
    AS_IT_IS: Change({}),
    "one threshold": Change({"stream.recipe.threshold": [0.2, 0.2], "stream.recipe.threshold_ratio": [1.0, 1.0]}),
    "no noise": Change({"stream.recipe.noise_sigma": [0.0, 0.0], "stream.recipe.hot_pixel_share": [0.0, 0.0]}),
    "lossy corpus": Change({}, lossy=True),
    "4 samples a decode": Change({"stream.spec.samples_per_decode": 4}),
    "effects": Change(_effects()),
}

_COLUMNS: tuple[Column, ...] = (
    ("change", "stream", "{}", 1.0),
    ("cameras", "cameras", "{}", 1.0),
    ("seeds", "seeds", "{}", 1.0),
    ("lpips", "LPIPS", "{:.3f}", 1.0),
    ("lowest_lpips", "lowest", "{:.3f}", 1.0),
    ("highest_lpips", "highest", "{:.3f}", 1.0),
    ("lpips_verdict", "against the first row", "{}", 1.0),
    ("correlation", "correlation", "{:.3f}", 1.0),
    ("lowest_correlation", "lowest", "{:.3f}", 1.0),
    ("highest_correlation", "highest", "{:.3f}", 1.0),
    ("correlation_verdict", "against the first row", "{}", 1.0),
)

Scores = dict[tuple[str, str], list[dict[str, float]]]
"""By change and cameras, one for each seed so far."""


def verdict(ours: Sequence[float], theirs: Sequence[float]) -> str:
    """Whether all of ``ours`` lie on one side of all of ``theirs``; lower is better."""
    if max(ours) < min(theirs):
        return "better"
    return "worse" if min(ours) > max(theirs) else "not separated"


def summary(found: Scores) -> list[Record]:
    """One flat record for each change and sort of cameras: medians and ranges over the seeds."""
    records: list[Record] = []
    for (change, cameras), scores in found.items():
        record: dict[str, Any] = {"change": change, "cameras": cameras, "seeds": len(scores)}
        for name in ("lpips", "correlation"):
            values = [each[name] for each in scores]
            record |= {name: statistics.median(values), f"lowest_{name}": min(values), f"highest_{name}": max(values)}
        if change != AS_IT_IS:
            for name, sign in (("lpips", 1), ("correlation", -1)):
                ours, theirs = ([sign * each[name] for each in found[key, cameras]] for key in (change, AS_IT_IS))
                record[f"{name}_verdict"] = verdict(ours, theirs)
        records.append(record)
    return records


def _lossy(videos: str, folder: Path) -> str:
    """A copy of the videos through H.264.

    Raises:
        V2VError: none could be prepared; what `v2v-prepare` said.
    """
    command = [sys.executable, "-m", "v2v_server.commands.prepare", videos, str(folder), "--codec", "h264"]
    done = subprocess.run([*command, "--scene", "auto", "--workers", "1"], capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):  # 1: some were not, as a damaged video
        raise V2VError(f"v2v-prepare {videos}: status {done.returncode}: {done.stderr.strip()[-500:]}")
    return str(folder)


def compare(asked: argparse.Namespace) -> list[Record]:
    """Trains and judges all rows, seed after seed; what there is so far is written after each of them."""
    name, *files = asked.lpips
    lpips = LPIPS.from_files(name, *files)
    loss = dict(zip(("loss.lpips_network", "loss.lpips_backbone", "loss.lpips_heads"), asked.lpips, strict=True))
    judges = held_out(asked.held_out, asked.samples)
    found: Scores = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="v2v-matters-")))

        def served(videos: str, cache: str) -> str:
            """The address of a server that decodes every clip once, so that the rows share the processor time."""
            recipe = load_config(CONFIGURATION, _flags(STREAM)).stream.resolved_recipe
            flags = ["--scene", "auto", "--cache", str(folder / cache), "--lease-deadline-seconds", "3600"]
            flags += recipe_flags(recipe)
            return stack.enter_context(LocalServer(videos, workers=1, flags=flags)).address

        address = served(asked.videos, "cache")
        lossy = served(asked.lossy or _lossy(asked.videos, folder / "lossy"), "lossy-cache")
        for seed in asked.seeds:
            for change, (settings, through_h264) in CHANGES.items():
                out = folder / f"{change}-{seed}"
                everything = _flags({**STREAM, **loss, "run.steps": asked.steps, **settings}) + asked.changes
                train(lossy if through_h264 else address, CONFIGURATION, change, seed, everything, out)
                network = load_network(out / LAST, ema=True)[0]
                for cameras, (voxels, frames) in judges.items():
                    scores = score(network.forward_sequence, voxels, frames, lpips)
                    found.setdefault((change, cameras), []).append(scores)
                    words = f"LPIPS {scores['lpips']:.3f}, correlation {scores['correlation']:.3f}"
                    print(f"{change}, seed {seed}, {cameras} cameras: {words}", file=sys.stderr, flush=True)
                write(summary(found), asked.json)
    return summary(found)


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, samples=1, steps=1)
    torch.set_num_threads(1)
    show(compare(asked), _COLUMNS)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns 0, or 2 (wrong usage or input, a training that failed)."""
    parser = plain_parser(__doc__, "matters")
    parser.add_argument("--videos", required=True, metavar="DIR", help="to train on")
    parser.add_argument("--held-out", required=True, metavar="DIR", help="videos to judge by")
    parser.add_argument(
        "--lpips", nargs=3, required=True, metavar=("NET", "BACKBONE", "HEADS"),
        help="alex, squeeze or vgg with its weight files: of the loss, and to judge by",
    )  # fmt: skip
    parser.add_argument(
        "--lossy", metavar="DIR", help="the videos through `v2v-prepare --codec h264`, if you have them (default: made)"
    )
    parser.add_argument(
        "--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="of v2v-train, in every row"
    )
    parser.add_argument("--seeds", type=seeds, default=(0, 1, 2), metavar="0,1,2")
    parser.add_argument("--steps", type=int, default=200, help="batches of each training (default 200)")
    parser.add_argument("--samples", type=int, default=12, help="held-out samples of each sort of cameras (default 12)")
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
