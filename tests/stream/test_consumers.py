"""Many consumers of one server: each gets its own bytes, none waits for another, a stalled one costs what is stated."""

from __future__ import annotations

import math
import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.clips import panned_luma, write_clip
from tests.stream.conftest import SMALL, SMALL_FLAGS
from tests.stream.test_loaders import singles
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.recipe import Recipe

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


# --- memory of a stalled consumer -------------------------------------------------------------------------------------

LARGE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=160, crop_width_px=208)
BATCH_SIZE = 4
SAMPLE_BYTES = 4 * 160 * 208 * (5 * 4 + 1)
"""Voxels in float32 and frames."""
CREDIT = 2 * BATCH_SIZE
HELD_BATCHES = 1
CLIENT_BYTES = (CREDIT + (math.ceil(CREDIT / BATCH_SIZE) + 2 + HELD_BATCHES) * BATCH_SIZE) * SAMPLE_BYTES
"""As the docstring of V2VStreamDataset has it."""
ALLOWANCE_BYTES = 24 << 20
"""For what is no sample: code that is loaded late, the allocator's arenas, buffers of the kernel's copies."""


def _take_one(address: str, control: Connection) -> None:
    """Takes one batch, keeps it, and reads no more until it is told to; tells its memory at first."""
    next(iter(V2VStreamDataset(address, batch_size=1, recipe=SMALL, timeout_seconds=600.0)))  # of a new server
    control.send(psutil.Process().memory_info().rss)
    batches = iter(V2VStreamDataset(address, batch_size=BATCH_SIZE, recipe=LARGE, voxel_dtype="float32"))
    kept = next(batches)
    control.send(kept.nbytes)
    control.recv()
    control.send([_samples(batch) for batch in (kept, next(batches), next(batches))])


@pytest.mark.slow
def test_stalled_consumers_hold_bounded_memory_and_do_not_delay_others(tmp_path: Path) -> None:
    """One reads no more, the other is stopped (SIGSTOP), so that even its ZeroMQ takes nothing off the network."""
    for number in range(4):
        write_clip(tmp_path / f"{number}.mp4", panned_luma(401, 160, 208, step=(1, 1 + number)), gop=50)
    spawn = multiprocessing.get_context("spawn")
    with LocalServer(tmp_path, workers=1, flags=[*SMALL_FLAGS, "--max-sequences-per-video", "20"]) as server:
        broker = psutil.Process(server.pid)
        broker_before = broker.memory_info().rss
        clients, pipes = [], []
        for _ in range(2):
            here, there = spawn.Pipe()
            clients.append(spawn.Process(target=_take_one, args=(server.address, there)))
            clients[-1].start()
            there.close()
            pipes.append(here)
        before = [here.recv() for here in pipes]
        assert [here.recv() for here in pipes] == [BATCH_SIZE * SAMPLE_BYTES] * 2
        stalled = [psutil.Process(client.pid) for client in clients]
        stalled[1].suspend()
        # No consumer is held up: by fair sharing the stalled ones were served all they had asked for long before this.
        fast = V2VStreamDataset(server.address, batch_size=BATCH_SIZE, recipe=LARGE, voxel_dtype="float32")
        epoch = [_samples(batch) for batch in fast]
        epoch_bytes = len(epoch) * BATCH_SIZE * SAMPLE_BYTES
        assert epoch_bytes > 2 * (CLIENT_BYTES + ALLOWANCE_BYTES), "the test could not tell bounded from unbounded"
        grown = [process.memory_info().rss - at_first for process, at_first in zip(stalled, before, strict=True)]
        broker_grown = broker.memory_info().rss - broker_before
        assert max(grown) < CLIENT_BYTES + ALLOWANCE_BYTES
        assert broker_grown < (len(stalled) + 1) * CREDIT * SAMPLE_BYTES + ALLOWANCE_BYTES
        stalled[1].resume()
        for client, pipe in zip(clients, pipes, strict=True):
            pipe.send("go on")
            assert pipe.recv() == epoch[:3]
            client.join()
            client.close()
            pipe.close()
