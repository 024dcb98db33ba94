"""Brokers that share workers, for real: a worker and a broker are killed while both have consumers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from bench.processes import free_ports
from tests.faults.test_server_restart import iterating
from tests.stream.conftest import SMALL_FLAGS, digest, made_here
from tests.waiting import until
from v2v_client.local_server import LocalServer

pytestmark = pytest.mark.slow


@contextmanager
def worker(addresses: str, videos: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A worker of these brokers, which has to end with the block, by itself or killed."""
    command = [sys.executable, "-m", "v2v_server.commands.worker", "--connect", addresses, "--videos", str(videos)]
    with log.open("wb") as errors, subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=errors) as process:
        try:
            yield process
            process.wait(60.0)
        finally:
            process.kill()


def test_both_trainers_get_their_epoch_while_workers_and_brokers_are_killed(clips: Path, tmp_path: Path) -> None:
    expected = [digest(batch) for batch in made_here(clips, 0)]
    ports = free_ports(6)
    flags = [
        [
            *(*SMALL_FLAGS, "--lease-deadline-seconds", "5", "--bind", f"tcp://127.0.0.1:{ports[each]}"),
            *("--worker-bind", f"tcp://127.0.0.1:{ports[each + 3]}"),
        ]
        for each in range(3)
    ]
    shared = ",".join(f"tcp://127.0.0.1:{port}" for port in ports[3:])
    with ExitStack() as pool, ExitStack() as opened:  # the workers leave with the last broker
        brokers = [opened.enter_context(LocalServer(clips, workers=0, flags=flags[each])) for each in (0, 1)]
        logs = [tmp_path / f"worker{number}" for number in range(3)]
        workers = [pool.enter_context(worker(shared, clips, log)) for log in logs[:2]]
        with iterating(brokers[0].address) as (first, go_on), iterating(brokers[1].address) as (second, go_on_too):
            opened.enter_context(LocalServer(clips, workers=0, flags=[*flags[2], "--set", "bins=4"]))
            workers[0].kill()
            workers.append(pool.enter_context(worker(shared, clips, logs[2])))
            os.kill(brokers[1].pid, signal.SIGKILL)
            go_on.set()
            assert first.result() == expected
            opened.enter_context(LocalServer(clips, workers=0, flags=flags[1]))  # at the same addresses
            go_on_too.set()
            assert second.result() == expected
            until(lambda: f"tcp://127.0.0.1:{ports[5]}: its default recipe is " in logs[2].read_text())
        assert "that of tcp://127.0.0.1:" in logs[2].read_text()
