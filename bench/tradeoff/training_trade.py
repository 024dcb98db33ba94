"""What a faster preset costs a network: the same small network trained under each, judged on exact clips it never saw.

    v2v-bench training_trade --videos DIR --held-out DIR --seeds 0,1,2 --steps 60 --seconds 40 --json FILE

`tiny-cpu` (trainer/configs) is trained under every speed preset and seed, once for a fixed number of batches (equal
samples) and once for a fixed time (equal wall time, server start included in neither). Every network is then judged by
its mean absolute error on the same exact samples of the held-out videos, as a share of the error of a constant picture
(the mean of the very frames it is judged on), and by the correlation of its pictures with the true ones: events tell
contrast, not brightness, so that a network this small is better at the second. The spread over seeds is the scale for
everything else in the table.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from bench.records import Column, at_least, parser_of, run, show, write
from trainer.config_file import load_config
from trainer.models import NETWORKS
from trainer.run.checkpoint import LAST, load_checkpoint
from trainer.weights import load_into
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import V2VError
from v2v_protocol.spec import SPEED_PRESETS

CONFIGURATION = "tiny-cpu"
_JUDGE_SEED = 2**32
_SIDE_PX = 128
_LEAST_SCALE = 1e-12

_COLUMNS: tuple[Column, ...] = (
    ("preset", "preset", "{}", 1.0),
    ("limit", "trained for", "{}", 1.0),
    ("steps", "batches", "{:.0f}", 1.0),
    ("correlation", "correlation", "{:.3f}", 1.0),
    ("lowest_correlation", "lowest", "{:.3f}", 1.0),
    ("highest_correlation", "highest", "{:.3f}", 1.0),
    ("error_of_constant", "of constant", "{:.1%}", 1.0),
    ("lowest_error", "lowest", "{:.1%}", 1.0),
    ("highest_error", "highest", "{:.1%}", 1.0),
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


class Judgement(NamedTuple):
    """How good a trained network is.

    Attributes:
        error_of_constant: mean absolute error, as a share of that of the mean grey of these very frames.
        correlation: Pearson's, of prediction and target within a frame; the mean over the later half of every clip's
            frames, when the network has seen enough events. 0 for a constant picture.
    """

    error_of_constant: float
    correlation: float


def judge(prediction: torch.Tensor, target: torch.Tensor) -> Judgement:
    """Compare pictures, both [B, T, 1, H, W] float."""
    error = (prediction - target).abs().mean() / (target.mean() - target).abs().mean()
    ours, truth = ((frames - frames.mean(-1, keepdim=True)) for frames in (prediction.flatten(2), target.flatten(2)))
    scale = (ours.norm(dim=-1) * truth.norm(dim=-1)).clamp_min(_LEAST_SCALE)
    correlation = (ours * truth).sum(-1) / scale
    return Judgement(float(error), float(correlation[:, target.shape[1] // 2 :].mean()))


def judge_weights(weights: Path, batches: Sequence[Batch]) -> Judgement:
    """Run a trained network on the voxels of some batches and compare with their frames."""
    config = load_config(CONFIGURATION)
    network = NETWORKS[config.network.name](bins=config.stream.resolved_recipe.bins, **config.network.options)
    load_into(network, weights, ema=True)
    with torch.no_grad():
        prediction = torch.cat([network.forward_sequence(batch.arrays["voxels"]) for batch in batches])
    return judge(prediction, torch.cat([batch.arrays["frames"] for batch in batches]) / 255.0)


def train(address: str, configuration: str, name: str, seed: int, settings: Sequence[str], out: Path) -> int:
    """One run of `v2v-train`, called ``name`` where it fails; returns the number of steps.

    Raises:
        TrainingFailed: it ended with another status than 0.
    """
    settings = [f"stream.seed={seed}", f"compute.seed={seed}", *settings]
    command = [sys.executable, "-m", "trainer.train", configuration, "--connect", address, "--out", str(out)]
    done = subprocess.run(
        [*command, *(part for setting in settings for part in ("--set", setting))],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise TrainingFailed(f"{name}, seed {seed}: status {done.returncode}: {done.stderr.strip()[-500:]}")
    return load_checkpoint(out / LAST).step


def compare(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """One flat record for each preset and limit, medians over the seeds."""
    judges = held_out(asked.held_out, asked.samples)
    limits: dict[str, tuple[str, ...]] = {f"{asked.seconds:g} s": (f"run.seconds={asked.seconds:g}",)}
    if asked.steps:
        limits = {f"{asked.steps} batches": (f"run.steps={asked.steps}", "run.seconds=0")} | limits
    found: dict[tuple[str, str], list[tuple[int, Judgement]]] = {}
    with (
        LocalServer(asked.videos, workers=asked.workers, flags=["--rows", asked.rows]) as server,
        tempfile.TemporaryDirectory(prefix="v2v-training-trade-") as folder,
    ):
        for seed in asked.seeds:
            for limit, settings in limits.items():
                for preset in SPEED_PRESETS:
                    out = Path(folder) / f"{preset}-{seed}-{settings[0]}"
                    changes = (f"stream.spec={{preset: {preset}}}", *settings)
                    steps = train(server.address, CONFIGURATION, preset, seed, changes, out)
                    judgement = judge_weights(out / LAST, judges)
                    found.setdefault((preset, limit), []).append((steps, judgement))
                    words = f"{judgement.correlation:.3f}, {judgement.error_of_constant:.1%} of constant"
                    print(f"{preset}, seed {seed}, {limit}: {steps} batches, {words}", file=sys.stderr, flush=True)
    return [
        {"preset": preset, "limit": limit, "seeds": len(runs), "samples": asked.samples} | _summary(runs)
        for (preset, limit), runs in found.items()
    ]


def _summary(runs: Sequence[tuple[int, Judgement]]) -> dict[str, float]:
    errors = [judgement.error_of_constant for _, judgement in runs]
    correlations = [judgement.correlation for _, judgement in runs]
    return {
        "steps": statistics.median(steps for steps, _ in runs),
        "error_of_constant": statistics.median(errors),
        "lowest_error": min(errors),
        "highest_error": max(errors),
        "correlation": statistics.median(correlations),
        "lowest_correlation": min(correlations),
        "highest_correlation": max(correlations),
    }


def seeds(text: str) -> tuple[int, ...]:
    """An argparse type: numbers separated by commas."""
    return tuple(int(part) for part in text.split(","))


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, workers=1, samples=1, steps=0)
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
    parser.add_argument("--seeds", type=seeds, default=(0, 1, 2), metavar="0,1,2")
    parser.add_argument(
        "--steps", type=int, default=60, help="batches of each run of equal samples (default 60; 0: none)"
    )
    parser.add_argument("--samples", type=int, default=24, help="held-out samples (default 24)")
    parser.add_argument("--workers", type=int, default=1)
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
