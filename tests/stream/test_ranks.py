"""Ranks of torch.distributed, as real processes over gloo, share an epoch over a real server."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch.distributed
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL, epoch_of
from tests.stream.test_loaders import singles
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer

FORK = multiprocessing.get_context("fork")

Sample = tuple[int, int, str]
"""Epoch, index, digest."""


@pytest.fixture(scope="module")
def schedule(server: LocalServer) -> list[list[Sample]]:
    """Two whole epochs, sample by sample, as one consumer gets them."""
    epochs = [epoch_of(server.address, epoch=epoch, batch_size=1) for epoch in (0, 1)]
    return [[(batch.epoch, *item) for batch in batches for item in singles(batch)] for batches in epochs]


def _rank(rank: int, store: str, address: str, loader_workers: int, results: Any) -> None:
    """Train two epochs; report the batches and the last state."""
    torch.distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=2)
    stream = V2VStreamDataset(address, batch_size=3, recipe=SMALL, seed=3)
    method = "fork" if loader_workers else None
    loader = DataLoader(stream, batch_size=None, num_workers=loader_workers, multiprocessing_context=method)
    samples: list[list[Sample]] = []
    state: Mapping[str, Any] = {}
    for _ in range(2):
        for batch in loader:
            # What a training step does: no rank is ahead, and none waits for a batch that another has not.
            torch.distributed.barrier()
            samples.append([(batch.epoch, *item) for item in singles(batch)])
            state = batch.resume_state
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
    results.put((rank, samples, dict(state)))


def flat(batches: list[list[Sample]]) -> list[Sample]:
    return [sample for batch in batches for sample in batch]


@pytest.mark.parametrize("loader_workers", [0, 2])
def test_two_ranks_share_each_epoch_equally_and_once(
    tmp_path: Path, server: LocalServer, schedule: list[list[Sample]], loader_workers: int
) -> None:
    results, arguments = FORK.SimpleQueue(), (f"file://{tmp_path}/store", server.address, loader_workers)
    processes = [FORK.Process(target=_rank, args=(rank, *arguments, results)) for rank in (0, 1)]
    for process in processes:
        process.start()
    _, ranks, states = zip(*sorted(results.get() for _ in processes), strict=True)
    for process in processes:
        process.join()
        assert process.exitcode == 0
    batches_each = len(schedule[0]) // (2 * 3)
    assert batches_each == 4
    for epoch in (0, 1):
        of_epoch = [flat(rank)[epoch * batches_each * 3 :][: batches_each * 3] for rank in ranks]
        assert [len(part) for part in of_epoch] == [12, 12]
        assert not set(of_epoch[0]) & set(of_epoch[1])
        # What does not fill a global batch is the end of the (shuffled) epoch.
        assert sorted(of_epoch[0] + of_epoch[1]) == sorted(schedule[epoch][: 2 * 12])
    assert [len(rank) for rank in ranks] == [2 * batches_each] * 2
    assert states[0] == states[1]
