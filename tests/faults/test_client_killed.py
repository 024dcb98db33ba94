"""A trainer that prefetches is killed at any point and goes on from the last state that it saved."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL, epoch_of
from tests.stream.test_loaders import singles
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer

FORK = multiprocessing.get_context("fork")
EPOCHS = 2
BATCHES_AN_EPOCH = 8

Entry = tuple[int, int, str]
"""Epoch, index, digest of one sample."""


@pytest.fixture(scope="module")
def schedule(server: LocalServer) -> list[Entry]:
    epochs = [epoch_of(server.address, epoch=epoch) for epoch in range(EPOCHS)]
    return [(batch.epoch, *item) for batches in epochs for batch in batches for item in singles(batch)]


def _train(address: str, folder: Path, loader_workers: int, report: Connection) -> None:
    """Logs each batch after the yield, then saves its state, until the epochs are over; tells of every step."""
    log, checkpoint = folder / "log", folder / "checkpoint"
    stream = V2VStreamDataset(address, batch_size=3, recipe=SMALL, seed=3)
    steps = 0
    if checkpoint.exists():
        saved = json.loads(checkpoint.read_text())
        steps = saved["steps"]
        stream.load_state_dict(saved["state"])
    loader: Any = stream
    if loader_workers:
        loader = DataLoader(
            stream, batch_size=None, num_workers=loader_workers, prefetch_factor=3, multiprocessing_context="fork"
        )
    while stream.epoch < EPOCHS:
        for batch in loader:
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps([steps, [[batch.epoch, *item] for item in singles(batch)]]) + "\n")
            steps += 1
            report.send("logged")
            fresh = folder / "checkpoint.new"
            fresh.write_text(json.dumps({"steps": steps, "state": batch.resume_state}))
            os.replace(fresh, checkpoint)
            report.send("saved")
    report.send("finished")


def _run(server: LocalServer, folder: Path, loader_workers: int, kill_after: int | None) -> bool:
    """Trains until it is over, or until so many reports came and it is killed; whether it is over."""
    here, there = FORK.Pipe(duplex=False)
    trainer = FORK.Process(target=_train, args=(server.address, folder, loader_workers, there))
    trainer.start()
    there.close()
    reports = 0
    try:
        while True:
            if here.recv() == "finished":
                return True
            reports += 1
            if reports == kill_after:
                trainer.kill()
                return False
    finally:
        trainer.join()
        trainer.close()
        here.close()


def _committed(folder: Path) -> list[Entry]:
    """The log without what lay behind the state that was resumed from: later lines of a step replace earlier ones."""
    by_step: dict[int, list[Entry]] = {}
    for line in (folder / "log").read_text(encoding="utf-8").splitlines():
        step, samples = json.loads(line)
        by_step = {earlier: entry for earlier, entry in by_step.items() if earlier < step}
        by_step[step] = [(epoch, index, text) for epoch, index, text in samples]
    return [entry for step in sorted(by_step) for entry in by_step[step]]


@pytest.mark.parametrize("loader_workers", [0, 2])
def test_a_trainer_killed_anywhere_repeats_and_skips_nothing(
    server: LocalServer,
    schedule: list[Entry],
    tmp_path: Path,
    loader_workers: int,
) -> None:
    draw = random.Random(loader_workers)
    kills = 0
    # Odd counts strike between a step and its checkpoint, even ones just behind a checkpoint; both, and far apart.
    for kill_after in (1, 2, *(draw.randint(3, 10) for _ in range(4))):
        if _run(server, tmp_path, loader_workers, kill_after):
            break
        kills += 1
    assert kills >= 4
    assert _run(server, tmp_path, loader_workers, None)
    assert len(schedule) == EPOCHS * BATCHES_AN_EPOCH * 3
    assert _committed(tmp_path) == schedule
