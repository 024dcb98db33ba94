"""A stream between keys: a server, a worker that connects to it, loader workers that inherit the key."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from torch.utils.data import DataLoader

from tests.stream.conftest import SMALL, SMALL_FLAGS
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import KeyRefused
from v2v_protocol.keys import read_key
from v2v_server.keys import KeyFolder

pytestmark = pytest.mark.slow


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = KeyFolder(tmp_path / "keys")
    folder.init()
    folder.new("gpu", "consumer", tmp_path / "gpu.key")
    folder.new("cpu", "worker", tmp_path / "cpu.key")
    monkeypatch.setenv("V2V_KEYS", str(tmp_path / "gpu.key"))
    return tmp_path


def flags(keys: Path) -> list[str]:
    return ["--keys", str(keys / "keys"), "--worker-bind", "tcp://127.0.0.1:*", *SMALL_FLAGS]


def told_by_the_system(pids: list[int]) -> str:
    """Command lines and environments, as ``ps`` shows them, of these processes and their children."""
    processes = [psutil.Process(pid) for pid in pids]
    processes += [child for each in processes for child in each.children(recursive=True)]
    return "\n".join(f"{each.cmdline()} {each.environ()}" for each in processes)


def test_loader_workers_inherit_a_key(clips: Path, keys: Path) -> None:
    with LocalServer(clips, workers=1, flags=flags(keys)) as server:
        dataset = V2VStreamDataset(server.address, batch_size=3, recipe=SMALL)
        batches = list(DataLoader(dataset, batch_size=None, num_workers=2))
        assert len(batches) == len(dataset)
        told = f"{dataset.describe()} {batches[0].provenance} {batches[0].resume_state} {vars(dataset)}"
        for name in ("gpu", "cpu"):
            assert read_key(keys / f"{name}.key").secret not in told + server.last_lines()
        with pytest.raises(KeyRefused, match="asks for a key, and no key was given"):
            next(iter(V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, keys="")))


def test_workers_elsewhere_need_a_key_of_theirs(clips: Path, keys: Path) -> None:
    with LocalServer(clips, workers=0, flags=flags(keys)) as server:
        port = server.last_lines().partition("workers to ")[2].split()[0]
        command = [sys.executable, "-m", "v2v_server.commands.worker", "--connect", port, "--videos", str(clips)]
        for more, said in (([], "is a consumer's, and this is a worker"), (["--keys", ""], "and no key was given")):
            ended = subprocess.run([*command, *more], capture_output=True, text=True, check=False)
            assert (ended.returncode, said in ended.stderr) == (2, True), ended.stderr
            assert ended.stderr.count("\n") == 1
        worker = subprocess.Popen([*command, "--keys", str(keys / "cpu.key"), "--name", "far"])
        try:
            batch = next(iter(V2VStreamDataset(server.address, batch_size=3, recipe=SMALL)))
            assert batch.voxels.shape[0] == 3
            secrets = [read_key(keys / f"{name}.key").secret for name in ("gpu", "cpu")]
            secrets.append(json.loads((keys / "keys" / "server.key").read_text())["secret"])
            shown = told_by_the_system([worker.pid, server.pid])
            assert str(keys / "cpu.key") in shown  # names of files are what is shown
            assert not [secret for secret in secrets if secret in shown + server.last_lines()]
        finally:
            worker.terminate()
            assert worker.wait(60) == 0
