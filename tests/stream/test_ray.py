"""A Ray cluster of two logical nodes on this host places the workers: nothing changes but who restarts what."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
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
