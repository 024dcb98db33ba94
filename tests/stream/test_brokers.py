"""Two real servers over one corpus, four ranks; one server is killed in the middle of the epoch."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS, epoch_of
from tests.stream.test_loaders import singles
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_client.options import Patience

FORK = multiprocessing.get_context("fork")
RANKS = 4


def _rank(rank: int, brokers: list[str], begun: Any, go_on: Any, results: Any) -> None:
    patience = Patience(ping_seconds=0.5, takeover_seconds=2.0)
    stream = V2VStreamDataset(brokers, 1, recipe=SMALL, seed=3, rank=rank, world_size=RANKS, patience=patience)
    samples = []
    for batch in stream:
        samples += singles(batch)
        if len(samples) == 1:
            begun.release()
            go_on.wait()
    results.put((rank, samples))


@pytest.mark.slow
def test_a_killed_broker_loses_and_repeats_no_sample(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path))
    begun, go_on, results = FORK.Semaphore(0), FORK.Event(), FORK.SimpleQueue()
    with (
        LocalServer(clips, workers=1, flags=SMALL_FLAGS) as one,
        LocalServer(clips, workers=1, flags=SMALL_FLAGS) as other,
    ):
        whole = [sample for batch in epoch_of(other.address, batch_size=1) for sample in singles(batch)]
        brokers = [one.address, other.address]
        ranks = [FORK.Process(target=_rank, args=(rank, brokers, begun, go_on, results)) for rank in range(RANKS)]
        for process in ranks:
            process.start()
        for _ in ranks:
            assert begun.acquire(timeout=600)
        psutil.Process(one.pid).kill()
        go_on.set()
        by_rank = dict(results.get() for _ in ranks)
        for process in ranks:
            process.join()
    assert len(whole) == 26
    assert {rank: len(samples) for rank, samples in by_rank.items()} == dict.fromkeys(range(RANKS), 6)
    assert sorted(sample for samples in by_rank.values() for sample in samples) == sorted(whole[:24])
