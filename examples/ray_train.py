"""Train with Ray Train on a v2v stream: Ray starts the ranks, and restarts them if one is lost.

    python -m examples.ray_train --connect tcp://127.0.0.1:5555 --storage /tmp/ray-train --ranks 2

Every rank creates its own ``V2VStreamDataset`` in the train function: it takes rank and world size from
torch.distributed, which Ray Train has set up. ``batch.resume_state`` of any rank is valid for all, so the checkpoint
holds that of rank 0, and all ranks resume from it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from ray import train
from ray.train.torch import TorchTrainer, prepare_model
from torch import nn

from v2v_client import V2VStreamDataset

STATE = "state.pt"
BINS = 5
"""Bins of a voxel grid, in every recipe that does not set them."""


def train_rank(settings: dict[str, Any]) -> None:
    """Run one rank: train, and report checkpoints."""
    rank = train.get_context().get_world_rank()
    dataset = V2VStreamDataset(settings["connect"], batch_size=settings["batch_size"], recipe=settings["recipe"])
    torch.manual_seed(0)
    network = prepare_model(nn.Conv2d(BINS, 1, 5, padding=2))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    step = 0
    if checkpoint := train.get_checkpoint():
        with checkpoint.as_directory() as folder:
            state = torch.load(Path(folder, STATE), weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        dataset.load_state_dict(json.loads(state["stream"]))
        step = state["step"]
    while dataset.epoch < settings["epochs"]:
        for batch in dataset:
            voxels, frames = batch["voxels"].flatten(0, 1).float(), batch["frames"].flatten(0, 1) / 255.0
            loss = nn.functional.l1_loss(network(voxels), frames)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            step += 1
            if settings["seen"]:
                note = {"epoch": batch.epoch, "step": step, "indices": batch.indices, "process": os.getpid()}
                with Path(settings["seen"], f"{rank}.jsonl").open("a", encoding="utf-8") as file:
                    print(json.dumps(note), file=file)
            with tempfile.TemporaryDirectory() as folder:
                if rank == 0:
                    state = {
                        "network": network.state_dict(), "optimizer": optimizer.state_dict(), "step": step,
                        "stream": json.dumps(batch.resume_state),
                    }  # fmt: skip
                    torch.save(state, Path(folder, STATE))
                saved = train.Checkpoint.from_directory(folder) if rank == 0 else None
                train.report({"loss": loss.item(), "epoch": batch.epoch, "step": step}, checkpoint=saved)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    parser = argparse.ArgumentParser(description="Train a small network in Ray Train on a v2v stream.")
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="address of v2v-serve")
    parser.add_argument("--storage", required=True, metavar="DIR", help="folder for checkpoints, shared by all nodes")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=1)
    parser.add_argument("--batch-size", type=int, default=2)
    parser.add_argument("--recipe", type=json.loads, metavar="JSON", help="fields of a recipe (default: the server's)")
    parser.add_argument("--failures", type=int, default=3, help="maximum number of restarts of lost ranks (default 3)")
    parser.add_argument("--gpus", action="store_true")
    parser.add_argument("--seen", metavar="DIR", help="folder in which each rank logs the samples it trained on")
    settings = vars(parser.parse_args(argv))
    result = TorchTrainer(
        train_rank,
        train_loop_config=settings,
        scaling_config=train.ScalingConfig(num_workers=settings["ranks"], use_gpu=settings["gpus"]),
        run_config=train.RunConfig(
            name="v2v",
            storage_path=str(Path(settings["storage"]).absolute()),
            failure_config=train.FailureConfig(max_failures=settings["failures"]),
        ),
    ).fit()
    print(json.dumps(result.metrics))
    return 0


if __name__ == "__main__":
    sys.exit(main())
