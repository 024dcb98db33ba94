"""What the copies of a dataset agree on, by the order of their lines."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from v2v_client import progress as progress_module
from v2v_client.progress import Progress
from v2v_client.state import ResumeState

WORKERS = range(2)


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
