"""Position and resume through the loaders that trainers use, over a real server: always the bytes of one plain run."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import pytest
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.stream.conftest import SMALL, digest, epoch_of
from v2v_client import Batch, RepeatedSamplesWarning, V2VStreamDataset
from v2v_client.local_server import LocalServer

# StatefulDataLoader of torchdata 0.11 calls a function that newer releases of torch deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning")

LOADER_WORKERS = [pytest.param(0, None, id="0"), pytest.param(2, "fork", id="2-fork")]


@pytest.fixture(scope="module")
def plain(server: LocalServer) -> list[list[str]]:
    """Digests of the batches of three epochs, without any loader or interruption."""
    return [[digest(batch) for batch in epoch_of(server.address, epoch=epoch)] for epoch in range(3)]


def dataset(server: LocalServer, **options: Any) -> V2VStreamDataset:
    return V2VStreamDataset(server.address, **({"batch_size": 3, "recipe": SMALL, "seed": 3} | options))


def digests(batches: Iterable[Batch]) -> list[str]:
    return [digest(batch) for batch in batches]


def take(batches: Iterator[Batch], count: int) -> list[Batch]:
    return [next(batches) for _ in range(count)]


def saved_and_loaded(state: Any) -> Any:
    """What a checkpoint does to a state."""
    return pickle.loads(pickle.dumps(copy.deepcopy(dict(state))))


def stateful_loader(stream: V2VStreamDataset, workers: int, method: str | None) -> StatefulDataLoader[Batch]:
    return StatefulDataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=method)


# --- torch's DataLoader -----------------------------------------------------------------------------------------------


def repetition_is_said(workers: int) -> AbstractContextManager[object]:
    """Expect the warning in this process. A loader worker gives it in its own, if it had prefetched enough batches."""
    if workers:
        return warnings.catch_warnings(action="ignore", category=RepeatedSamplesWarning)
    return pytest.warns(RepeatedSamplesWarning)


# --- torchdata's StatefulDataLoader -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("workers", "method", "taken"),
    [
        *((*each.values, 4) for each in LOADER_WORKERS),
        (2, "fork", 1),
        pytest.param(2, "spawn", 4, marks=pytest.mark.slow),
    ],
)
def test_a_stateful_loader_goes_on_in_mid_epoch(
    server: LocalServer, plain: list[list[str]], workers: int, method: str | None, taken: int
) -> None:
    loader = stateful_loader(dataset(server), workers, method)
    used = take(iter(loader), taken)
    state = saved_and_loaded(loader.state_dict())
    resumed = stateful_loader(dataset(server), workers, method)
    resumed.load_state_dict(state)
    assert digests(used) + digests(resumed) == plain[0]
    assert digests(resumed) == plain[1]


@pytest.mark.parametrize(("workers", "method"), LOADER_WORKERS)
def test_a_stateful_loader_at_the_end_of_an_epoch_begins_a_full_next_one(
    server: LocalServer, plain: list[list[str]], workers: int, method: str | None
) -> None:
    loader = stateful_loader(dataset(server), workers, method)
    assert digests(loader) == plain[0]
    state = saved_and_loaded(loader.state_dict())
    assert digests(loader) == plain[1]
    resumed = stateful_loader(dataset(server), workers, method)
    resumed.load_state_dict(state)
    assert digests(resumed) == plain[1]
    assert digests(resumed) == plain[2]


@pytest.mark.parametrize(("workers", "method"), LOADER_WORKERS)
def test_a_stateful_loader_left_early_repeats_the_epoch(
    server: LocalServer, plain: list[list[str]], workers: int, method: str | None
) -> None:
    loader = stateful_loader(dataset(server), workers, method)
    assert digests(take(iter(loader), 2)) == plain[0][:2]
    with repetition_is_said(workers):
        assert digests(loader) == plain[0]


def singles(batch: Batch) -> Iterator[tuple[int, str]]:
    """Index and digest of each sample, as of a batch of its own."""
    for row, index in enumerate(batch.indices):
        alone = dataclasses.replace(
            batch,
            indices=(index,),
            arrays={name: array[row : row + 1] for name, array in batch.arrays.items()},
            provenance=batch.provenance[row : row + 1],
        )
        yield index, digest(alone)
