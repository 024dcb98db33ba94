"""The chaos test itself: its bookkeeping, and a short run for real."""

from __future__ import annotations

import json
import math
import multiprocessing
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import pytest

from bench.__main__ import main
from bench.chaos import chaos
from bench.chaos.faults import Fault
from bench.chaos.fleet import Fleet, port_file
from tests.clips import write_panned
from tests.leftovers import abandoned_memory, shared_memory


def test_a_server_is_back_when_the_next_one_is_ready() -> None:
    faults = [Fault("server-kill", 10.0), Fault("worker-pause", 11.0), Fault("consumer-kill", 12.0, 2)]
    found = chaos.kills([*faults, Fault("server-kill", 30.0)], ready_at=[1.0, 14.0])
    assert [(kill.kind, kill.consumer, kill.ready_at) for kill in found] == [
        ("server-kill", None, 14.0),
        ("consumer-kill", 2, 12.0),
        ("server-kill", None, math.inf),
    ]


def test_what_is_left_over_is_found(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "run", tmp_path, workers=1, consumers=1, lease_deadline_seconds=5.0)
    assert fleet.traces() == []
    (fleet.tmp / "forgotten").write_text("x", encoding="utf-8")
    (fleet.cache / "index.sqlite-wal").write_text("x", encoding="utf-8")
    port_file(fleet.server).write_text("x", encoding="utf-8")
    assert fleet.traces() == ["file tmp/forgotten", "file index.sqlite-wal", "the port file of server"]


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="this host has no /dev/shm")
def test_shared_memory_is_left_over_once_nobody_maps_it() -> None:
    """Another test's, say, that runs at the same time."""
    before = shared_memory()
    block = SharedMemory(create=True, size=100)
    try:
        assert block.name not in abandoned_memory(before)
        block.close()
        assert block.name in abandoned_memory(before)
    finally:
        block.unlink()
    lock = multiprocessing.get_context("spawn").Lock()
    name = f"sem.{lock._semlock.name[1:]}"  # type: ignore[attr-defined]
    assert name in shared_memory()
    assert name not in abandoned_memory(before)


@pytest.mark.slow
@pytest.mark.parametrize("brokers", [1, 2])
def test_a_short_run_keeps_the_promise(brokers: int, tmp_path: Path) -> None:
    clips = write_panned(tmp_path / "clips", 6, 201, 128, 160)
    out = tmp_path / "chaos.json"
    flags = ["--minutes", "0.5", "--every", "1.5", "--remakes", "60", "--seed", "3", "--brokers", str(brokers)]
    status = main(["chaos", "--videos", str(clips), *flags, "--keep", str(tmp_path / "run"), "--json", str(out)])
    (record,) = json.loads(out.read_text(encoding="utf-8"))
    assert {key: record[key] for key in chaos.FAILING} == dict.fromkeys(chaos.FAILING, 0)
    assert record["kills"] > 3
    assert record["samples"] > 50
    assert status == 0
