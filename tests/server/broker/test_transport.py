"""The sockets: who cannot be reached is said, and the system looks after silent connections."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import zmq

from tests.waiting import until
from v2v_protocol.link import router
from v2v_protocol.link.router import ConsumerGone, FromConsumer, FromWorker, InFlight, ServerInput, Sockets
from v2v_protocol.messages import Ping, Pong, Stop, encode


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with closing(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")) as both:
        yield both


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="Linux only")
def test_the_system_looks_after_connections_on_which_nothing_is_said(sockets: Sockets) -> None:
    """A host that lost power closes none of them."""
    for address in (sockets.address, sockets.worker_address):
        with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as peer:
            peer.recv(1)  # ZeroMQ's greeting: it has taken the connection
            until(lambda: _keepalive_is_due(peer))


def _keepalive_is_due(peer: socket.socket) -> bool:
    """Whether the other end of a connection, which is idle, waits to send a probe: proc_net_tcp(5), timer 2."""
    ends = [f"0100007F:{port:04X}" for _, port in (peer.getpeername(), peer.getsockname())]
    rows = (line.split() for line in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines())
    return any(row[1:3] == ends and row[5].startswith("02:") for row in rows)


@pytest.mark.skipif(sys.platform != "linux" or os.getuid() != 0, reason="takes another user's place: Linux, as root")
def test_another_user_of_the_host_is_no_worker() -> None:
    """40 leases went to one, and its forged samples to consumers."""
    says = (
        "import os, sys, zmq\n"
        "os.setuid(int(sys.argv[2]))\n"
        "peer = zmq.Context().socket(zmq.DEALER)\n"
        "peer.connect(sys.argv[1])\n"
        "peer.send(b'mine')\n"
        "peer.poll(int(sys.argv[3]))\n"
    )

    def answered(sockets: Sockets, user: int, waits_ms: int) -> bool:
        command = [sys.executable, "-c", says, sockets.worker_address, str(user), str(waits_ms)]
        with subprocess.Popen(command) as process:
            came = False
            while not came and process.poll() is None:
                came = any(isinstance(arrival, FromWorker) for arrival in sockets.receive(0.1))
            process.kill()
        return came

    with closing(Sockets("tcp://127.0.0.1:*", f"ipc://@v2v-test-{os.getpid()}")) as sockets:
        assert answered(sockets, 0, 60_000)
        assert not answered(sockets, 65534, 3000)


def test_sending_to_an_unknown_peer_returns_false(sockets: Sockets) -> None:
    assert not sockets.send(b"w", encode(Stop()), to_worker=True)
    assert not sockets.send(b"c", encode(Pong()))


def test_one_message_of_each_side_comes_at_a_time_the_workers_first(sockets: Sockets) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as consumer, context.socket(zmq.DEALER) as worker:
        for peer, name, address in ((consumer, b"c", sockets.address), (worker, b"w", sockets.worker_address)):
            peer.setsockopt(zmq.LINGER, 0)
            peer.setsockopt(zmq.ROUTING_ID, name)
            peer.connect(address)
            for number in range(2):
                peer.send_multipart([*encode(Ping()), bytes([number])])
        until(lambda: len(dict(sockets._poller.poll(0))) == 2)
        came: list[ServerInput] = []
        while len(came) < 4:
            both = sockets.receive(60.0)
            assert [type(one) for one in both] in ([FromWorker, FromConsumer], [FromWorker], [FromConsumer])
            came += both
        assert sockets.receive(0.0) == []
        for kind in (FromWorker, FromConsumer):
            assert [bytes(one.frames[1]) for one in came if isinstance(one, kind)] == [b"\0", b"\1"]
        assert sockets.send(b"w", encode(Stop()), to_worker=True)
        assert sockets.send(b"c", encode(Pong()))


MIB = 1 << 20


@contextmanager
def consumers(sockets: Sockets, *names: bytes) -> Iterator[list[zmq.Socket[bytes]]]:
    """Peers that said something, and whose sockets take one message each until they are read."""
    context = zmq.Context()
    try:
        peers = [context.socket(zmq.DEALER) for _ in names]
        for peer, name in zip(peers, names, strict=True):
            for option, value in ((zmq.RCVHWM, 1), (zmq.RECONNECT_IVL, -1), (zmq.ROUTING_ID, name)):
                peer.setsockopt(option, value)
            peer.connect(sockets.address)
            peer.send_multipart(encode(Ping()))
            until(lambda: any(isinstance(arrival, FromConsumer) for arrival in sockets.receive(0.1)))
        yield peers
    finally:
        context.destroy(linger=0)


def counts(sockets: Sockets, found: dict[bytes, int]) -> dict[bytes, int]:
    """Add what is in flight to each consumer as far as it has changed."""
    return found | {each.identity: each.nbytes for each in sockets.receive(0.01) if isinstance(each, InFlight)}


def test_bytes_are_in_flight_until_their_consumer_takes_them(sockets: Sockets) -> None:
    with consumers(sockets, b"deaf", b"reads") as (deaf, reads):
        for name in (b"deaf", b"reads"):
            assert all(sockets.send(name, [b"", bytes(4 * MIB)]) for _ in range(30))
        found: dict[bytes, int] = {}
        found = counts(sockets, found)
        assert max(found.values()) <= 120 * MIB
        for _ in range(30):
            assert len(reads.recv_multipart()) == 2
        until(lambda: found.update(counts(sockets, found)) or not found[b"reads"])
        assert 90 * MIB < found[b"deaf"] < 120 * MIB
        for _ in range(30):
            deaf.recv_multipart()
        until(lambda: found.update(counts(sockets, found)) or not found[b"deaf"])


def test_small_messages_are_in_flight_too(sockets: Sockets) -> None:
    with consumers(sockets, b"deaf"):
        found: dict[bytes, int] = {b"deaf": 0}
        for _ in range(400):
            assert sockets.send(b"deaf", [bytes(60_000)])
            found = counts(sockets, found)
        assert 10 * MIB < found[b"deaf"] <= 24 * MIB


def test_a_consumer_that_never_reads_is_disconnected_at_the_limit_of_messages(sockets: Sockets) -> None:
    with consumers(sockets, b"deaf"):
        until(lambda: not sockets.send(b"deaf", [bytes(60_000)]))
        until(lambda: ConsumerGone(b"deaf") in sockets.receive(0.01))


def test_those_that_take_nothing_are_disconnected_if_there_is_too_much_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router, "_STUCK_SECONDS", 0.5)
    monkeypatch.setattr(router, "MOST_IN_FLIGHT_BYTES", 100 * MIB)
    sample, gone = bytes(4 * MIB), set[bytes]()
    with (
        closing(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")) as sockets,
        consumers(sockets, b"reads", *(b"deaf %d" % number for number in range(8))) as (reads, *_),
    ):
        for number in range(8):
            for _ in range(10):
                assert sockets.send(b"deaf %d" % number, [b"", bytearray(sample)])

        def is_bounded() -> bool:
            assert sockets.send(b"reads", [b"", bytearray(sample)])
            reads.recv_multipart()
            gone.update(each.identity for each in sockets.receive(0.01) if isinstance(each, ConsumerGone))
            queues = sockets._consumers._in_flight.values()
            return bool(gone) and sum(size for queue in queues for _, size in queue) <= 100 * MIB

        until(is_bounded)
        assert b"reads" not in gone
        assert 2 <= len(gone) < 8


def test_a_failed_call_costs_only_the_answer(sockets: Sockets, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def send(self, *arguments: object, **options: object) -> None:
            raise zmq.ZMQError(errno.ENOMEM)

    with consumers(sockets, b"c") as (peer,):
        with monkeypatch.context() as patch:
            patch.setattr(sockets._consumers, "socket", Broken())
            assert not sockets.send(b"c", encode(Pong()))
        until(lambda: ConsumerGone(b"c") in sockets.receive(0.01))
        assert not peer.poll(0)
