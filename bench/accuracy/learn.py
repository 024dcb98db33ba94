"""Judge networks on simulated samples of held-out videos, by LPIPS and correlation.

    python -m bench learn --held-out DIR --photographs DIR --lpips squeeze BACKBONE HEADS \\
        --weights ours=runs/firenet/last.pt --ema-weights average=runs/firenet/last.pt \\
        --normalized-weights published=firenet.pth --json FILE

All networks get the same samples of 128 x 128 pixels and 20 voxel grids, once under each set of cameras: `ordinary`
has the ranges of `tiny-cpu` (thresholds .1 to .4, little noise, no pauses), `paper` those of the paper (thresholds .05
to 3, noise, hot pixels, pauses), and `worlds` the ordinary ranges over photographs that move. Only the later half of
every clip counts, where a network has seen enough events. The baseline is a constant picture: the mean grey of the
judged frames.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.frame import Column, Record, Report, add_whole
from bench.processes import endless
from trainer.evaluation.metrics import Metric, make_metrics
from trainer.losses.backbones import BACKBONES
from trainer.models import VoxelNetwork
from trainer.weights import load_network
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import PRESET_FIELDS, Recipe

SIDE_PX = 128
STEPS = 20
_ORDINARY: Mapping[str, Any] = {"threshold": (0.1, 0.4), "noise_sigma": (0.0, 0.02), "pause_probability": 0.0}
CLIPS: Mapping[str, Mapping[str, Any]] = {"ordinary": _ORDINARY, "paper": {}}
PHOTOGRAPHS: Mapping[str, Mapping[str, Any]] = {"worlds": {**PRESET_FIELDS["worlds"], **_ORDINARY}}
"""Recipe fields of each set of cameras, for clips and for photographs."""
_SEED = 2**32
_BATCH = 4
_GREY = "constant grey"

_COLUMNS: tuple[Column, ...] = (
    ("network", "network", "{}", 1.0),
    ("cameras", "cameras", "{}", 1.0),
    ("samples", "samples", "{:.0f}", 1.0),
    *((f"lpips_{net}", f"LPIPS {net}", "{:.4f}", 1.0) for net in BACKBONES),
    ("correlation", "correlation", "{:.4f}", 1.0),
    ("mse", "MSE", "{:.4f}", 1.0),
)

Predict = Callable[[Tensor], Tensor]
Samples = tuple[Tensor, Tensor]


def held_out(videos: str, kind: str, cameras: Mapping[str, Mapping[str, Any]], samples: int) -> dict[str, Samples]:
    """Return the samples to judge by, by set of cameras: voxels int8 [N, T, bins, H, W], frames [N, T, 1, H, W]."""
    recipes = {
        name: Recipe(voxels_per_clip=STEPS, crop_height_px=SIDE_PX, crop_width_px=SIDE_PX, **changes)
        for name, changes in cameras.items()
    }
    flags = ["--videos-kind", kind, "--preset", "worlds" if kind == "photographs" else "exact"]
    with LocalServer(videos, workers=1, flags=[*flags, "--set", f"voxels_per_clip={STEPS}"]) as server:
        return {name: _samples(server.address, recipe, samples) for name, recipe in recipes.items()}


def _samples(address: str, recipe: Recipe, samples: int) -> Samples:
    dataset = V2VStreamDataset(address, batch_size=1, recipe=recipe, seed=_SEED, preset="exact")
    with contextlib.closing(endless(dataset)) as batches:
        found = list(itertools.islice(batches, samples))
    return (
        torch.cat([batch.arrays["voxels"] for batch in found]),
        torch.cat([batch.arrays["frames"] for batch in found]) / 255.0,
    )


@torch.no_grad()
def score(predict: Predict, voxels: Tensor, frames: Tensor, metrics: Mapping[str, Metric]) -> dict[str, float]:
    """Return the means of metrics over the later half of the clips, of predicted pictures clamped to 0 .. 1."""
    later = frames.shape[1] // 2
    prediction = torch.cat([predict(piece)[:, later:] for piece in torch.split(voxels, _BATCH)]).clamp(0, 1)
    made, true = (pictures.flatten(0, 2).double().numpy() for pictures in (prediction, frames[:, later:]))
    return {
        name: float(np.mean([metric(*pair) for pair in zip(made, true, strict=True)]))
        for name, metric in metrics.items()
    }


def _grey(frames: Tensor) -> Predict:
    level = float(frames[:, frames.shape[1] // 2 :].mean())
    return lambda voxels: torch.full_like(voxels[:, :, :1], level, dtype=torch.float32)


def networks(asked: argparse.Namespace) -> dict[str, VoxelNetwork]:
    """Load the networks to judge, by their names on the command line.

    Raises:
        UsageError: no network is given, a name is given twice, or a file holds no network.
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
                raise UsageError(f"two networks are called {name!r}: give each its own name")
            found[name] = load_network(file, options=options, ema=ema)[0]
    if not found:
        raise UsageError("no network to judge: give --weights NAME=FILE")
    return found


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--held-out", required=True, metavar="DIR", help="videos that no network was trained on")
    add_networks(parser)


def add_networks(parser: Parser) -> None:
    """Add the flags of the networks to judge, the photographs to judge them on, and LPIPS."""
    parser.add_argument("--photographs", metavar="DIR", help="photographs that none was trained on: cameras `worlds`")
    for flag, what in (
        ("--weights", "a network to judge, may be repeated"),
        ("--ema-weights", "the same, the averaged weights of a checkpoint of v2v-train"),
        ("--normalized-weights", "the same, a network that normalises its input, as published FireNet does"),
    ):
        parser.add_argument(flag, action="append", default=[], metavar="NAME=FILE", help=what)
    parser.add_argument(
        "--lpips", nargs=3, metavar=("NET", "BACKBONE", "HEADS"), help="alex, squeeze or vgg with its weight files"
    )
    add_whole(parser, "--samples", 24, "samples of each set of cameras")


def measure(asked: argparse.Namespace) -> Report:
    """Judge the networks; return one record for each network and set of cameras."""
    torch.set_num_threads(1)
    judged = networks(asked)
    names = ["mse", "correlation", *([] if asked.lpips is None else [f"lpips_{asked.lpips[0]}"])]
    metrics = make_metrics(names, {} if asked.lpips is None else {asked.lpips[0]: tuple(asked.lpips[1:])})
    records: list[Record] = []
    sets = held_out(asked.held_out, "videos", CLIPS, asked.samples)
    if asked.photographs:
        sets |= held_out(asked.photographs, "photographs", PHOTOGRAPHS, asked.samples)
    for cameras, (voxels, frames) in sets.items():
        predictors: dict[str, Predict] = {_GREY: _grey(frames)}
        predictors |= {name: network.forward_sequence for name, network in judged.items()}
        for name, predict in predictors.items():
            scores = score(predict, voxels, frames, metrics)
            records.append({"network": name, "cameras": cameras, "samples": len(frames), **scores})
    return Report(records, [(records, _COLUMNS)])
