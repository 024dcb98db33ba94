"""The service as its users meet it: start, stop, bad input, bad peers."""

from __future__ import annotations

import os
import random
import signal
import socket
from pathlib import Path

import psutil
import pytest
import zmq

from tests.stream.conftest import SMALL_FLAGS, epoch_of, server_workers
from tests.waiting import until
from v2v_client.local_server import LocalServer
from v2v_protocol.messages import Denied, Ping, Pong, decode, encode
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES


def _ask(dealer: zmq.Socket[bytes], *frames: bytes) -> object:
    dealer.send_multipart(frames)
    return decode(dealer.recv_multipart()[0])


def test_garbage_on_the_port_does_not_disturb_other_peers(server: LocalServer) -> None:
    host, port = server.address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as plain:
        plain.sendall(os.urandom(4096))
    malformed = ([b""], [b"\xc1" * 50], [random.Random(0).randbytes(1000)], [b"a", b"b", b"c"], [encode(Pong())[0]])
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.LINGER, 0)
        dealer.setsockopt(zmq.RCVTIMEO, 60_000)
        dealer.connect(server.address)
        for frames in malformed:
            answer = _ask(dealer, *map(bytes, frames))
            assert isinstance(answer, Denied)
            assert answer.code == "malformed"
        assert _ask(dealer, bytes(encode(Ping())[0])) == Pong()
    assert len(epoch_of(server.address)) == 8


def test_every_worker_is_under_a_limit_of_memory(server: LocalServer) -> None:
    def limits() -> set[int]:
        return {worker.rlimit(psutil.RLIMIT_DATA)[0] for worker in server_workers(server.pid)}

    until(lambda: limits() == {LARGEST_MEMORY_BYTES})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_everything(clips: Path, number: signal.Signals) -> None:
    with LocalServer(clips, workers=1, flags=SMALL_FLAGS) as running:
        server, workers = psutil.Process(running.pid), server_workers(running.pid)
        assert len(workers) == 1
        server.send_signal(number)
        assert server.wait(60) == (130 if number == signal.SIGINT else 0)
        assert not psutil.wait_procs(workers, timeout=60)[1]
        with socket.socket() as probe:
            host, port = running.address.removeprefix("tcp://").split(":")
            assert probe.connect_ex((host, int(port))) != 0
