"""Test the dataset with other loaders, loops and launchers: it works, or the error says what to do instead."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.client.fake_server import FakeServer
from tests.waiting import result_in_process
from v2v_client import Batch, RepeatedSamplesWarning, UsageError, V2VStreamDataset


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer(sequences=23, credit=8) as running:
        yield running


def dataset(server: FakeServer) -> V2VStreamDataset:
    return V2VStreamDataset(server.address, batch_size=4, timeout_seconds=60.0)


@pytest.mark.parametrize("batch_size", [1, 4])
def test_a_loader_that_collates_batches_is_refused(server: FakeServer, batch_size: int) -> None:
    with pytest.raises(UsageError, match="batch_size=None"):
        next(iter(DataLoader(dataset(server), batch_size=batch_size)))


def test_a_loop_that_counts_batches_also_ends_the_epoch(server: FakeServer) -> None:
    """Lightning takes ``len`` batches and never asks for another."""
    stream = dataset(server)
    epochs = []
    for _ in range(3):
        batches = iter(stream)
        epochs += [next(batches).epoch for _ in range(len(stream))]
    assert epochs == [0] * 5 + [1] * 5 + [2] * 5


def test_an_epoch_set_during_the_last_batch_is_the_next_one(server: FakeServer) -> None:
    stream = dataset(server)
    for batch in stream:
        if batch.indices[-1] == 19:
            stream.set_epoch(7)
    assert next(iter(stream)).epoch == 7


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # accelerate's, and torch's because of accelerate
def test_a_loader_prepared_by_accelerate_is_refused_where_it_would_repeat_samples(server: FakeServer) -> None:
    """By default accelerate splits batches, which it cannot do with a Batch. Otherwise it counts epochs from 0."""
    accelerate = importlib.import_module("accelerate")  # slow to import, and without types
    utils = importlib.import_module("accelerate.utils")
    splits = accelerate.Accelerator(cpu=True).prepare(DataLoader(dataset(server), batch_size=None))
    with pytest.raises(TypeError, match=r"v2v_client\.batch\.Batch"):
        next(iter(splits))

    def prepare(stream: V2VStreamDataset) -> Any:
        keeps_batches = utils.DataLoaderConfiguration(dispatch_batches=False)
        accelerator = accelerate.Accelerator(cpu=True, dataloader_config=keeps_batches)
        return accelerator.prepare(DataLoader(stream, batch_size=None))

    stream = dataset(server)
    prepared = prepare(stream)
    epochs = [batch.epoch for _ in range(2) for batch in prepared]
    assert epochs == [0] * 5 + [1] * 5
    state = stream.state_dict()
    resumed = dataset(server)
    resumed.load_state_dict(state)
    with pytest.raises(UsageError, match=r"leave the loader out of prepare\(\)"):
        next(iter(prepare(resumed)))


def test_an_iteration_begins_with_its_first_batch(server: FakeServer) -> None:
    """Lightning creates an iterator before its hooks run, and another to inspect the loader."""
    stream = dataset(server)
    batches = iter(stream)
    stream.set_epoch(4)
    iter(stream)
    assert next(batches).epoch == 4


@pytest.mark.slow
# Theirs are ignored. Ours is an error: loader workers inherit the filter, and raise it.
@pytest.mark.filterwarnings("ignore", "error::v2v_client.RepeatedSamplesWarning")
@pytest.mark.parametrize("sets_epoch", [True, False])
@pytest.mark.parametrize(("loader", "workers"), [(StatefulDataLoader, 0), (StatefulDataLoader, 2), (DataLoader, 2)])
def test_epochs_of_lightning_that_end_early_are_other_samples_or_are_not_silent(
    loader: Any, workers: int, sets_epoch: bool
) -> None:
    """Its loader workers have prefetched more, and end with the epoch."""
    lightning = importlib.import_module("lightning")  # slow to import, and without types
    taken: list[tuple[int | None, ...]] = []

    class Module(lightning.LightningModule):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.network = torch.nn.Conv2d(2, 1, 1)

        def on_train_epoch_start(self) -> None:
            if sets_epoch:
                stream.set_epoch(self.current_epoch)

        def training_step(self, batch: Batch, _number: int) -> torch.Tensor:
            taken.append((batch.epoch, *batch.indices))
            return self.network(batch.arrays["voxels"].flatten(0, 1).float()).mean()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), 1e-3)

    trainer = lightning.Trainer(
        max_epochs=2, limit_train_batches=8, accelerator="cpu", logger=False, enable_progress_bar=False,
        enable_model_summary=False, enable_checkpointing=False,
    )  # fmt: skip
    said = nullcontext() if sets_epoch else pytest.raises((RepeatedSamplesWarning, UsageError), match="set_epoch")
    with FakeServer(sequences=103, credit=8) as server, said:
        stream = dataset(server)
        trainer.fit(Module(), loader(stream, batch_size=None, num_workers=workers))
    assert taken == [(epoch, *range(4 * n, 4 * n + 4)) for epoch in range(1 + sets_epoch) for n in range(8)]


def test_a_forked_child_cannot_continue_an_iterator(server: FakeServer) -> None:
    batches = iter(dataset(server))
    next(batches)
    said = result_in_process(_read_on, batches)
    assert "process" in said
    assert "call iter() in the process that takes the batches" in said
    assert next(batches).indices == (4, 5, 6, 7)


def _read_on(batches: Iterator[Batch]) -> str:
    try:
        return str(next(batches))
    except UsageError as error:
        return str(error)
