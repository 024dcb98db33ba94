"""The server is killed under a client that iterates; another one may come up at the same address."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import psutil

from bench.processes import free_ports
from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of, server_workers
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_client.options import Patience

BATCHES_BEFORE = 2
QUICK = Patience(ping_seconds=0.2, rewant_seconds=1.0)


@contextmanager
def iterating(address: str) -> Iterator[tuple[Future[list[str]], threading.Event]]:
    """A client that has taken two of eight batches of an epoch and goes on when told; its digests, when it is done."""
    taken, go_on = threading.Event(), threading.Event()

    def consume() -> list[str]:
        found = []
        stream = V2VStreamDataset(address, batch_size=3, recipe=SMALL, seed=3, timeout_seconds=60.0, patience=QUICK)
        try:
            for batch in stream:
                found.append(digest(batch))
                if len(found) == BATCHES_BEFORE:
                    taken.set()
                    go_on.wait()
        finally:
            taken.set()
        return found

    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(consume)
        try:
            taken.wait()
            yield running, go_on
        finally:
            go_on.set()


def test_the_client_goes_on_with_a_restarted_server(clips: Path) -> None:
    # An address for two servers in turn: no connection gets its port in between.
    flags = [*SMALL_FLAGS, "--bind", f"tcp://127.0.0.1:{free_ports(1)[0]}"]
    with LocalServer(clips, workers=1, flags=flags) as first:
        address = first.address
        expected = [digest(batch) for batch in epoch_of(address)]
        with iterating(address) as (client, go_on):
            workers = server_workers(first.pid)
            os.kill(first.pid, signal.SIGKILL)
            go_on.set()  # it waits for samples while there is no server
            with LocalServer(clips, workers=1, flags=flags):
                assert client.result() == expected
            assert not psutil.wait_procs(workers, timeout=60)[1]
    assert len(expected) > 2 * BATCHES_BEFORE
