"""Equal consumers of a server that makes each sample once: the bytes of a server that makes every sample for each."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS
from tests.stream.test_loaders import singles
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_server.status.client import StatusClient

Samples = list[tuple[int, str]]

pytestmark = pytest.mark.slow


def consume(address: str, paused: threading.Event | None = None, *, shared_memory: bool = True) -> Samples:
    """Return the samples of two epochs; with an event, take one batch and the next once the event is set."""
    dataset = V2VStreamDataset(address, batch_size=3, recipe=SMALL, shared_memory=shared_memory)
    found: Samples = []
    for _ in range(2):
        for batch in dataset:
            found += singles(batch)
            if paused is not None:
                paused.wait()
    return found


@pytest.mark.parametrize(
    "gib",
    [
        pytest.param("0.01", id="all samples"),
        pytest.param("0.0002", id="six samples"),
    ],
)
def test_four_consumers_get_the_bytes_of_unshared_samples(server: LocalServer, clips: Path, gib: str) -> None:
    """One is stopped until the others are done, so a small ring has dropped what it was sent; one reads messages."""
    alone = consume(server.address)
    with LocalServer(clips, workers=2, flags=[*SMALL_FLAGS, "--share-gib", gib]) as sharing:
        others_done = threading.Event()
        with ThreadPoolExecutor(4) as threads:
            stopped = threads.submit(consume, sharing.address, others_done)
            others = [threads.submit(consume, sharing.address) for _ in range(2)]
            others.append(threads.submit(consume, sharing.address, shared_memory=False))
            try:
                together = [each.result() for each in others]
            finally:
                others_done.set()
            assert [*together, stopped.result()] == [alone] * 4
        with StatusClient(sharing.address) as client:
            totals = client.get_status()["totals"]
    if gib == "0.01":
        assert totals["shared"] == 3 * len(alone)
        assert totals["decodes"] == len(alone)
    else:
        assert totals["shared"] > 0
