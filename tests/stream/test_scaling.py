"""Workers come while a consumer waits, and leave while it does not; no sample is lost by either."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of, server_workers
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer


@pytest.mark.slow
@pytest.mark.alone
def test_two_six_two_and_every_sample_once(clips: Path) -> None:
    epochs: list[list[str]] = []
    with LocalServer(clips, flags=[*SMALL_FLAGS, "--scale-seconds", "6", "--workers", "2:6"]) as server:
        dataset = V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3)

        def until_there_are(workers: int, pause: float) -> None:
            deadline = time.monotonic() + 300.0
            while len(server_workers(server.pid)) != workers and time.monotonic() < deadline:
                epochs.append([])
                for batch in dataset:
                    epochs[-1].append(digest(batch))
                    time.sleep(pause)
            assert len(server_workers(server.pid)) == workers

        until_there_are(6, 0.0)
        until_there_are(2, 0.4)
        assert server._errors is not None
        said = os.pread(server._errors.fileno(), 1 << 20, 0).decode()
    changes = [int(found) for found in re.findall(r"workers: (\d+) from now on, because", said)]
    peak = changes.index(6)
    assert changes[: peak + 1] == [3, 5, 6]
    assert changes[peak:] == sorted(changes[peak:], reverse=True)
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as fixed:
        for epoch in {0, len(epochs) // 2, len(epochs) - 1}:
            assert epochs[epoch] == [digest(batch) for batch in epoch_of(fixed.address, epoch=epoch)]
    assert {len(epoch) for epoch in epochs} == {8}
