"""Which users of a host a server without keys serves: its own and root, without any flag."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from bench.processes import free_ports
from tests.clips import panned_luma, write_clip
from v2v_client import V2VStreamDataset
from v2v_protocol.errors import UsageError

pytestmark = [
    pytest.mark.skipif(
        sys.platform != "linux" or os.geteuid() != 0 or shutil.which("setpriv") is None,
        reason="acts as other users: Linux, as root",
    ),
    pytest.mark.slow,
]

SMALL = ("--set", "voxels_per_clip=4", "--set", "crop_height_px=32", "--set", "crop_width_px=40")
ROOT, OTHER_USER, ALICE = 0, 65534, 12345


def acting_as(user: int) -> list[str]:
    """Return the start of a command line that runs the rest as another user, who may read this project."""
    flags = ["--reuid", str(user), "--regid", str(user), "--clear-groups"]
    return ["setpriv", *flags, "--inh-caps", "+dac_read_search", "--ambient-caps", "+dac_read_search", sys.executable]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., tuple[str, Path]]]:
    """Start a server of a user; return its address and its log."""
    running: list[subprocess.Popen[bytes]] = []
    tmp_path.chmod(0o777)
    clips = tmp_path / "clips"
    clips.mkdir()
    write_clip(clips / "a.mp4", panned_luma(60, 48, 64))

    def start(user: int, *flags: str) -> tuple[str, Path]:
        log, port, home = (tmp_path / f"{user}-{name}" for name in ("log", "port", "home"))
        home.mkdir()
        os.chown(home, user, user)
        command = [*acting_as(user), "-m", "v2v_server", "--videos", clips, "--bind", "tcp://127.0.0.1:*", *SMALL]
        with log.open("wb") as file:
            environment = os.environ | {"TERM": "xterm", "V2V_CACHE_DIR": str(home)}
            where = ["--port-file", home / port.name]
            running.append(subprocess.Popen([*command, *where, *flags], stderr=file, env=environment, cwd="/"))
        while not (home / port.name).exists():  # a worker may have to compile the kernels
            with suppress(subprocess.TimeoutExpired):
                running[-1].wait(0.1)
                pytest.fail(log.read_text())
        return (home / port.name).read_text().strip(), log

    yield start
    for each in running:
        each.terminate()
        each.wait(60)


def status_of(address: str, user: int, *flags: str) -> subprocess.CompletedProcess[str]:
    """Ask for the status, as v2v-top does."""
    command = [*acting_as(user), "-m", "v2v_server.commands.top", "--once", "--connect", address, *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd="/")


def test_another_user_gets_no_reply_and_root_and_the_own_user_do(serve: Callable[..., tuple[str, Path]]) -> None:
    address, log = serve(ROOT, "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*")
    refused = status_of(address, OTHER_USER)
    assert refused.returncode == 1
    assert "Without keys it serves its own user only" in refused.stderr
    assert "refused a connection of user 65534" in log.read_text()
    assert "v2v-keys init" in log.read_text()
    assert status_of(address, ROOT).returncode == 0


def test_another_users_server_is_not_spoken_to(serve: Callable[..., tuple[str, Path]], tmp_path: Path) -> None:
    """By no peer, unless it is told to: the server would serve all."""
    address, log = serve(ALICE, "--workers", "0", "--insecure", "--worker-bind", "tcp://127.0.0.1:*")
    (port,) = [line.rpartition("workers to ")[2] for line in log.read_text().splitlines() if "workers to " in line]
    refusal = f"the server there belongs to user {ALICE}, not to root or user {ROOT}: nothing was sent"
    for program, flags in (
        ("v2v_server.commands.top", ("--once", "--connect", address)),
        ("v2v_client.loadtest", ("--connect", address)),
        ("v2v_server.commands.worker", ("--connect", port, "--videos", str(tmp_path / "clips"))),
    ):
        command = [sys.executable, "-m", program, *flags]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert (done.returncode, refusal in done.stderr) == (2, True), done.stderr
    with pytest.raises(UsageError, match=refusal):
        len(V2VStreamDataset(address, batch_size=1))
    assert len(V2VStreamDataset(address, batch_size=1, insecure=True)) > 0
    assert status_of(address, ROOT, "--insecure").returncode == 0


def test_a_workers_port_without_keys_is_for_the_same_user(serve: Callable[..., tuple[str, Path]]) -> None:
    _, log = serve(ALICE, "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*")
    (port,) = [line.rpartition("workers to ")[2] for line in log.read_text().splitlines() if "workers to " in line]
    assert status_of(port, OTHER_USER, "--insecure").returncode == 1
    assert status_of(port, ALICE).returncode == 0


def test_insecure_serves_every_user(serve: Callable[..., tuple[str, Path]]) -> None:
    address, log = serve(ALICE, "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*", "--insecure")
    assert status_of(address, OTHER_USER, "--insecure").returncode == 0
    assert "refused" not in log.read_text()


def test_the_page_is_for_the_same_user_unless_it_is_insecure(serve: Callable[..., tuple[str, Path]]) -> None:
    fetch = (
        "import sys, http.client; c = http.client.HTTPConnection('127.0.0.1', int(sys.argv[1]), timeout=60); "
        "c.request('GET', '/healthz'); print(c.getresponse().status)"
    )

    def got(port: int, user: int) -> str:
        command = [*acting_as(user), "-c", fetch, str(port)]
        while True:
            asked = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd="/")
            if asked.stdout != "503\n":  # not answered by the server yet
                return asked.stdout

    closed, opened = free_ports(2)
    _, log = serve(ALICE, "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*", "--page", str(closed))
    assert got(closed, ALICE) == "200\n"
    assert got(closed, ROOT) == "200\n"
    assert got(closed, OTHER_USER) == ""
    assert "refused a connection of user 65534" in log.read_text()
    assert "the page serves only root and the server's user" in log.read_text()
    serve(ROOT, "--workers", "0", "--worker-bind", "tcp://127.0.0.1:*", "--page", str(opened), "--insecure")
    assert got(opened, OTHER_USER) == "200\n"
