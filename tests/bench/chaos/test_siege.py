"""The siege: each kind of hostile peer against a server for real, for a moment; and its bars."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from bench.chaos.fleet import Fleet
from bench.chaos.hostile import KINDS, REFUSED
from bench.chaos.siege import CREDIT_FLAGS, CREDIT_MIB, PEERS, besiege, missed, stretch
from bench.chaos.trimming_server import MODULE
from tests.clips import write_panned
from tests.waiting import until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a connection guard")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_panned(tmp_path_factory.mktemp("siege-clips"), 3, 240, 160, 210)


@contextlib.contextmanager
def small_fleet(folder: Path, corpus: Path, **settings: Any) -> Iterator[Fleet]:
    """Run a server and a single consumer."""
    fleet = Fleet(folder / "fleet", corpus, 1, 2, 60.0, **settings)
    del fleet.crowd[0]
    try:
        fleet.start()
        yield fleet
    finally:
        fleet.kill()


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [tuple(KINDS)[0::3], tuple(KINDS)[1::3], tuple(KINDS)[2::3]])
def test_every_kind_is_survived_and_the_memory_comes_back(tmp_path: Path, corpus: Path, kinds: tuple[str, ...]) -> None:
    with small_fleet(tmp_path, corpus, server_module=MODULE, server_flags=CREDIT_FLAGS) as fleet:
        records = besiege(fleet, kinds, turns=1, seconds=3.0)
        assert stretch(fleet, 3.0).rate > 0
    # How fast the others are meanwhile is for the bench: here they only go on.
    assert all(record["kept"] > 0 for record in records), records
    assert not [text for record in records for text in missed({**record, "kept": 1.0})], records


@pytest.mark.slow
def test_an_attack_arrives(tmp_path: Path, corpus: Path) -> None:
    """Idle peers hold the server's files while they are connected: the attackers do arrive."""
    with small_fleet(tmp_path, corpus) as fleet:
        assert fleet.server.pid is not None
        server = psutil.Process(fleet.server.pid)
        calm = server.num_fds()
        with fleet.attacked("idle", last=False) as peers:
            until(lambda: server.num_fds() > calm + 50)
            assert peers.poll() is None


@pytest.mark.slow
def test_wrong_keys_are_turned_away_while_a_right_one_streams(tmp_path: Path, corpus: Path) -> None:
    with small_fleet(tmp_path, corpus, keyed=True) as fleet:
        with fleet.attacked(REFUSED, last=False):
            until(lambda: fleet.tally.exists() and fleet.tally.stat().st_size >= 30)  # of each of the three kinds
            before = fleet.committed()[0]
            until(lambda: fleet.committed()[0] > before + 1)
        fleet.restart(time.monotonic())
        assert not fleet.failures


def test_bars() -> None:
    good = {"kind": "headers", "kept": 0.8, "peak_mib": 300.0 + CREDIT_MIB * (PEERS + 1), "after_mib": 20.0}
    assert not missed(good)
    for name, value in (("kept", 0.79), ("peak_mib", 301.0 + CREDIT_MIB * (PEERS + 1)), ("after_mib", 20.1)):
        assert len(missed(good | {name: value})) == 1
