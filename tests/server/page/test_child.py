"""The page's process: beside a server that it cannot harm, and gone when the server is."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from bench.processes import free_ports
from tests.clips import panned_luma, write_clip
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError
from v2v_server.config import ServeConfig
from v2v_server.page.child import PageProcess

SMALL = ("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40")


def got(port: int, path: str, host: str | None = None) -> tuple[int, str]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}")
    if host is not None:
        request.add_header("Host", host)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def page_of(pid: int) -> psutil.Process | None:
    for child in psutil.Process(pid).children():
        try:
            if "v2v_server.page.app" in child.cmdline():
                return child
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            continue
    return None


# --- its port ---------------------------------------------------------------------------------------------------------


def test_a_port_that_is_taken_is_said_with_a_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"--page {port} at 127.0.0.1: Address already in use; give another port"):
            PageProcess("127.0.0.1", port)


def test_an_unknown_host_is_reported() -> None:
    with pytest.raises(UsageError, match=r"--page 5580 at no-such-host\.invalid: .*give an address of this host"):
        PageProcess("no-such-host.invalid", 5580)


def test_a_package_that_is_missing_is_said_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_server.page.child.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"starlette, which is not installed; the extra 'page' brings it"):
        PageProcess("127.0.0.1", 0)


def test_a_page_that_others_can_reach_is_typed_out() -> None:
    with pytest.raises(UsageError, match="the page requires no key"):
        ServeConfig(videos="a", page=5580, page_host="0.0.0.0")
    # Keys are for consumers and workers; a browser has none.
    with pytest.raises(UsageError, match="the page requires no key"):
        ServeConfig(videos="a", page=5580, page_host="0.0.0.0", keys="keys/")
    assert ServeConfig(videos="a", page=5580, page_host="0.0.0.0", insecure=True).page == 5580
    assert ServeConfig(videos="a", page_host="0.0.0.0").page == 0


# --- its life ---------------------------------------------------------------------------------------------------------


def test_a_process_that_ends_is_said_and_started_again_ever_more_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = SimpleNamespace(pid=1, poll=lambda: -signal.SIGKILL, terminate=lambda: None, wait=lambda seconds: 0)
    started: list[float] = []
    monkeypatch.setattr(PageProcess, "_started", lambda self: started.append(now) or ended)
    page, said, now = PageProcess("127.0.0.1", 0), [], 0.0
    assert page.watch(now) == []  # not started yet
    page.start("ipc://somewhere")
    while now < 20.0:
        said += page.watch(now)
        now += 0.5
    page.stop()
    assert started == [0.0, 1.5, 4.0, 8.5, 17.0]
    assert said[0] == ("the page's process was ended by SIGKILL; samples are not affected; it is restarted in 1 s")
    assert page.watch(now) == []


@pytest.fixture
def clips(compiled: None, tmp_path: Path) -> Path:
    for number in range(3):
        write_clip(tmp_path / f"{number}.mp4", panned_luma(60, 48, 64, step=(1, 1 + number)))
    return tmp_path


@pytest.fixture
def served(clips: Path) -> Iterator[tuple[LocalServer, int]]:
    (port,) = free_ports(1)
    with LocalServer(clips, workers=1, flags=[*SMALL, "--page", str(port)]) as server:
        yield server, port


@pytest.mark.slow
def test_a_server_with_a_page_is_watched_over_http_and_survives_the_pages_death(
    served: tuple[LocalServer, int],
) -> None:
    server, port = served
    until(lambda: got(port, "/readyz")[0] == 200)
    assert got(port, "/state", "evil.example")[0] == 421
    batches = iter(V2VStreamDataset(server.address, batch_size=2, timeout_seconds=600.0))
    next(batches)
    state: dict[str, Any] = {}

    def seen() -> bool:
        state.update(json.loads(got(port, "/state")[1]))
        return bool(state["consumers"] and state["consumers"][0]["served"])

    until(seen)
    (consumer,) = state["consumers"]
    assert (consumer["name"], consumer["batch_size"], state["worker_count"]) == ("rank 0 of 1", 2, 1)
    assert consumer["host"]
    assert consumer["served"] >= 2
    (worker,) = state["workers"]
    assert worker["memory_gib"] > 0.01
    assert worker["restarts"] == 0
    assert state["totals"]["decode_seconds"] > 0.0 < state["totals"]["simulate_seconds"]
    assert state["totals"]["handover_seconds"] > 0.0
    assert "v2v_samples_total" in got(port, "/metrics")[1]
    page = page_of(server.pid)
    assert page is not None
    page.kill()
    next(batches)
    until(lambda: page_of(server.pid) not in (None, page))
    until(lambda: got(port, "/healthz")[0] == 200)
    assert "the page's process was ended by SIGKILL; samples are not affected" in server.last_lines()
    batches.close()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_the_page_ends_with_its_server_even_when_that_is_killed(clips: Path) -> None:
    (port,) = free_ports(1)
    server = subprocess.Popen(
        [
            *(
                sys.executable,
                "-m",
                "v2v_server",
                "--videos",
                str(clips),
                "--workers",
                "0",
                "--worker-bind",
                "tcp://127.0.0.1:*",
                *SMALL,
            ),
            *("--bind", "tcp://127.0.0.1:*", "--page", str(port)),
        ],
        stderr=subprocess.DEVNULL,
    )
    try:
        until(lambda: page_of(server.pid))
        page = page_of(server.pid)
        assert page is not None
        until(lambda: got(port, "/healthz")[0] == 200)
        os.kill(server.pid, signal.SIGKILL)
        server.wait(60)
        assert psutil.wait_procs([page], timeout=60)[1] == []
        PageProcess("127.0.0.1", port).stop()  # the port is free
    finally:
        server.kill()
        server.wait()


@pytest.mark.slow
def test_with_keys_the_page_needs_none(clips: Path, tmp_path: Path) -> None:
    keys, (port,) = tmp_path / "keys", free_ports(1)
    made = subprocess.run(
        [sys.executable, "-m", "v2v_protocol.programs", "keys", "init", "--dir", str(keys)], check=False
    )
    assert made.returncode == 0
    flags = [*SMALL, "--page", str(port), "--keys", str(keys), "--worker-bind", "tcp://127.0.0.1:*"]
    with LocalServer(clips, workers=1, flags=flags):
        until(lambda: got(port, "/readyz")[0] == 200)


@pytest.mark.slow
def test_a_browser_that_reads_nothing_does_not_stall_others(served: tuple[LocalServer, int]) -> None:
    server, port = served
    until(lambda: got(port, "/readyz")[0] == 200)
    stalled = [socket.create_connection(("127.0.0.1", port)) for _ in range(8)]
    for one in stalled:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    for epoch in range(4):  # states go on being made, and samples on being sent
        before = got(port, "/state")[1]
        assert (
            next(iter(V2VStreamDataset(server.address, batch_size=2, epoch=epoch, timeout_seconds=600.0))).epoch
            == epoch
        )
        until(lambda before=before: got(port, "/state")[1] != before)  # type: ignore[misc]
    for one in stalled:
        one.close()
