"""Define fixtures for the trainer's tests: one thread, and the published weights if they are available."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tests.client.fake_server import FakeServer
from tests.trainer.training import trained

WEIGHTS = Path(os.environ.get("V2V_TEST_WEIGHTS", Path(__file__).parents[3] / "shared" / "data" / "weights"))


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def published() -> Path:
    """Return the folder of published weight files: ``$V2V_TEST_WEIGHTS``, or ``../shared/data/weights``."""
    if not WEIGHTS.is_dir():
        pytest.skip(f"no folder {WEIGHTS}: set V2V_TEST_WEIGHTS to one with the published weight files")
    return WEIGHTS


@pytest.fixture(scope="module")
def server() -> Iterator[FakeServer]:
    with FakeServer(sequences=23) as running:
        yield running


@pytest.fixture(scope="module")
def whole(server: FakeServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of 12 steps: two epochs of 5 and a part of the third."""
    return trained(tmp_path_factory.mktemp("whole"), server.address, "run", run__steps=12)
