"""Equal consumers of a server that makes each sample once: the bytes of a server that makes every sample for each."""

from __future__ import annotations

import resource
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
import zmq

from tests.clips import panned_luma, write_clip
from tests.stream.conftest import SMALL, SMALL_FLAGS
from tests.stream.test_loaders import singles
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.messages import Hello, Want, encode
from v2v_protocol.recipe import Recipe
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


LARGE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=160, crop_width_px=208)
LARGE_BYTES = 4 * 160 * 208 * (5 + 1)
DEAF = 40
FILES = 200


@pytest.mark.skipif(sys.platform != "linux", reason="prlimit(2)")
def test_consumers_that_never_read_cost_their_credit_and_nothing_else(tmp_path: Path) -> None:
    """They request the same samples thousands of times, and each message that waits once took a descriptor."""
    write_clip(tmp_path / "a.mp4", panned_luma(201, 160, 208, step=(1, 2)), gop=50)
    with LocalServer(tmp_path, workers=1, flags=[*SMALL_FLAGS, "--share-gib", "0.05"]) as server, ExitStack() as stack:
        alone = [list(singles(batch)) for batch in V2VStreamDataset(server.address, batch_size=4, recipe=LARGE)]
        broker = psutil.Process(server.pid)
        before = broker.memory_info().rss
        files = broker.num_fds()
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (FILES, FILES))
        context = stack.enter_context(zmq.Context())
        deaf = [stack.enter_context(context.socket(zmq.DEALER)) for _ in range(DEAF)]
        for each in deaf:
            each.linger, each.rcvhwm, each.sndhwm = 0, 1, 2000
            each.connect(server.address)
            each.send_multipart(encode(Hello({"recipe": LARGE.to_dict()}, ("voxels", "frames"), 4, 0)))
        for _ in range(500):
            for each in deaf:
                each.send_multipart(encode(Want(0, tuple(range(8)))))
        with StatusClient(server.address) as client:
            until(lambda: client.get_status()["totals"]["shared"] >= DEAF)
        assert [list(singles(batch)) for batch in V2VStreamDataset(server.address, batch_size=4, recipe=LARGE)] == alone
        assert broker.num_fds() < files + DEAF + 60
        assert broker.memory_info().rss - before < DEAF * 10 * LARGE_BYTES
