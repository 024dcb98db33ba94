"""What networks make of clips they never saw: simulated samples of held-out videos, by LPIPS and correlation.

    v2v-bench learn --held-out DIR --lpips squeeze BACKBONE HEADS \\
        --weights ours=runs/firenet/last.pt --ema-weights average=runs/firenet/last.pt \\
        --normalized-weights published=firenet.pth --json FILE

Every network sees the same exact samples of 128 x 128 pixels and 20 voxel grids, once under each of two sorts of
cameras: `ordinary` has the ranges of `tiny-cpu` (thresholds .1 to .4, little noise, no pauses), `paper` those of the
paper (thresholds .05 to 3, noise, hot pixels, pauses). The later half of every clip counts, when a network has seen
enough events. Beside the networks stands a constant picture, the mean grey of the very frames that are judged.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.records import Column, Record, at_least, show, write
from bench.tradeoff.training_trade import judge
from trainer.losses.lpips import LPIPS
from trainer.models import VoxelNetwork
from trainer.weights import load_network
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.recipe import Recipe

SIDE_PX = 128
STEPS = 20
CAMERAS: Mapping[str, Mapping[str, Any]] = {
    "ordinary": {"threshold": (0.1, 0.4), "noise_sigma": (0.0, 0.02), "pause_probability": 0.0},
    "paper": {},
}
_SEED = 2**32
_BATCH = 4
_GREY = "constant grey"

_COLUMNS: tuple[Column, ...] = (
    ("network", "network", "{}", 1.0),
    ("cameras", "cameras", "{}", 1.0),
    ("samples", "samples", "{:.0f}", 1.0),
    ("lpips", "LPIPS", "{:.4f}", 1.0),
    ("correlation", "correlation", "{:.4f}", 1.0),
    ("mean_absolute_error", "mean absolute error", "{:.4f}", 1.0),
)

Predict = Callable[[Tensor], Tensor]


def held_out(videos: str, samples: int) -> dict[str, tuple[Tensor, Tensor]]:
    """What to judge by, the same for every network.

    Returns:
        By sort of cameras: voxels int8 [N, T, bins, H, W] and frames in 0 .. 1, [N, T, 1, H, W].
    """
    recipes = {
        name: Recipe(voxels_per_clip=STEPS, crop_height_px=SIDE_PX, crop_width_px=SIDE_PX, **changes)
        for name, changes in CAMERAS.items()
    }
    flags = ["--set", f"voxels_per_clip={STEPS}"]
    with LocalServer(videos, workers=1, flags=flags) as server:
        return {name: _samples(server.address, recipe, samples) for name, recipe in recipes.items()}


def _samples(address: str, recipe: Recipe, samples: int) -> tuple[Tensor, Tensor]:
    dataset = V2VStreamDataset(address, batch_size=1, recipe=recipe, seed=_SEED, preset="exact")
    found: list[Batch] = []
    while len(found) < samples:
        found += [batch for batch, _ in zip(dataset, range(samples - len(found)), strict=False)]
    return (
        torch.cat([batch.arrays["voxels"] for batch in found]),
        torch.cat([batch.arrays["frames"] for batch in found]) / 255.0,
    )


@torch.no_grad()
def score(predict: Predict, voxels: Tensor, frames: Tensor, lpips: LPIPS | None) -> dict[str, float]:
    """How far pictures are from the true ones: see the module; the pictures are clamped to 0 .. 1 first."""
    prediction = torch.cat([predict(piece) for piece in torch.split(voxels, _BATCH)]).clamp(0, 1)
    later = frames.shape[1] // 2
    made, true = prediction[:, later:], frames[:, later:]
    found = {
        "correlation": judge(prediction, frames).correlation,
        "mean_absolute_error": float((made - true).abs().mean()),
    }
    if lpips is not None:
        pairs = zip(torch.split(made, _BATCH), torch.split(true, _BATCH), strict=True)
        found["lpips"] = float(torch.cat([lpips(*pair) for pair in pairs]).mean())
    return found


def _grey(frames: Tensor) -> Predict:
    level = float(frames[:, frames.shape[1] // 2 :].mean())
    return lambda voxels: torch.full_like(voxels[:, :, :1], level, dtype=torch.float32)


def networks(asked: argparse.Namespace) -> dict[str, VoxelNetwork]:
    """What is to be judged, by the name on the command line.

    Raises:
        UsageError: nothing is, a name is given twice, or a file holds no network.
    """
    found: dict[str, VoxelNetwork] = {}
    for entries, options, ema in (
        (asked.weights, {}, False),
        (asked.ema_weights, {}, True),
        (asked.normalized_weights, {"normalize_voxels": True}, False),
    ):
        for entry in entries:
            name, equals, file = entry.partition("=")
            if not (name and equals and file):
                raise UsageError(f"{entry!r}: write NAME=FILE")
            if name in found:
                raise UsageError(f"two networks are called {name!r}: give each a name of its own")
            found[name] = load_network(file, options=options, ema=ema)[0]
    if not found:
        raise UsageError("no network to judge: give --weights NAME=FILE")
    return found


def compare(asked: argparse.Namespace) -> list[Record]:
    """One flat record for each network and sort of cameras."""
    judged = networks(asked)
    lpips = None if asked.lpips is None else LPIPS.from_files(*asked.lpips)
    records: list[Record] = []
    for cameras, (voxels, frames) in held_out(asked.held_out, asked.samples).items():
        predictors: dict[str, Predict] = {_GREY: _grey(frames)}
        predictors |= {name: network.forward_sequence for name, network in judged.items()}
        for name, predict in predictors.items():
            scores = score(predict, voxels, frames, lpips)
            records.append({"network": name, "cameras": cameras, "samples": len(frames), **scores})
    return records


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns 0, or 2 (wrong usage or input)."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="v2v-bench learn", description=first, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--held-out", required=True, metavar="DIR", help="videos that no network was trained on")
    for flag, what in (
        ("--weights", "to judge, repeatable"),
        ("--ema-weights", "the same, the averaged weights of a checkpoint of v2v-train"),
        ("--normalized-weights", "the same, of a network that normalises its input, as published FireNet does"),
    ):
        parser.add_argument(flag, action="append", default=[], metavar="NAME=FILE", help=what)
    parser.add_argument(
        "--lpips", nargs=3, metavar=("NET", "BACKBONE", "HEADS"), help="alex, squeeze or vgg with its weight files"
    )
    parser.add_argument("--samples", type=int, default=24, help="of each sort of cameras (default 24)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        at_least(asked, samples=1)
        records = compare(asked)
        show(records, _COLUMNS)
        write(records, asked.json)
    except (V2VError, OSError) as error:
        print(f"v2v-bench learn: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
