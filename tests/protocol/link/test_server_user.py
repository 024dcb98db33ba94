"""A peer without a key speaks only to a server of its own user or root, at every connection."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress

import pytest

from bench.processes import free_ports
from tests.waiting import until
from v2v_protocol.errors import UsageError
from v2v_protocol.link.dealer import Dealer

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux names the user")
as_root = pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="acts as another user: as root")

SERVER = """
import os, sys, threading, zmq
context, user, address = zmq.Context(), int(sys.argv[1]), sys.argv[2]
if user != os.geteuid():
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)
router = context.socket(zmq.ROUTER)
router.setsockopt(zmq.LINGER, 0)
router.setsockopt(zmq.IPV6, 1)
router.setsockopt(zmq.HANDSHAKE_IVL, 1000)
events = router.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
def report():
    before = 0
    while True:
        event = int.from_bytes(events.recv_multipart()[0][:2], sys.byteorder)
        if before == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL and event == zmq.EVENT_ACCEPTED:
            print("accepted again", file=sys.stderr, flush=True)
        before = event
threading.Thread(target=report, daemon=True).start()
router.bind(address)
print("listening", flush=True)
while True:
    print(router.recv_multipart()[1:], flush=True)
"""
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
"""Of a server of ZMTP 3.0."""
OLD = bytes.fromhex("ff00000000000000017f0106")
"""How a server of ZMTP 2.0 begins, which has no handshake."""


class Server:
    """A server of some user, and what it received."""

    def __init__(self, user: int, address: str) -> None:
        command = [sys.executable, "-c", SERVER, str(user), address]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "listening\n"

    def accept_again(self) -> None:
        """Wait until it has given up a handshake and accepted the next connection."""
        assert self.process.stderr is not None
        assert self.process.stderr.readline() == "accepted again\n"

    def stop(self) -> str:
        """Return what it received."""
        self.process.kill()
        with self.process:
            return "" if self.process.stdout is None or self.process.stdout.closed else self.process.stdout.read()


@pytest.fixture
def serve() -> Iterator[Callable[[int, str], Server]]:
    running: list[Server] = []

    def start(user: int, address: str) -> Server:
        running.append(Server(user, address))
        return running[-1]

    yield start
    for each in running:
        each.stop()


@pytest.fixture
def address() -> str:
    return f"tcp://127.0.0.1:{free_ports(1)[0]}"


def use(link: Dealer, handshakes: int = 1) -> None:
    """Use a link until that many handshakes have succeeded."""

    def has_all() -> bool:
        link.receive(0.05)
        link.has_reconnected()
        return link._handshakes.succeeded >= handshakes

    until(has_all)


@as_root
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.2", "[::1]", "[::ffff:127.0.0.1]"])
@pytest.mark.parametrize("looks_up", [False, True], ids=["asked", "looked up"])
def test_a_server_of_another_user_gets_nothing(
    serve: Callable[[int, str], Server], host: str, looks_up: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def deny(*_: object) -> None:
        raise PermissionError

    if looks_up:
        monkeypatch.setattr("v2v_protocol.link.user._ask", deny)
    port = free_ports(1)[0]
    server = serve(12345, f"tcp://*:{port}")
    with closing(Dealer(f"tcp://{host}:{port}", "")) as link:
        link.connect()
        link.send([b"secret"])
        with pytest.raises(
            UsageError, match=r"belongs to user 12345, not to root or user 0: nothing was sent.*insecure"
        ):
            use(link)
    assert server.stop() == ""


@as_root
@pytest.mark.parametrize(("user", "insecure"), [(0, False), (12345, True)])
def test_root_is_admitted_and_any_user_with_insecure(
    serve: Callable[[int, str], Server], address: str, user: int, insecure: bool
) -> None:
    server = serve(user, address)
    with closing(Dealer(address, "", insecure=insecure)) as link:
        link.connect()
        link.send([b"hello"])
        use(link)
        assert server.process.stdout is not None
        assert server.process.stdout.readline() == "[b'hello']\n"


@as_root
def test_nor_does_one_that_takes_the_port_later(serve: Callable[[int, str], Server], address: str) -> None:
    first = serve(0, address)
    with closing(Dealer(address, "")) as link:
        link.connect()
        use(link)
        first.stop()
        link.send([b"secret of before"])
        second = serve(12345, address)
        link.send([b"secret"])
        assert link._questions.poll(
            60_000
        )  # ZeroMQ has connected by itself; nothing is answered before this peer looks
        with pytest.raises(UsageError, match="belongs to user 12345"):
            use(link, handshakes=2)
        assert second.stop() == ""


def test_a_connection_to_a_server_that_comes_back_is_made_again(
    serve: Callable[[int, str], Server], address: str
) -> None:
    """Also while this peer does not look for longer than the server waits for a handshake."""
    with closing(Dealer(address, "")) as link:
        link.connect()
        for number in range(2):
            server = serve(os.geteuid(), address)
            if number:
                server.accept_again()
            use(link, handshakes=number + 1)
            link.send([b"%d" % number])
            assert server.process.stdout is not None
            assert server.process.stdout.readline() == f"[b'{number}']\n"
            server.stop()


def test_the_question_of_a_connection_that_has_ended_is_not_answered_to_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor if it cannot be known which of the two has asked. The answer would wait for the one after that."""
    monkeypatch.setattr("v2v_protocol.link.dealer.mechanism_of", lambda address: b"")  # makes connections of its own
    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        closing(Dealer(f"tcp://127.0.0.1:{listening.getsockname()[1]}", "")) as link,
    ):
        link.connect()
        link.send([b"secret"])
        with listening.accept()[0] as first:
            first.sendall(GREETING)
            assert link._questions.poll(60_000)
        with listening.accept()[0] as second:
            second.settimeout(60.0)
            second.recv(1, socket.MSG_PEEK)  # ZeroMQ has told of the connection before it speaks
            link.has_reconnected()  # reads the question of the first
            second.sendall(GREETING)
            assert link._questions.poll(60_000)
            link.has_reconnected()
            second.settimeout(0.3)
            assert len(received(second)) == len(GREETING)
        with listening.accept()[0] as third:
            third.sendall(GREETING)
            assert link._questions.poll(60_000)
            third.settimeout(0.3)
            assert len(received(third)) == len(GREETING)
            link.has_reconnected()
            third.settimeout(60.0)
            assert b"READY" in third.recv(1 << 16)


def test_a_server_that_has_no_handshake_gets_nothing() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        closing(Dealer(f"tcp://127.0.0.1:{listening.getsockname()[1]}", "")) as link,
    ):
        link.connect()
        link.send([b"secret"])
        with listening.accept()[0] as peer:
            peer.sendall(OLD)
            peer.settimeout(60.0)
            assert b"secret" not in received(peer)


def received(peer: socket.socket) -> bytes:
    """Return what comes until nothing more comes."""
    found = b""
    with suppress(TimeoutError):
        while piece := peer.recv(1 << 16):
            found += piece
    return found
