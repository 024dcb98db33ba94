"""Another kind of host takes one file (:mod:`tests.server.supervise.toy_host`) and one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.server.supervise.toy_host import ToyHost
from v2v_server import config
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.corpus.sources.folder import Folder
from v2v_server.supervise.pool import Death, Pool, make_pool


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Pool:
    monkeypatch.setitem(config.ENGINES, "toy", "tests.server.supervise.toy_host")
    asked = ServeConfig(videos="videos", engine="toy", worker_bind="tcp://127.0.0.1:5556")
    made = make_pool(asked, Folder(Path("videos")), "label", [])
    made.start("tcp://10.0.0.1:5556")
    return made


def host_of(pool: Pool) -> ToyHost:
    host = pool._host
    assert isinstance(host, ToyHost)
    return host


def test_its_workers_start_die_and_are_replaced(pool: Pool) -> None:
    pool.scale(2)
    assert pool.watch(0.0, 0) == []
    first, second = host_of(pool).places
    assert [(place.name, place.address) for place in (first, second)] == [
        ("label-0.1", "tcp://10.0.0.1:5556"),
        ("label-1.1", "tcp://10.0.0.1:5556"),
    ]
    first.die(Cause.CRASHED)
    assert pool.running == 1
    assert pool.watch(1.0, 0) == [Death(b"label-0.1", Loss(Cause.CRASHED, "died"))]
    assert pool.watch(2.0, 0) == []
    assert first.name == "label-0.2"
    assert pool.restarts == {b"label-0.2": 1, b"label-1.1": 0}
    assert pool.news() == ["all workers are toys"]
    assert not pool.is_local


def test_its_surplus_workers_leave_and_hung_ones_are_killed(pool: Pool) -> None:
    pool.scale(3)
    pool.watch(0.0, 0)
    first, second, third = host_of(pool).places
    pool.scale(2)
    assert third.told == ["leave"]
    third.die(Cause.UNEXPLAINED, returncode=0)
    assert pool.watch(1.0, 0) == []
    assert third.told == ["leave", "release"]
    assert pool.give_up(b"label-0.1", "slept") == Loss(Cause.HUNG, "slept", 7, for_all=True)
    assert first.told == ["SIGKILL"]
    assert not pool.watches(b"label-0.1")
    assert pool.watch(2.0, 0) == []
    assert pool.watches(b"label-1.1")
    pool.stop(0.0, 0.0)
    assert second.told == ["SIGTERM", "release"]
    assert host_of(pool).requested == [3, 2]
    assert host_of(pool).is_closed


def test_a_slot_without_a_worker_is_released_at_once(pool: Pool) -> None:
    pool.scale(1)
    pool.scale(0)
    assert host_of(pool).places[0].told == ["leave", "release"]
    assert pool.watch(0.0, 0) == []
