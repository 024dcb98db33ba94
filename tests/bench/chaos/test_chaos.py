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
from bench.chaos.consumer import PROFILES, profile
from bench.chaos.faults import WEIGHTS, Fault
from bench.chaos.fleet import Fleet
from bench.chaos.hostile import KINDS
from bench.processes import free_ports
from tests.clips import panned_luma, write_clip
from tests.leftovers import abandoned_memory, shared_memory

DEMANDED = (
    "kills",
    "samples",
    "lost",
    "duplicated",
    "mismatched",
    "leftovers",
    "recovery_p50_seconds",
    "recovery_p99_seconds",
)


def test_every_kind_of_fault_is_a_kill_but_pauses_additions_peers_and_spoilt_caches() -> None:
    ended = {kind for kind in WEIGHTS if Fault(kind, 0.0).is_kill}
    assert set(WEIGHTS) - ended == {
        *("worker-pause", "further-pause", "further-add", "consumer-pause", "cache-delete", "cache-flip", "cache-cut"),
        *(f"peers-{kind}" for kind in KINDS),
    }


def test_a_server_is_back_when_the_next_one_is_ready() -> None:
    faults = [Fault("server-kill", 10.0), Fault("worker-pause", 11.0), Fault("consumer-kill", 12.0, 2)]
    found = chaos.kills([*faults, Fault("server-kill", 30.0)], ready_at=[1.0, 14.0])
    assert [(kill.kind, kill.consumer, kill.ready_at) for kill in found] == [
        ("server-kill", None, 14.0),
        ("consumer-kill", 2, 12.0),
        ("server-kill", None, math.inf),
    ]


def test_consumers_differ_and_two_share_a_stream() -> None:
    assert len({each.stream for each in PROFILES}) == len(PROFILES) - 1
    assert profile(len(PROFILES)) == PROFILES[0]
    paper = PROFILES[1].stream_spec.recipe
    assert (paper.voxels_per_clip, paper.crop_height_px, paper.crop_width_px) == (40, 128, 128)


def test_ports_are_below_those_of_outgoing_connections() -> None:
    ports = free_ports(3)
    assert len(set(ports)) == 3
    assert all(20_000 <= port < 30_000 for port in ports)


def test_what_is_left_over_is_found(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "run", tmp_path, workers=1, consumers=1, lease_deadline_seconds=5.0)
    assert fleet.traces() == []
    (fleet.tmp / "forgotten").write_text("x", encoding="utf-8")
    (fleet.cache / "index.sqlite-wal").write_text("x", encoding="utf-8")
    fleet.port_file.write_text("x", encoding="utf-8")
    assert fleet.traces() == ["file tmp/forgotten", "file index.sqlite-wal", "the port file"]


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
def test_a_short_run_keeps_the_promise(tmp_path: Path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    for number in range(6):
        write_clip(clips / f"{number}.mp4", panned_luma(201, 128, 160, step=(1, 1 + number)), gop=12)
    out = tmp_path / "chaos.json"
    flags = ["--minutes", "0.5", "--every", "1.5", "--remakes", "60", "--seed", "3"]
    status = main(["chaos", "--videos", str(clips), *flags, "--keep", str(tmp_path / "run"), "--json", str(out)])
    (record,) = json.loads(out.read_text(encoding="utf-8"))
    assert set(DEMANDED) <= set(record)
    assert {key: record[key] for key in chaos.FAILING} == dict.fromkeys(chaos.FAILING, 0)
    assert record["kills"] > 3
    assert record["samples"] > 50
    assert status == 0
