"""Test that a dataset with a local server leaves no process behind, in whatever way it ends."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from torch.utils.data import DataLoader, get_worker_info

from tests.clips import write_panned
from tests.leftovers import abandoned_memory, shared_memory
from tests.waiting import has_ended, until
from v2v_client import V2VStreamDataset
from v2v_protocol.errors import UsageError
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.keys import KeyFolder

RECIPE = {"preset": "noise-free", "voxels_per_clip": 2, "crop_height_px": 32, "crop_width_px": 32}
SCRIPT = """
import os, signal, sys
from torch.utils.data import DataLoader
from v2v_client import V2VStreamDataset
if __name__ == "__main__":
    recipe = {recipe!r}
    dataset = V2VStreamDataset.local(sys.argv[1], 2, recipe=recipe, workers=1)
    for batch in {batches}:
        print(batch.voxels.sum().item(), flush=True)
        {end}
"""


@pytest.fixture(scope="module")
def clips(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_panned(tmp_path_factory.mktemp("local-clips"), 4, 40)
    open_catalogue(folder, processes=0).close()  # a server that finds no index starts processes that probe
    return folder


@pytest.fixture
def servers() -> Iterator[set[psutil.Process]]:
    """Return the processes that this process has started since."""
    before = set(psutil.Process().children(recursive=True))
    started: set[psutil.Process] = set()
    yield started
    started |= set(psutil.Process().children(recursive=True)) - before
    assert not [process for process in started if process.is_running() and "v2v_server" in " ".join(command(process))]


def command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def test_a_local_dataset_streams_and_stops_its_server(
    clips: Path, servers: set[psutil.Process], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A key for other servers is not used."""
    folder = KeyFolder(tmp_path / "keys")
    folder.init()
    folder.new("gpu", "consumer", tmp_path / "gpu.key")
    with monkeypatch.context() as patch:
        patch.setenv("V2V_KEYS", str(tmp_path / "gpu.key"))
        dataset = V2VStreamDataset.local(clips, 2, recipe=RECIPE, workers=1)
    servers.update(psutil.Process().children(recursive=True))
    whole = [batch.voxels for batch in dataset]
    assert len(whole) == len(dataset) > 1
    for batch in dataset:
        assert batch.epoch == 1
        break  # in the middle of an epoch
    loader = DataLoader(
        V2VStreamDataset(dataset.describe()["address"], 2, recipe=RECIPE), batch_size=None, num_workers=1
    )
    assert all(torch.equal(mine, batch.voxels) for mine, batch in zip(whole, loader, strict=True))
    assert any("v2v_server" in " ".join(command(process)) for process in servers)
    del dataset, loader
    gc.collect()


@pytest.mark.slow
def test_a_loader_worker_that_ends_does_not_end_the_server(clips: Path, servers: set[psutil.Process]) -> None:
    """A loader worker is a fork, with copies of all objects that would stop the server."""

    def close(_worker: int) -> None:
        worker = get_worker_info()
        assert worker is not None
        worker.dataset.close()
        worker.dataset._is_closed = False

    dataset = V2VStreamDataset.local(clips, 2, recipe=RECIPE, workers=1)
    for init in (None, close):
        loader = DataLoader(dataset, batch_size=None, num_workers=1, worker_init_fn=init)
        assert sum(1 for _ in loader) == len(dataset)
    del dataset
    gc.collect()


@pytest.mark.usefixtures("servers")
def test_an_error_is_the_servers_own_message(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no video found"):
        V2VStreamDataset.local(tmp_path, recipe=RECIPE, workers=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("batches", "end", "status"),
    [
        ("dataset", "break", 0),
        ("dataset", "raise SystemExit(0)", 0),
        ("dataset", "raise ValueError", 1),
        ("dataset", "os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL),
        ("DataLoader(dataset, None, num_workers=2)", "os.kill(os.getpid(), signal.SIGTERM)", -signal.SIGTERM),
    ],
)
def test_no_process_is_left_when_the_program_ends(
    clips: Path, tmp_path: Path, batches: str, end: str, status: int
) -> None:
    memory = shared_memory()
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(recipe=RECIPE, batches=batches, end=end), encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), str(clips)], stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        assert program.stdout.readline()
        started = [each for each in psutil.process_iter() if str(clips) in command(each) and each.pid != program.pid]
        program.wait()
    assert program.returncode == status
    until(lambda: all(map(has_ended, started)))
    until(lambda: not abandoned_memory(memory))


@pytest.mark.parametrize(
    ("options", "scene", "moves"),
    [
        ({}, "off", False),
        ({"preset": "natural"}, "auto", False),
        ({"scene": "auto"}, "auto", False),
        ({"preset": "worlds"}, "off", True),
        ({"preset": "worlds", "recipe": "paper"}, "off", False),
    ],
)
def test_its_server_has_the_statistics_and_the_recipe_that_the_options_need(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, options: dict[str, Any], scene: str, moves: bool
) -> None:
    asked: list[list[str]] = []

    class Started(Exception):
        pass

    def start(videos: Path, *, workers: int, flags: list[str]) -> None:
        asked.append(flags)
        raise Started

    monkeypatch.setattr("v2v_client.dataset.LocalServer", start)
    with pytest.raises(Started):
        V2VStreamDataset.local(tmp_path, flags=["--preset", "natural"], **options)
    (flags,) = asked
    told = [] if scene == "off" else ["--scene", scene]
    assert flags[-2 - len(told) :] == [*told, "--preset", "natural"], "what the user gives comes last"
    assert ("--scene" in flags) == bool(told)
    assert any(flag.startswith("world_speed_px=") for flag in flags) == moves
