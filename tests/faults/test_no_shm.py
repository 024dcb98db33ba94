"""Hosts without a usable /dev/shm: containers of some services have none, and others a tiny one.

Python's locks, queues and process pools need it; the server, ``v2v-prepare`` and the dataset must not.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.clips import panned_luma, write_clip
from tests.faults.private_mounts import ABSENT_SHM, FULL_SHM, READ_ONLY_SHM, mounted
from tests.stream.conftest import digest, epoch_of
from v2v_client.local_server import LocalServer
from v2v_server.corpus.sources.prepared import read_manifest

NO_SEMAPHORES = Path(__file__).parent / "no_semaphores"


def _require_all_works(command: Sequence[str], server: LocalServer, why: str, **environment: str) -> None:
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert why in found["lock"]  # the fault is there
    assert found["epoch"] == [digest(batch) for batch in epoch_of(server.address)]
    assert "cannot be used" not in found["said"]
    assert found["prepared"] == 0


def _command(clips: Path, folder: Path) -> list[str]:
    return [sys.executable, "-m", "tests.faults.serve_and_prepare", str(clips), str(folder)]


def _without_semaphores() -> dict[str, str]:
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(NO_SEMAPHORES), os.environ.get("PYTHONPATH"))))}


def test_catalogue_and_preparing_without_semaphores(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    for number in range(2):
        write_clip(tmp_path / "source" / f"{number}.mp4", panned_luma(12 + number))
    environment = os.environ | _without_semaphores() | {"V2V_CACHE_DIR": str(tmp_path / "cache")}
    command = [
        sys.executable,
        "-m",
        "v2v_protocol.programs",
        "prepare",
        str(tmp_path / "source"),
        str(tmp_path / "out"),
    ]
    subprocess.run([*command, "--workers", "1"], env=environment, check=True)
    assert len(read_manifest(tmp_path / "out").videos) == 2
    pool = "from concurrent.futures import ProcessPoolExecutor; ProcessPoolExecutor(1)"
    refused = subprocess.run([sys.executable, "-c", pool], env=environment, capture_output=True, text=True, check=False)
    assert "No such file" in refused.stderr  # the fault was there


@pytest.mark.slow
def test_a_stream_without_semaphores(clips: Path, tmp_path: Path, server: LocalServer) -> None:
    _require_all_works(_command(clips, tmp_path), server, "No such file", **_without_semaphores())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setup", "why"),
    [(ABSENT_SHM, "No such file"), (READ_ONLY_SHM, "Read-only file system"), (FULL_SHM, "No space left")],
    ids=["absent", "read-only", "full"],
)
def test_without_dev_shm(clips: Path, tmp_path: Path, server: LocalServer, setup: str, why: str) -> None:
    _require_all_works(mounted(setup, _command(clips, tmp_path)), server, why)
