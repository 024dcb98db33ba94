"""Which supervisor a server has, and what it says where it cannot have it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from v2v_protocol.errors import UsageError
from v2v_server.config import ServeConfig
from v2v_server.corpus.sources.folder import Folder
from v2v_server.supervise.pool import make_pool

RAY = {"videos": "videos", "engine": "ray", "worker_bind": "tcp://127.0.0.1:5556"}


def test_the_usual_one_is_this_hosts_pool() -> None:
    assert make_pool(ServeConfig(videos="videos"), Folder(Path("videos")), "w", []).is_local


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "v2v_server.supervise.ray_host", raising=False)
    with pytest.raises(UsageError, match=r"needs the Python package ray.*pip install '\.\[server,ray\]'"):
        make_pool(ServeConfig(**RAY), Folder(Path("videos")), "w", [])


def test_workers_elsewhere_need_an_address_they_can_reach() -> None:
    with pytest.raises(UsageError, match="--worker-bind tcp://HOST:5556"):
        ServeConfig(**RAY | {"worker_bind": ""})


@pytest.mark.parametrize("label", ["corpus", "=clips", "corpus="])
def test_half_a_label_is_none(label: str) -> None:
    with pytest.raises(UsageError, match=r"--ray-label .*write KEY=VALUE"):
        ServeConfig(**RAY | {"ray_label": label})
    assert ServeConfig(**RAY | {"ray_label": "corpus=clips"}).ray_labels == {"corpus": "clips"}


def test_a_server_whose_workers_are_here_loads_no_ray() -> None:
    program = "import sys, v2v_server.serve\nsys.exit('ray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_where_no_cluster_is_it_says_what_to_start(unused_port: int) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    # In a process of its own: importing Ray changes warnings, signal handlers and more.
    address = f"127.0.0.1:{unused_port}"
    program = f"from v2v_server.supervise.ray_host import RayHost\nRayHost('videos', 'w', address='{address}')"
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
    assert f"UsageError: --ray-address {address}: " in done.stderr
    assert "ray start --head" in done.stderr
