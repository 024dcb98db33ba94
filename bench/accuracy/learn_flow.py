"""Train EV-FlowNet on exact flow and on DIS's flow of the same photographs that move; judge both on other photographs.

    python -m bench learn_flow --photographs DIR --held-out DIR --steps 500,1000 --seed 0 --json FILE

Two networks of `evflownet-worlds` start with equal weights and see equal batches in equal order, each world once. One
learns the exact flow of pixels that are seen at both ends; the other what a stream of videos would have: the flow of
DIS (``auto``, with a margin of 32 px) between the frames, where forward and backward flow agree. `SETTINGS`
states where recipe and optimiser differ from that configuration, so that a network learns in an hour of one thread.

Errors are endpoint errors of pixels that are seen at both ends, of the networks' averaged weights. Two more methods are
judged beside them: no motion, and DIS itself, which sees the frames that the networks do not see.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from bench.accuracy.flow import MARGINS_PX, WORLD_COLUMNS, by_length
from bench.frame import Record, Report, add_whole, progress, whole_numbers
from trainer.config import TrainConfig
from trainer.config_file import load_config
from trainer.feed import HELD_OUT_SEED
from trainer.learner import build
from trainer.models import VoxelNetwork
from trainer.run.distributed import Ranks
from v2v_client import Batch, V2VDataset
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_server.flow import METHODS, choose, consistent, estimator

SIDE_PX, MARGIN_PX = 64, MARGINS_PX[1]
SETTINGS = (
    *(f"stream.recipe.crop_{side}_px={SIDE_PX + 2 * MARGIN_PX}" for side in ("height", "width")),
    "stream.recipe.voxels_per_clip=1",
    "stream.recipe.world_speed_px=[10, 120]",
    "stream.recipe.threshold=[0.1, 0.4]",
    "stream.recipe.noise_sigma=[0.0, 0.02]",
    "stream.recipe.pause_probability=0.0",
    "stream.batch_size=4",
    "optimizer.learning_rate=1.0e-3",
    "optimizer.ema_decay=0.999",
    "compute.channels_last=true",
)
EXACT, ESTIMATED = "trained on exact flow", "trained on DIS"


def batches(photographs: str, config: TrainConfig, seed: int) -> Iterator[Batch]:
    """Yield the batches of a stream, epoch after epoch without end, with the margin around the crop."""
    recipe = config.stream.resolved_recipe.replace(lead_frames=1)
    arrays = ("voxels", "frames", "flow", "flow_valid")
    dataset = V2VDataset(photographs, recipe, arrays, seed, videos_kind="photographs")
    for epoch in itertools.count():
        dataset.set_epoch(epoch)
        yield from DataLoader(dataset, config.stream.batch_size)


def arms(batch: Batch) -> dict[str, Batch]:
    """Return the crop of a batch as each network sees it: with exact flow, and with that of DIS in its place."""
    flow, valid = (torch.empty_like(array) for array in (batch.flow, batch.flow_valid))
    estimators = {method: estimator(method) for method in METHODS}
    for clip, grid in np.ndindex(*flow.shape[:2]):
        first, second = batch.frames[clip, grid : grid + 2, 0].numpy()
        estimate = estimators[choose(first, second)]
        field = estimate(first, second)
        flow[clip, grid] = torch.from_numpy(field.transpose(2, 0, 1))
        valid[clip, grid] = torch.from_numpy(consistent(field, estimate(second, first)))
    return {
        arm: replace(
            batch,
            arrays={name: array[..., MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] for name, array in arrays.items()},
        )
        for arm, arrays in ((EXACT, batch.arrays), (ESTIMATED, {**batch.arrays, "flow": flow, "flow_valid": valid}))
    }


def learn(
    found: Iterable[Batch], config: TrainConfig, ends: Sequence[int]
) -> Iterator[tuple[int, dict[str, VoxelNetwork]]]:
    """Train one network in each arm on the batches; yield each number of steps in ``ends``, and the networks then."""
    learners = {arm: build(config, Ranks(0, 1, torch.device("cpu"))) for arm in (EXACT, ESTIMATED)}
    for step, batch in zip(range(max(ends)), found, strict=False):
        for arm, seen in arms(batch).items():
            learners[arm].step(learners[arm].task.prepare(seen, None), step, 0)
        if step + 1 in ends:
            yield step + 1, {arm: learner.trained for arm, learner in learners.items()}


@torch.no_grad()
def judge(
    found: Iterable[Batch], networks: Mapping[str, VoxelNetwork]
) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Return endpoint errors by method, lengths of the exact flow, and where it is visible, each [N, T, H, W]."""
    rows: list[tuple[Tensor, ...]] = []
    for seen in map(arms, found):
        voxels, exact = seen[EXACT].voxels, seen[EXACT].flow.float()
        guesses = (
            *(network(voxels)[0] for network in networks.values()),
            torch.zeros_like(exact),
            seen[ESTIMATED].flow,
        )
        apart = (torch.linalg.vector_norm(guess - exact, dim=2) for guess in guesses)
        rows.append((*apart, torch.linalg.vector_norm(exact, dim=2), seen[EXACT].flow_valid[:, :, 0] > 0))
    *errors, length, visible = (torch.cat(column).numpy() for column in zip(*rows, strict=True))
    return dict(zip((*networks, "no motion", "DIS itself"), errors, strict=True)), length, visible


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    parser.add_argument("--photographs", required=True, metavar="DIR", help="photographs to train on")
    parser.add_argument("--held-out", required=True, metavar="DIR", help="other photographs, to judge on")
    parser.add_argument(
        "--steps", type=whole_numbers, default=(1000,), metavar="N,...",
        help="numbers of optimiser steps after which both networks are judged (default 1000)",
    )  # fmt: skip
    add_whole(parser, "--batches", 40, "batches of held-out worlds, 4 in each")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change the training, as v2v-train"
    )
    add_whole(parser, "--seed", 0, "seed of the weights, and of the worlds to train on", least=0)


def measure(asked: argparse.Namespace) -> Report:
    """Train and judge.

    Raises:
        UsageError, CorpusError: the photographs cannot be used, or those to judge on are those to train on.
    """
    if Path(asked.photographs).resolve() == Path(asked.held_out).resolve():
        raise UsageError(f"--held-out {asked.held_out}: the networks are trained on it; give other photographs")
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    config = load_config("evflownet-worlds", (*SETTINGS, f"compute.seed={asked.seed}", *asked.set))
    judged = list(itertools.islice(batches(asked.held_out, config, HELD_OUT_SEED), asked.batches))
    records: list[Record] = []
    lines: list[str] = []
    for steps, networks in learn(batches(asked.photographs, config, asked.seed), config, asked.steps):
        errors, length, visible = judge(judged, networks)
        table = by_length(errors, length, visible, {"all": visible})
        records += [{"steps": steps, "seed": asked.seed, **record} for record in table]
        means = {name: np.nanmean(np.where(visible, error, np.nan), axis=(1, 2, 3)) for name, error in errors.items()}
        gain = means[ESTIMATED] - means[EXACT]
        lines.append(
            f"{steps} steps, {time.process_time():.0f} s of processor time in all; mean of the worlds' mean errors: "
            f"{', '.join(f'{name} {mean.mean():.3f}' for name, mean in means.items())}; exact flow is better by "
            f"{gain.mean():.3f} px (standard error {gain.std() / len(gain) ** 0.5:.3f}), in {(gain > 0).sum()} of "
            f"{len(gain)} worlds"
        )
        progress(lines[-1])
    return Report(records, [(table, WORLD_COLUMNS)], lines)
