"""Workers that are started before there is work."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from v2v_protocol.errors import CorpusError
from v2v_server.config import ServeConfig
from v2v_server.supervise import local_host as child
from v2v_server.supervise.local_host import LocalHost, WorkerProcess, start_ahead
from v2v_server.supervise.pool import Pool

WRITES = "import os, sys; open(sys.argv[1], 'wb').write(sys.stdin.buffer.read())"


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file in which a standby writes what it is told; it ends then."""
    path = tmp_path / "told"
    monkeypatch.setattr(child, "PROGRAM", (sys.executable, "-S", "-E", "-c", WRITES, str(path)))
    return path


def test_the_pool_takes_standbys_first_and_tells_them_the_arguments_of_a_worker(told: Path) -> None:
    config = ServeConfig(videos="/corpus", workers=(1, 1))
    with start_ahead(config) as standbys:
        (standby,) = standbys
        expected = child.arguments("tcp://127.0.0.1:1", "/corpus", "label-0.1", ["--debug"], standby.logbook)
        pool = Pool(LocalHost("/corpus", ["--debug"], standbys), "label")
        pool.start("tcp://127.0.0.1:1")
        pool.scale(1)
        pool.watch(0.0, 0)
        assert standbys == []
        standby.process.wait()
        pool.stop(0.0, 0.0)
    assert told.read_bytes().decode().split("\0") == expected


def test_standbys_that_are_not_used_end_with_the_start(told: Path) -> None:
    def fail(config: ServeConfig, started: list[WorkerProcess]) -> None:
        with start_ahead(config) as standbys:
            started += standbys
            raise CorpusError("no videos")

    started: list[WorkerProcess] = []
    with pytest.raises(CorpusError):
        fail(ServeConfig(videos="videos", workers=(2, 2)), started)
    assert len(started) == 2
    assert all(each.process.returncode is not None for each in started)


def test_a_standby_that_has_ended_is_a_failed_start_and_leaves_no_zombie(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "PROGRAM", (sys.executable, "-S", "-E", "-c", "raise SystemExit(3)"))
    standby = WorkerProcess()
    standby.process.wait()
    pool = Pool(LocalHost("/corpus", (), [standby]), "label")
    pool.start("tcp://127.0.0.1:1")
    pool.scale(1)
    (death,) = pool.watch(0.0, 0)
    assert "could not be started" in death.loss.text
    pool.stop(0.0, 0.0)


def test_a_server_with_workers_elsewhere_starts_none() -> None:
    config = ServeConfig(videos="videos", engine="ray", worker_bind="tcp://127.0.0.1:5556")
    with start_ahead(config) as standbys:
        assert standbys == []
