"""The service as its users meet it: start, stop, bad input, bad peers."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import zmq

from tests.stream.conftest import SMALL_FLAGS, epoch_of, server_workers
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_protocol.messages import Denied, Ping, Pong, decode, encode
from v2v_server.worker.process import LARGEST_MEMORY_BYTES


@pytest.fixture
def raw(server: LocalServer) -> Iterator[tuple[zmq.Socket[bytes], str]]:
    """A bare socket on a running server, and its address."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.setsockopt(zmq.RCVTIMEO, 60_000)
        dealer.connect(server.address)
        yield dealer, server.address


def _ask(dealer: zmq.Socket[bytes], *frames: bytes) -> object:
    dealer.send_multipart(frames)
    return decode(dealer.recv_multipart()[0])


def test_garbage_on_the_port_does_not_disturb_other_peers(raw: tuple[zmq.Socket[bytes], str]) -> None:
    dealer, address = raw
    host, port = address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as plain:
        plain.sendall(os.urandom(4096))
    for frames in ([b""], [b"\xc1" * 50], [random.Random(0).randbytes(1000)], [b"a", b"b", b"c"], [encode(Pong())[0]]):
        answer = _ask(dealer, *map(bytes, frames))
        assert isinstance(answer, Denied)
        assert answer.code == "malformed"
    assert _ask(dealer, bytes(encode(Ping())[0])) == Pong()
    assert len(epoch_of(address)) == 8


def test_every_worker_is_under_a_limit_of_memory(server: LocalServer) -> None:
    def limits() -> set[int]:
        return {worker.rlimit(psutil.RLIMIT_DATA)[0] for worker in server_workers(server.pid)}

    until(lambda: limits() == {LARGEST_MEMORY_BYTES})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_everything(clips: Path, tmp_path: Path, number: signal.Signals) -> None:
    port_file = tmp_path / "port"
    server = _start(clips, "--port-file", str(port_file), *SMALL_FLAGS)
    try:
        _wait_for(server, port_file)
        address = port_file.read_text(encoding="utf-8").strip()
        workers = server_workers(server.pid)
        assert len(workers) == 1
        server.send_signal(number)
        assert server.wait(timeout=60) == 0
    finally:
        _end(server)
    assert not psutil.wait_procs(workers, timeout=60)[1]
    assert not port_file.exists()
    with socket.socket() as probe:
        host, port = address.removeprefix("tcp://").split(":")
        assert probe.connect_ex((host, int(port))) != 0


def _start(videos: Path, *flags: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "v2v_server", "--videos", str(videos), "--workers", "1"]
    return subprocess.Popen(
        [*command, "--bind", "tcp://127.0.0.1:*", *flags],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wait_for(server: subprocess.Popen[str], port_file: Path) -> None:
    until(lambda: port_file.exists() or server.poll() is not None)
    assert server.poll() is None, server.stderr.read() if server.stderr else ""


def _end(server: subprocess.Popen[str]) -> None:
    if server.poll() is None:
        server.kill()
    server.communicate(timeout=60)
