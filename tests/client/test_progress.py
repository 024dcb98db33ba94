"""What the copies of a dataset agree on, by the order of their lines."""

from __future__ import annotations

import pytest

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
