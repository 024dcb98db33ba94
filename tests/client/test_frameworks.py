"""Test the dataset with other loaders, loops and launchers: it works, or the error says what to do instead."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from torch.utils.data import DataLoader

from tests.client.fake_server import FakeServer
from tests.waiting import result_in_process
from v2v_client import Batch, UsageError, V2VStreamDataset


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


def test_an_iteration_begins_with_its_first_batch(server: FakeServer) -> None:
    """Lightning creates an iterator before its hooks run, and another to inspect the loader."""
    stream = dataset(server)
    batches = iter(stream)
    stream.set_epoch(4)
    iter(stream)
    assert next(batches).epoch == 4


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
