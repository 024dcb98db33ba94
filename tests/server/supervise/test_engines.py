"""Which supervisor a server has, what it says where it cannot have it, and that another kind of host is one file."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.server.supervise.toy_host import ToyHost
from v2v_protocol.errors import UsageError
from v2v_protocol.programs import install_line
from v2v_server import config
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.corpus.sources.folder import Folder
from v2v_server.supervise.pool import Death, Pool, crash_budget, make_pool

RAY = {"videos": "videos", "engine": "ray", "worker_bind": "tcp://127.0.0.1:5556"}


def test_the_usual_one_is_this_hosts_pool() -> None:
    assert make_pool(ServeConfig(videos="videos"), Folder(Path("videos")), "w", []).is_local


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "v2v_server.supervise.ray_host", raising=False)
    with pytest.raises(UsageError, match=f"needs the Python package ray.*{re.escape(install_line('ray'))}"):
        make_pool(ServeConfig(**RAY), Folder(Path("videos")), "w", [])


def test_workers_elsewhere_need_an_address_they_can_reach() -> None:
    with pytest.raises(UsageError, match="--worker-bind tcp://HOST:5556"):
        ServeConfig(**RAY | {"worker_bind": ""})


@pytest.mark.parametrize("label", ["corpus", "=clips", "corpus="])
def test_half_a_label_is_none(label: str) -> None:
    with pytest.raises(UsageError, match=r"--ray-label .*write KEY=VALUE"):
        ServeConfig(**RAY | {"ray_label": label})
    assert ServeConfig(**RAY | {"ray_label": "corpus=clips"}).ray_labels == {"corpus": "clips"}


def test_ray_is_loaded_by_its_host_only_which_says_what_to_start_where_no_cluster_is(unused_port: int) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    # In a process of its own: importing Ray changes warnings, signal handlers and more.
    address = f"127.0.0.1:{unused_port}"
    program = (
        "import sys, v2v_server.serve\nprint('ray' in sys.modules)\n"
        f"from v2v_server.supervise.ray_host import RayHost\nRayHost('videos', 'w', address='{address}')"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
    assert done.stdout == "False\n"
    assert f"UsageError: --ray-address {address}: " in done.stderr
    assert "ray start --head" in done.stderr


# --- a host that takes one file (:mod:`tests.server.supervise.toy_host`) and one line ---------------------------------


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
    assert pool.watch(1.19, 0) == []
    assert pool.running == 1
    assert pool.watch(1.21, 0) == []
    assert first.name == "label-0.2"
    assert pool.restarts == {b"label-0.2": 1, b"label-1.1": 0}
    assert pool.news() == ["all workers are toys"]
    assert not pool.is_local


def test_any_finished_sample_forgives(pool: Pool) -> None:
    pool.scale(1)
    now = 0.0
    for samples in range(2 * crash_budget(1)):
        pool.watch(now, samples)
        host_of(pool).places[0].die(Cause.CRASHED)
        # The first death after progress waits the shortest time again.
        assert len(pool.watch(now, samples + 1)) == 1
        now += 0.21


def test_its_surplus_workers_leave_and_hung_ones_are_killed(pool: Pool) -> None:
    pool.scale(3)
    pool.watch(0.0, 0)
    first, second, third = host_of(pool).places
    pool.scale(2)
    assert third.told == ["leave"]
    third.die(Cause.UNEXPLAINED, returncode=0)
    assert pool.watch(1.0, 0) == []
    assert third.told == ["leave", "release"]
    assert pool.give_up(b"label-9.9", "slept") is None
    assert pool.give_up(b"label-0.1", "slept") == Loss(Cause.HUNG, "slept", 7, for_all=True)
    assert first.told == ["SIGKILL"]
    assert not pool.watches(b"label-0.1")
    assert pool.watch(2.0, 0) == []
    assert pool.watches(b"label-1.1")
    # The next life of the slot is a new worker: its death is reported.
    assert pool.watch(100.0, 0) == []
    first.die(Cause.CRASHED)
    assert [death.identity for death in pool.watch(200.0, 0)] == [b"label-0.2"]
    # And a new slot has a new number.
    pool.scale(3)
    assert pool.watch(300.0, 0) == []
    assert pool.watches(b"label-3.1")
    pool.stop(0.0, 0.0)
    assert second.told == ["SIGTERM", "release"]
    assert host_of(pool).requested == [3, 2, 3]
    assert host_of(pool).is_closed


@pytest.mark.parametrize(
    ("state", "loss"),
    [
        (psutil.STATUS_STOPPED, Loss(Cause.KILLED, "was stopped from outside and killed")),
        # All workers of a host wait then, each at a sound clip.
        (psutil.STATUS_DISK_SLEEP, Loss(Cause.UNEXPLAINED, "waited for its storage and slept", 7, for_all=True)),
    ],
)
def test_one_that_cannot_run_is_not_called_hung(pool: Pool, state: str, loss: Loss) -> None:
    pool.scale(1)
    pool.watch(0.0, 0)
    host_of(pool).places[0].state = state
    assert pool.give_up(b"label-0.1", "slept") == loss


def test_a_slot_without_a_worker_is_released_at_once(pool: Pool) -> None:
    pool.scale(1)
    pool.scale(0)
    assert host_of(pool).places[0].told == ["leave", "release"]
    assert pool.watch(0.0, 0) == []
