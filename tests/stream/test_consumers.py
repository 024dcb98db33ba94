"""Many consumers of one server: each gets its own bytes, and none waits for another."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from tests.stream.conftest import SMALL
from tests.stream.test_loaders import singles
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer

CONSUMERS: dict[str, dict[str, Any]] = {
    "paper": {"recipe": SMALL, "seed": 3, "batch_size": 3},
    "another seed": {"recipe": SMALL, "seed": 4, "batch_size": 3},
    "larger batches": {"recipe": SMALL, "seed": 3, "batch_size": 8},
    "shorter, wider type": {
        "recipe": {**SMALL.to_dict(), "voxels_per_clip": 2},
        "voxel_dtype": "int16",
        "batch_size": 2,
    },
    "in order, other epoch": {"recipe": SMALL, "shuffle": False, "epoch": 7, "batch_size": 1},
    "another gamma": {"recipe": {**SMALL.to_dict(), "gamma": 1.0}, "seed": 3, "batch_size": 5},
}
STALLED = ("paper", "another seed")
"""These take one batch and the next only when all others are done."""


def _samples(batch: Batch) -> list[tuple[int, int, str]]:
    return [(batch.epoch, *item) for item in singles(batch)]


def test_each_of_many_consumers_gets_what_it_gets_alone(server: LocalServer) -> None:
    alone = {
        name: [_samples(batch) for batch in V2VStreamDataset(server.address, **options)]
        for name, options in CONSUMERS.items()
    }
    begun = threading.Barrier(len(CONSUMERS))
    fast_are_done = threading.Semaphore(0)

    def consume(name: str) -> list[list[tuple[int, int, str]]]:
        found = []
        for number, batch in enumerate(V2VStreamDataset(server.address, **CONSUMERS[name])):
            found.append(_samples(batch))
            if number == 0:
                begun.wait()
                if name in STALLED:
                    for _ in range(len(CONSUMERS) - len(STALLED)):
                        fast_are_done.acquire()
        if name not in STALLED:
            fast_are_done.release(len(STALLED))
        return found

    with ThreadPoolExecutor(len(CONSUMERS)) as threads:
        together = dict(zip(CONSUMERS, threads.map(consume, CONSUMERS), strict=True))
    assert together == alone
    assert len({str(batches) for batches in alone.values()}) == len(CONSUMERS)
