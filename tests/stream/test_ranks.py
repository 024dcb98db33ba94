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


def _rank(
    rank: int,
    world_size: int,
    store: str,
    address: str,
    options: Mapping[str, Any],
    results: Any,
) -> None:
    """Trains ``most`` batches in all (over as many epochs as that takes) and reports them, with the last state."""
    torch.distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=world_size)
    stream = V2VStreamDataset(address, batch_size=options["batch_size"], recipe=SMALL, seed=3)
    if options["state"] is not None:
        stream.load_state_dict(options["state"])
    workers = options["loader_workers"]
    loader = DataLoader(
        stream, batch_size=None, num_workers=workers, multiprocessing_context="fork" if workers else None
    )
    samples: list[list[Sample]] = []
    state: Mapping[str, Any] = {}
    for _ in range(options["epochs"]):
        for batch in loader:
            # What a training step does: no rank is ahead, and none waits for a batch that another has not.
            torch.distributed.barrier()
            samples.append([(batch.epoch, *item) for item in singles(batch)])
            state = batch.resume_state
            if len(samples) == options["most"]:
                break
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
    results.put((rank, samples, dict(state)))


def train(
    tmp_path: Path,
    server: LocalServer,
    world_size: int,
    *,
    batch_size: int = 3,
    state: Mapping[str, Any] | None = None,
    epochs: int = 1,
    most: int = 0,
    loader_workers: int = 0,
) -> tuple[list[list[list[Sample]]], list[dict[str, Any]]]:
    """Runs the ranks; the batches of each, and the last state of each."""
    store = f"file://{tmp_path}/store-{world_size}-{most}-{state is None}"
    options = {
        "batch_size": batch_size,
        "state": state,
        "epochs": epochs,
        "most": most,
        "loader_workers": loader_workers,
    }
    results = FORK.SimpleQueue()
    ranks = [
        FORK.Process(target=_rank, args=(rank, world_size, store, server.address, options, results))
        for rank in range(world_size)
    ]
    for process in ranks:
        process.start()
    found = sorted(results.get() for _ in ranks)
    for process in ranks:
        process.join()
        assert process.exitcode == 0
        process.close()
    results.close()
    return [samples for _, samples, _ in found], [last for _, _, last in found]


def flat(batches: list[list[Sample]]) -> list[Sample]:
    return [sample for batch in batches for sample in batch]


@pytest.mark.parametrize("loader_workers", [0, 2])
def test_two_ranks_share_each_epoch_equally_and_once(
    tmp_path: Path, server: LocalServer, schedule: list[list[Sample]], loader_workers: int
) -> None:
    ranks, states = train(tmp_path, server, 2, epochs=2, loader_workers=loader_workers)
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


@pytest.mark.parametrize(("before", "after"), [(2, 3), (2, 1), (1, 2)])
def test_another_world_size_goes_on_at_a_global_batch(
    tmp_path: Path, server: LocalServer, schedule: list[list[Sample]], before: int, after: int
) -> None:
    used, states = train(tmp_path, server, before, batch_size=2, most=3)
    assert all(state == states[0] for state in states)
    rest, _ = train(tmp_path, server, after, batch_size=2, state=states[0])
    assert len({len(rank) for rank in rest}) == 1
    left = len(schedule[0]) - before * 2 * 3
    trained = flat([batch for rank in (*used, *rest) for batch in rank])
    assert len(trained) == before * 2 * 3 + left // (after * 2) * after * 2
    assert sorted(trained) == sorted(schedule[0][: len(trained)])
