"""Position and resume through the loaders that trainers use, over a real server: always the bytes of one plain run."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import warnings
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from tests.clips import panned_luma, write_clip
from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of
from v2v_client import Batch, RepeatedSamplesWarning, StateMismatch, UsageError, V2VStreamDataset
from v2v_client.local_server import LocalServer

# StatefulDataLoader of torchdata 0.11 calls a function that newer releases of torch deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning")

LOADER_WORKERS = [
    pytest.param(0, None, id="0"),
    pytest.param(1, "fork", id="1-fork"),
    pytest.param(2, "fork", id="2-fork"),
]


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


def plain_loader(stream: V2VStreamDataset, workers: int, method: str | None) -> DataLoader[Batch]:
    return DataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=method)


def stateful_loader(stream: V2VStreamDataset, workers: int, method: str | None) -> StatefulDataLoader[Batch]:
    return StatefulDataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=method)


# --- torch's DataLoader -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("workers", "method"), LOADER_WORKERS)
def test_the_epochs_of_a_loader_are_those_of_the_dataset(
    server: LocalServer, plain: list[list[str]], workers: int, method: str | None
) -> None:
    loader = plain_loader(dataset(server), workers, method)
    assert [digests(loader) for _ in range(2)] == plain[:2]


def repetition_is_said(workers: int) -> AbstractContextManager[object]:
    """Expect the warning in this process. A loader worker gives it in its own, if it had prefetched enough batches."""
    if workers:
        return warnings.catch_warnings(action="ignore", category=RepeatedSamplesWarning)
    return pytest.warns(RepeatedSamplesWarning)


@pytest.mark.parametrize(("workers", "method"), LOADER_WORKERS)
def test_leaving_early_repeats_the_epoch(
    server: LocalServer, plain: list[list[str]], workers: int, method: str | None
) -> None:
    loader = plain_loader(dataset(server), workers, method)
    for number, batch in enumerate(loader):
        assert digest(batch) == plain[0][number]
        if number == 1:
            break
    with repetition_is_said(workers):
        assert digests(loader) == plain[0]
    assert digests(loader) == plain[1]


@pytest.mark.parametrize(("before", "after"), [(0, 2), (2, 0), (2, 1)])
def test_a_batch_resumes_under_any_number_of_loader_workers(
    server: LocalServer, plain: list[list[str]], before: int, after: int
) -> None:
    """The loader had prefetched more than the trainer used; only what was used counts."""
    used = take(iter(plain_loader(dataset(server), before, "fork" if before else None)), 3)
    resumed = dataset(server)
    resumed.load_state_dict(saved_and_loaded(used[-1].resume_state))
    loader = plain_loader(resumed, after, "fork" if after else None)
    assert digests(used) + digests(loader) == plain[0]
    assert digests(loader) == plain[1]


@pytest.mark.parametrize("after", [0, 2])
def test_the_last_batch_resumes_at_a_full_next_epoch(server: LocalServer, plain: list[list[str]], after: int) -> None:
    *_, last = plain_loader(dataset(server), 2, "fork")
    resumed = dataset(server)
    resumed.load_state_dict(saved_and_loaded(last.resume_state))
    assert digests(plain_loader(resumed, after, "fork" if after else None)) == plain[1]


def test_the_parent_of_loader_workers_has_no_state_and_says_where_it_is(server: LocalServer) -> None:
    stream = dataset(server)
    next(iter(plain_loader(stream, 1, "fork")))
    with pytest.raises(UsageError, match=r"DataLoader workers.*Batch\.resume_state"):
        stream.state_dict()


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


def test_a_batch_of_a_stateful_loader_resumes_under_other_loader_workers(
    server: LocalServer, plain: list[list[str]]
) -> None:
    used = take(iter(stateful_loader(dataset(server), 2, "fork")), 3)
    resumed = dataset(server)
    resumed.load_state_dict(saved_and_loaded(used[-1].resume_state))
    assert digests(used) + digests(stateful_loader(resumed, 1, "fork")) == plain[0]


# --- other sizes, other streams ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("before", "after", "workers"), [(3, 5, 0), (5, 2, 2), (4, 1, 0)])
def test_another_batch_size_is_exact(
    server: LocalServer, plain: list[list[str]], before: int, after: int, workers: int
) -> None:
    """Sample by sample, so that where batches begin does not matter."""
    whole = {batch.indices[0]: digest(batch) for batch in dataset(server, batch_size=1)}
    used = take(iter(dataset(server, batch_size=before)), 2)
    resumed = dataset(server, batch_size=after)
    resumed.load_state_dict(saved_and_loaded(used[-1].resume_state))
    rest = list(plain_loader(resumed, workers, "fork" if workers else None))
    found = [item for batch in (*used, *rest) for item in singles(batch)]
    assert [index for index, _ in found] == list(range(2 * before + len(rest) * after))
    assert all(whole[index] == item for index, item in found)
    assert len(whole) - len(found) < after


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 4}, r"seed: the state has 3, this dataset 4"),
        (
            {"recipe": {**SMALL.to_dict(), "gamma": 1.5}},
            r"the options given to this dataset / the state: recipe\.gamma 1\.5 / 2\.2; ask for the recipe",
        ),
        ({"voxel_dtype": "int16"}, r"voxel_dtype int16 / int8"),
    ],
)
def test_a_state_of_another_stream_is_refused(server: LocalServer, options: dict[str, Any], message: str) -> None:
    state = next(iter(dataset(server))).resume_state
    with pytest.raises(StateMismatch, match=message):
        dataset(server, **options).load_state_dict(state)


def test_a_state_of_another_catalogue_is_refused_naming_both(server: LocalServer, tmp_path: Path) -> None:
    state = next(iter(dataset(server))).resume_state
    write_clip(tmp_path / "other.mp4", panned_luma(90, 48, 64))
    with LocalServer(tmp_path, workers=1, flags=SMALL_FLAGS) as other:
        theirs = next(iter(dataset(other))).resume_state
        resumed = dataset(other)
        resumed.load_state_dict(state)
        expected = (
            rf"catalogue_digest: the saved state has {state['catalogue_digest']}, "
            rf"{other.address} has {theirs['catalogue_digest']}"
        )
        with pytest.raises(StateMismatch, match=expected):
            next(iter(resumed))
