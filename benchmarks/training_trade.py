"""What a faster preset costs a network: the same small network trained under each, judged on exact clips it never saw.

    v2v-bench training_trade --videos DIR --held-out DIR --seeds 0,1,2 --steps 60 --seconds 40 --json FILE

`tiny-cpu` (trainer/configs) is trained under every speed preset and seed, once for a fixed number of batches (equal
samples) and once for a fixed time (equal wall time, server start included in neither). Every network is then judged by
its mean absolute error on the same exact samples of the held-out videos, as a share of the error of a constant picture
(the mean of the very frames it is judged on). The spread over seeds is the scale for everything else in the table.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.records import Column, parser_of, run, show, write
from trainer.checkpoint import load_checkpoint
from trainer.config_file import load_config
from trainer.models import NETWORKS
from trainer.resume import LAST
from trainer.weights import load_into
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import V2VError
from v2v_protocol.spec import SPEED_PRESETS

CONFIGURATION = "tiny-cpu"
_JUDGE_SEED = 2**32
_SIDE_PX = 128

_COLUMNS: tuple[Column, ...] = (
    ("preset", "preset", "{}", 1.0),
    ("limit", "trained for", "{}", 1.0),
    ("steps", "batches", "{:.0f}", 1.0),
    ("error_of_constant", "of constant", "{:.1%}", 1.0),
    ("lowest", "lowest", "{:.1%}", 1.0),
    ("highest", "highest", "{:.1%}", 1.0),
)


class TrainingFailed(V2VError):
    """A training run did not end well; its last words follow."""


def held_out(videos: str, samples: int) -> list[Batch]:
    """Exact samples to judge by: the same for every network."""
    config = load_config(CONFIGURATION)
    recipe = config.stream.resolved_recipe.replace(crop_height_px=_SIDE_PX, crop_width_px=_SIDE_PX)
    with LocalServer(videos, workers=1) as server:
        dataset = V2VStreamDataset(server.address, batch_size=2, recipe=recipe, seed=_JUDGE_SEED, preset="exact")

        def epochs() -> Iterator[Batch]:
            while True:
                yield from dataset

        return [batch for batch, _ in zip(epochs(), range(-(-samples // 2)), strict=False)]


def error_of_constant(weights: Path, batches: Sequence[Batch]) -> float:
    """Mean absolute error of a trained network, as a share of that of the mean grey of these very frames."""
    config = load_config(CONFIGURATION)
    network = NETWORKS[config.network.name](bins=config.stream.resolved_recipe.bins, **config.network.options)
    load_into(network, weights, ema=True)
    target = torch.cat([batch.arrays["frames"] for batch in batches]) / 255.0
    with torch.no_grad():
        prediction = torch.cat([network.forward_sequence(batch.arrays["voxels"]) for batch in batches])
    return float((prediction - target).abs().mean() / (target.mean() - target).abs().mean())


def train(address: str, preset: str, seed: int, limit: Sequence[str], out: Path) -> int:
    """One run of `v2v-train`; returns the number of steps.

    Raises:
        TrainingFailed: it ended with another status than 0.
    """
    settings = [f"stream.seed={seed}", f"compute.seed={seed}", f"stream.spec={{preset: {preset}}}", *limit]
    command = [sys.executable, "-m", "trainer.train", CONFIGURATION, "--connect", address, "--out", str(out)]
    done = subprocess.run(
        [*command, *(part for setting in settings for part in ("--set", setting))],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise TrainingFailed(f"{preset}, seed {seed}: status {done.returncode}: {done.stderr.strip()[-500:]}")
    return load_checkpoint(out / LAST).step


def compare(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """One flat record for each preset and limit, medians over the seeds."""
    judges = held_out(asked.held_out, asked.samples)
    limits = {
        f"{asked.steps} batches": (f"run.steps={asked.steps}", "run.seconds=0"),
        f"{asked.seconds:g} s": (f"run.seconds={asked.seconds:g}",),
    }
    found: dict[tuple[str, str], list[tuple[int, float]]] = {}
    with (
        LocalServer(asked.videos, workers=asked.workers, flags=["--rows", asked.rows]) as server,
        tempfile.TemporaryDirectory(prefix="v2v-training-trade-") as folder,
    ):
        for seed in asked.seeds:
            for limit, settings in limits.items():
                for preset in SPEED_PRESETS:
                    out = Path(folder) / f"{preset}-{seed}-{settings[0]}"
                    steps = train(server.address, preset, seed, settings, out)
                    error = error_of_constant(out / LAST, judges)
                    found.setdefault((preset, limit), []).append((steps, error))
                    print(f"{preset}, seed {seed}, {limit}: {steps} batches, {error:.1%}", file=sys.stderr, flush=True)
    return [
        {
            "preset": preset,
            "limit": limit,
            "steps": statistics.median(steps for steps, _ in runs),
            "error_of_constant": statistics.median(error for _, error in runs),
            "lowest": min(error for _, error in runs),
            "highest": max(error for _, error in runs),
            "seeds": len(runs),
            "samples": asked.samples,
        }
        for (preset, limit), runs in found.items()
    ]


def _seeds(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


def _work(asked: argparse.Namespace) -> int:
    torch.set_num_threads(1)
    records = compare(asked)
    show(records, _COLUMNS)
    write(records, asked.json)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = parser_of(__doc__, "training_trade", seconds=40.0, what="each run of equal time")
    parser.add_argument("--videos", required=True, help="to train on")
    parser.add_argument("--held-out", required=True, help="videos to judge by")
    parser.add_argument("--rows", default="full", help="of --videos")
    parser.add_argument("--seeds", type=_seeds, default=(0, 1, 2), metavar="0,1,2")
    parser.add_argument("--steps", type=int, default=60, help="batches of each run of equal samples (default 60)")
    parser.add_argument("--samples", type=int, default=24, help="held-out samples (default 24)")
    parser.add_argument("--workers", type=int, default=1)
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
