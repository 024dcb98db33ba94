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

from tests.clips import panned_luma, write_clip
from tests.leftovers import abandoned_memory, shared_memory
from tests.waiting import has_ended, until
from v2v_client import V2VStreamDataset
from v2v_protocol.errors import ServerLost, UsageError
from v2v_server.keys import KeyFolder

RECIPE = {"preset": "noise-free", "voxels_per_clip": 2, "crop_height_px": 32, "crop_width_px": 32}
SCRIPT = """
import os, signal, sys
from v2v_client import V2VStreamDataset
if __name__ == "__main__":
    recipe = {recipe!r}
    dataset = V2VStreamDataset.local(sys.argv[1], 2, recipe=recipe, workers=1)
    for batch in dataset:
        print(batch.voxels.sum().item(), flush=True)
        {end}
"""


@pytest.fixture(scope="module")
def clips(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("local-clips")
    for number in range(4):
        write_clip(folder / f"{number}.mp4", panned_luma(40, 48, 64, step=(1, 1 + number)))
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


def test_a_local_dataset_streams_and_stops_its_server(clips: Path, servers: set[psutil.Process]) -> None:
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


def test_a_key_for_other_servers_is_not_used(
    clips: Path, servers: set[psutil.Process], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = KeyFolder(tmp_path / "keys")
    folder.init()
    folder.new("gpu", "consumer", tmp_path / "gpu.key")
    monkeypatch.setenv("V2V_KEYS", str(tmp_path / "gpu.key"))
    with V2VStreamDataset.local(clips, 2, recipe=RECIPE, workers=1) as dataset:
        started = psutil.Process().children(recursive=True)
        servers.update(started)
        assert next(iter(dataset)).voxels is not None
    assert not any(process.is_running() for process in started if "v2v_server" in " ".join(command(process)))


@pytest.mark.parametrize(("options", "told"), [({}, ()), ({"preset": "natural"}, ("--scene", "auto"))])
def test_scenes_are_the_servers_choice_unless_an_option_names_them(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, str], told: tuple[str, ...]
) -> None:
    started: list[list[str]] = []

    def local(_: object, *, workers: int, flags: list[str]) -> None:
        started.append(flags)
        raise ServerLost(f"{workers} workers are not started")

    monkeypatch.setattr("v2v_client.dataset.LocalServer", local)
    with pytest.raises(ServerLost):
        V2VStreamDataset.local("clips", recipe=RECIPE, flags=["--preset", "natural"], **options)
    assert started[0][-2 - len(told) :] == [*told, "--preset", "natural"]
    assert ("--scene" in started[0]) == bool(told)


def test_an_error_is_the_servers_own_message(tmp_path: Path, servers: set[psutil.Process]) -> None:
    with pytest.raises(UsageError, match="no video found"):
        V2VStreamDataset.local(tmp_path, recipe=RECIPE)
    del servers


LOADER_SCRIPT = """
import sys
from torch.utils.data import DataLoader
from v2v_client import V2VStreamDataset
if __name__ == "__main__":
    dataset = V2VStreamDataset.local(sys.argv[1], 2, recipe={recipe!r}, workers=1)
    while True:
        for batch in DataLoader(dataset, batch_size=None, num_workers=2):
            print(len(batch), flush=True)
"""


@pytest.mark.slow
def test_loader_workers_end_with_a_program_that_is_terminated(clips: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(LOADER_SCRIPT.format(recipe=RECIPE), encoding="utf-8")
    with subprocess.Popen([sys.executable, str(script), str(clips)], stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        assert program.stdout.readline()
        started = psutil.Process(program.pid).children(recursive=True)
        program.terminate()
    assert program.returncode == -signal.SIGTERM
    until(lambda: all(map(has_ended, started)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "status"),
    [
        ("break", 0),
        ("raise SystemExit(0)", 0),
        ("raise ValueError", 1),
        ("os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL),
    ],
)
def test_no_process_is_left_when_the_program_ends(clips: Path, tmp_path: Path, end: str, status: int) -> None:
    memory = shared_memory()
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(recipe=RECIPE, end=end), encoding="utf-8")
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
        V2VStreamDataset.local(tmp_path, **options)
    (flags,) = asked
    told = [] if scene == "off" else ["--scene", scene]
    assert flags[len(flags) - len(told) :] == told
    assert ("--scene" in flags) == bool(told)
    assert any(flag.startswith("world_speed_px=") for flag in flags) == moves
