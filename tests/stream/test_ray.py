"""A Ray cluster of two logical nodes on this host places the workers: nothing changes but who restarts what."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.keys import read_key
from v2v_server.keys import KeyFolder

pytest.importorskip("ray", reason="the extra 'ray' is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.filterwarnings("ignore")]
_STORE_BYTES = 80 << 20
_EPOCHS = 3


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without processors, and two nodes with three each that have the videos."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # A third of what a node is given by default until it is taken for dead.
    monkeypatch.setenv("RAY_health_check_period_ms", "1000")
    before = signal.getsignal(signal.SIGTERM)
    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 0, "object_store_memory": _STORE_BYTES, "include_dashboard": False},
    )
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=3, object_store_memory=_STORE_BYTES, memory=4 << 30, labels={"corpus": "clips"})
        yield cluster
    finally:
        cluster.shutdown()
        signal.signal(signal.SIGTERM, before)


def flags_for(cluster: Any) -> list[str]:
    return [
        *SMALL_FLAGS, "--engine", "ray", "--ray-address", cluster.address, "--ray-label", "corpus=clips",
        "--worker-bind", "tcp://127.0.0.1:*",
    ]  # fmt: skip


def workers() -> list[psutil.Process]:
    """The worker processes below all actors, oldest first."""
    found = []
    for process in psutil.Process().children(recursive=True):
        try:
            if "v2v_server.commands.worker" in process.cmdline() and raylets_of(process):
                found.append(process)
        except psutil.NoSuchProcess:
            continue
    return sorted(found, key=lambda process: process.create_time())


def test_a_cluster_gives_the_bytes_of_local_workers_whatever_dies(clips: Path, cluster: Any) -> None:
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as local:
        reference = [digest(batch) for epoch in range(_EPOCHS) for batch in epoch_of(local.address, epoch=epoch)]
    with LocalServer(clips, workers=2, flags=flags_for(cluster)) as server:
        until(lambda: len(workers()) == 2)
        nodes = [raylet_of(process) for process in workers()]
        assert len(set(nodes)) == 2, "they are not spread"
        got: list[str] = []

        def two_others(gone: set[psutil.Process]) -> bool:
            return len(set(workers()) - gone) == 2

        for epoch in range(_EPOCHS):
            for number, batch in enumerate(
                V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3, epoch=epoch, timeout_seconds=120)
            ):
                got.append(digest(batch))
                if number != 1:
                    continue
                victim = workers()[0]
                gone, node = {victim}, raylet_of(victim)
                if epoch == 0:
                    victim.kill()
                elif epoch == 1:
                    os.kill(victim.ppid(), signal.SIGKILL)  # its actor: the kernel ends the worker along with it
                else:
                    gone = {process for process in workers() if raylet_of(process) == node}
                    cluster.remove_node(
                        next(each for each in cluster.worker_nodes if pid_of_raylet(each) == node), allow_graceful=False
                    )
                until(functools.partial(two_others, gone))
                assert epoch < 2 or {raylet_of(process) for process in workers()} != {node}
        said = log_of(server)
    assert got == reference
    assert "workers have a place on 2 nodes" in said
    assert "was lost with its actor on" in said
    until(lambda: not workers())


def log_of(server: LocalServer) -> str:
    assert server._errors is not None
    file = server._errors.fileno()
    return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")


def test_a_cluster_grows_while_a_consumer_waits_and_shrinks_again(clips: Path, cluster: Any) -> None:
    epochs: list[list[str]] = []
    flags = [*flags_for(cluster), "--scale-seconds", "6", "--workers", "1:2"]
    with LocalServer(clips, flags=flags) as server:
        dataset = V2VStreamDataset(server.address, batch_size=3, recipe=SMALL, seed=3)

        def until_there_are(count: int, pause: float) -> None:
            deadline = time.monotonic() + 300.0
            while len(workers()) != count and time.monotonic() < deadline:
                epochs.append([])
                for batch in dataset:
                    epochs[-1].append(digest(batch))
                    time.sleep(pause)
            assert len(workers()) == count

        until_there_are(1, 0.0)
        until_there_are(2, 0.0)
        until_there_are(1, 1.5)  # far from what one can do, on a busy machine too
        said = log_of(server)
    changes = [int(found) for found in re.findall(r"workers: (\d+) from now on, because", said)]
    assert changes[:2] == [2, 1]
    assert "its leases go to other workers" not in said  # who was sent away left in order
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as fixed:
        for epoch in {0, len(epochs) // 2, len(epochs) - 1}:
            assert epochs[epoch] == [digest(batch) for batch in epoch_of(fixed.address, epoch=epoch)]
    assert {len(epoch) for epoch in epochs} == {8}


def raylets_of(process: psutil.Process) -> list[int]:
    return [parent.pid for parent in process.parents() if parent.name() == "raylet"]


def raylet_of(process: psutil.Process) -> int:
    (raylet,) = raylets_of(process)
    return raylet


def pid_of_raylet(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)


def session_of(cluster: Any) -> Path:
    """Where Ray keeps logs and all else of a cluster."""
    return Path(cluster.head_node.get_session_dir_path())


def holding(folder: Path, secret: bytes) -> list[str]:
    """Files below a folder with that text."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return [path.name for path in files if secret in path.read_bytes()]


def test_workers_on_a_cluster_get_a_key_that_is_written_down_nowhere(
    clips: Path, cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = KeyFolder(tmp_path / "keys")
    keys.init()
    keys.new("gpu", "consumer", tmp_path / "gpu.key")
    with LocalServer(clips, workers=2, flags=SMALL_FLAGS) as local:
        reference = [digest(batch) for batch in epoch_of(local.address)]
    monkeypatch.setenv("V2V_KEYS", str(tmp_path / "gpu.key"))
    with LocalServer(clips, workers=2, flags=[*flags_for(cluster), "--keys", str(tmp_path / "keys")]) as server:
        assert [digest(batch) for batch in epoch_of(server.address)] == reference
        workers()[0].kill()
        until(lambda: len(workers()) == 2)
        flags = [process.cmdline() for process in workers()]
        files = [f"/proc/{process.pid}/fd/{Path(line[line.index('--keys') + 1]).name}" for process, line in
                 zip(workers(), flags, strict=True)]  # fmt: skip
        lent = [read_key(Path(file)) for file in files]
        assert {(key.side, key.name[:4]) for key in lent} == {("worker", "ray-")}
        (secret,) = {key.secret.encode() for key in lent}
        for process in [*psutil.Process().children(recursive=True), psutil.Process()]:
            with contextlib.suppress(psutil.Error):
                shown = " ".join([*process.cmdline(), *process.environ().values()])
                assert secret.decode() not in shown, process.name()
        said = log_of(server)
        session = session_of(cluster)
        assert secret.decode() not in said
        assert holding(session, lent[0].name.removeprefix("ray-").encode()), "these are the logs of another cluster"
        assert holding(session, secret) == []
        assert holding(tmp_path, secret) == []
    assert holding(session, secret) == []
    (session / "logs" / "planted").write_bytes(b"x" + secret)
    assert holding(session, secret) == ["planted"]


def test_ray_train_goes_on_where_a_rank_was_lost(clips: Path, cluster: Any, tmp_path: Path) -> None:
    pytest.importorskip("ray.train", reason="ray[train] is not installed", exc_type=ImportError)
    seen = tmp_path / "seen"
    seen.mkdir()
    with LocalServer(clips, workers=1, flags=SMALL_FLAGS) as server:
        # A global batch is two ranks' of two.
        batches = [batch for epoch in range(2) for batch in epoch_of(server.address, epoch=epoch, batch_size=4)]
        expected = sorted((batch.epoch, index) for batch in batches for index in batch.indices)
        running = subprocess.Popen(
            [
                sys.executable, "-m", "examples.ray_train", "--connect", server.address, "--storage",
                str(tmp_path / "storage"), "--seen", str(seen), "--epochs", "2",
                "--recipe", json.dumps(SMALL.to_dict()),
            ],
            env={**os.environ, "RAY_ADDRESS": cluster.address}, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            until(lambda: len(notes(seen)) >= 10)
            rank = next(
                process for process in psutil.Process().children(recursive=True)
                if any("TrainWorker" in part for part in process.cmdline())
            )  # fmt: skip
            rank.kill()
            printed, _ = running.communicate(timeout=200)
        finally:
            running.kill()
            running.wait()
    assert running.returncode == 0, printed
    trained: dict[tuple[int, int], tuple[int, list[int]]] = {}
    for rank_number, note in notes(seen):
        samples = note["epoch"], note["indices"]
        assert trained.setdefault((rank_number, note["step"]), samples) == samples, "a step came again as another one"
    assert sorted((epoch, index) for epoch, indices in trained.values() for index in indices) == expected
    begun: dict[tuple[int, int], int] = {}
    for rank_number, note in notes(seen):
        begun.setdefault((rank_number, note["process"]), note["step"])
    (one, again), (other, other_again) = (
        [at for (number, _), at in begun.items() if number == each] for each in (0, 1)
    )
    assert (one, other) == (1, 1)
    assert again == other_again > 1, "both ranks were started again, from one checkpoint"
    assert json.loads(printed.splitlines()[-1])["step"] * 2 == len(trained) == len(batches) * 2


def notes(seen: Path) -> list[tuple[int, dict[str, Any]]]:
    """(rank, what it noted of a step); a line that is being written is none yet."""
    return [
        (int(path.stem), json.loads(line))
        for path in seen.glob("*.jsonl")
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True)
        if line.endswith("\n")
    ]
