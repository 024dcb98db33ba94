"""The page while strangers connect to it, and while there are no descriptors."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import psutil
import pytest

from tests.waiting import until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux names the user")

FLOOD = """
import os, socket, sys
"".encode("idna")  # loads it
os.setgroups([])
os.setgid(12345)
os.setuid(12345)
links = []
for _ in range(600):
    links.append(socket.create_connection(("127.0.0.1", int(sys.argv[1])), timeout=60))
    links[-1].setblocking(False)
print("connected", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Callable[[int], tuple[int, psutil.Process, Path]]]:
    """Start a page with a limit of descriptors; return its port, process and log. Its server does not answer."""
    with ExitStack() as stack:

        def start(descriptors: int) -> tuple[int, psutil.Process, Path]:
            listening = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=64))
            log = tmp_path / "log"
            command = [sys.executable, "-m", "v2v_server.page.app", "--connect", f"ipc://{tmp_path}/none"]
            command += ["--fd", str(listening.fileno()), "--parent-pid", str(os.getpid())]
            with log.open("wb") as file:
                child = subprocess.Popen(command, stderr=file, pass_fds=[listening.fileno()])
            stack.callback(child.wait)
            stack.callback(child.kill)
            port = listening.getsockname()[1]
            until(lambda: answered(port) or child.poll() is not None)
            resource.prlimit(child.pid, resource.RLIMIT_NOFILE, (descriptors, descriptors))
            return port, psutil.Process(child.pid), log

        yield start


def answered(port: int) -> bool:
    with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/fields", timeout=60) as answer:
        return answer.status == 200  # type: ignore[no-any-return]
    return False


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="acts as another user: as root")
def test_strangers_take_no_place_and_no_descriptor(page: Callable[[int], tuple[int, psutil.Process, Path]]) -> None:
    port, process, log = page(400)  # fewer than the strangers' connections
    command = [sys.executable, "-c", FLOOD, str(port)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as flood:
        assert flood.stdout is not None
        assert flood.stdout.readline() == b"connected\n"
        assert answered(port)
        assert process.num_fds() < 100
    (line,) = log.read_text().splitlines()
    assert "refused a connection of user 12345" in line


def test_connections_beyond_the_limit_are_closed(page: Callable[[int], tuple[int, psutil.Process, Path]]) -> None:
    port, process, log = page(1024)
    with ExitStack() as opened:
        links = [opened.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(300)]
        links[-1].settimeout(60.0)
        assert links[-1].recv(1) == b""
        assert process.num_fds() < 300
    until(lambda: answered(port))
    assert log.read_text() == ""


def test_without_descriptors_it_pauses_says_so_in_a_line_and_goes_on(
    page: Callable[[int], tuple[int, psutil.Process, Path]],
) -> None:
    port, process, log = page(1024)
    most = process.num_fds() + 4
    resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (most, most))
    with ExitStack() as opened:
        for _ in range(30):
            opened.enter_context(closing(socket.create_connection(("127.0.0.1", port))))
        until(log.read_text)
        before = process.cpu_times().user
    until(lambda: answered(port))
    lines = log.read_text().splitlines()
    assert process.cpu_times().user - before < 2.0
    assert set(lines) == {"the page accepts no connections for 5 s: Too many open files"}
    assert len(lines) <= 2
