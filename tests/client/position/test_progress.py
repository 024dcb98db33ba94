"""What the copies of a dataset agree on, by the order of their lines."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch.utils.data._utils.worker as torch_worker

from v2v_client.position import progress as progress_module
from v2v_client.position.progress import Progress
from v2v_client.position.state import ResumeState

WORKERS = range(2)
FORK = multiprocessing.get_context("fork")


def test_the_epoch_ends_with_the_last_loader_worker() -> None:
    progress = Progress(3)
    for epoch in (3, 4):
        started = {worker: progress.start(f"iteration {epoch}", worker) for worker in WORKERS}
        assert list(started.values()) == [(1, epoch, None)] * 2
        for worker in WORKERS:
            assert progress.standing().epoch == epoch
            progress.finish(f"iteration {epoch}", 1, worker, len(WORKERS))
    assert progress.standing().epoch == 5


@pytest.mark.parametrize("finished_before", [0, 1])
@pytest.mark.parametrize("state", [None, ResumeState(None, 7, 3, 0, 8, 1)], ids=["set_epoch", "a loaded state"])
def test_workers_that_finish_what_was_left_early_do_not_end_the_epoch_that_was_set(
    state: ResumeState | None, finished_before: int
) -> None:
    """It is the same epoch once more, as a validation repeats it; they had prefetched its last batches."""
    progress = Progress(3)
    for worker in WORKERS:
        progress.start("early", worker)
    for worker in WORKERS[:finished_before]:
        progress.finish("early", 1, worker, len(WORKERS))
    progress.set(3, state)
    assert progress.start("again", 0) == (1, 3, state)
    for worker in WORKERS[finished_before:]:
        progress.finish("early", 1, worker, len(WORKERS))
    standing = progress.standing()
    assert (standing.epoch, standing.state) == (3, state)
    assert progress.start("again", 1) == (1, 3, state)
    for worker in WORKERS:
        progress.finish("again", 1, worker, len(WORKERS))
    standing = progress.standing()
    assert (standing.epoch, standing.state) == (4, None)


def test_ranks_that_get_a_dataset_from_one_process_each_have_their_own_epochs() -> None:
    """As torch.multiprocessing.spawn and notebook launchers hand it over. Ranks that are seeded alike name their
    iterations alike."""
    progress = Progress(3)
    progress.start("before", 0)
    for _ in range(2):
        assert _forked(_rank, progress) == (3, 4)
    assert progress.standing().epoch == 3


def _rank(progress: Progress) -> tuple[int, int]:
    first: int = _forked(_loader_worker, progress)
    return first, progress.standing().epoch


def _loader_worker(progress: Progress) -> int:
    torch_worker._worker_info = torch_worker.WorkerInfo(id=0, num_workers=1, seed=7, dataset=None)
    number, epoch, _ = progress.start("iteration", 0)
    progress.finish("iteration", number, 0, 1)
    return epoch


def _forked(function: Callable[[Progress], Any], progress: Progress) -> Any:
    here, there = FORK.Pipe()

    def run() -> None:
        there.send(function(progress))
        os._exit(0)

    process = FORK.Process(target=run)
    process.start()
    there.close()
    found = here.recv()
    process.join()
    process.close()
    here.close()
    return found


def test_a_rank_that_is_spawned_has_its_own_epochs() -> None:
    progress = Progress(3)
    spawned = Progress.__new__(Progress)
    descriptor = SimpleNamespace(detach=lambda: os.dup(progress._descriptor))
    spawned.__setstate__({"descriptor": descriptor, "process": os.getpid() + 1})
    spawned.set(4, None)
    assert (progress.standing().epoch, spawned.standing().epoch) == (3, 4)


def test_an_epoch_takes_no_longer_for_all_that_went_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small corpus has a hundred thousand of them in a week."""
    read: list[bytes] = []
    monkeypatch.setattr(progress_module, "json", SimpleNamespace(dumps=json.dumps, loads=_counted(read)))
    progress = Progress(0)
    before = progress.standing()
    for epoch in range(1, 51):
        progress.main()
        progress.start(f"iteration {epoch}", 0)
        progress.set(epoch, None)
        assert progress.standing().epoch == epoch
    assert len(read) == 1 + 3 * 50
    assert (before.epoch, before.starts) == (0, {})
    assert not progress.standing().tokens
    assert pickle.loads(pickle.dumps(progress)).standing() == progress.standing()


def _counted(read: list[bytes]) -> Callable[[bytes], Any]:
    def loads(text: bytes) -> Any:
        read.append(text)
        return json.loads(text)

    return loads
