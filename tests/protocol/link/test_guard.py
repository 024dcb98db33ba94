"""Connections of a router: which have ended, how many there are, whose messages count, and the end of one."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.waiting import until
from v2v_protocol.link import router as guard
from v2v_protocol.link.router import MOST_MESSAGE_FRAMES, ConsumerGone, FromConsumer, FromWorker, ServerInput, Sockets
from v2v_protocol.messages import Ping, Pong, encode
from v2v_server.system.process import most_connections

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a connection guard")

READY = b"\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06DEALER"
GREETING = b"\xff\0\0\0\0\0\0\0\0\x7f\x03\0NULL" + bytes(16 + 1 + 31)
PROJECT = Path(__file__).resolve().parents[3]


@pytest.fixture
def serve() -> Iterator[Callable[..., Sockets]]:
    opened: list[Sockets] = []

    def start(has_session: Callable[[bytes], bool] = lambda identity: False, **limits: Any) -> Sockets:
        opened.append(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", **limits))
        opened[-1].has_session = has_session
        return opened[-1]

    yield start
    for each in opened:
        each.close()


@pytest.fixture
def consumer() -> Iterator[Callable[..., zmq.Socket[bytes]]]:
    context = zmq.Context()
    peers: list[zmq.Socket[bytes]] = []

    def connect(sockets: Sockets, name: bytes, address: str = "") -> zmq.Socket[bytes]:
        peer = context.socket(zmq.DEALER)
        peers.append(peer)
        peer.setsockopt(zmq.ROUTING_ID, name)
        peer.setsockopt(zmq.RECONNECT_IVL, -1)
        peer.connect(address or sockets.address)
        return peer

    yield connect
    context.destroy(linger=0)


def raw(address: str) -> socket.socket:
    """Return a peer that speaks ZMTP by hand, after the handshake."""
    peer = socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])), 60.0)
    peer.sendall(GREETING + READY)
    answer = b""
    with contextlib.suppress(ConnectionError):
        while b"READY" not in answer and (piece := peer.recv(4096)):
            answer += piece
    return peer


def is_ended(peer: socket.socket) -> bool:
    """Return whether the other end ends the connection within a minute."""
    peer.settimeout(60.0)
    try:
        while peer.recv(1 << 16):
            pass
    except ConnectionError:
        pass
    except TimeoutError:
        return False
    return True


def send_ping(peer: zmq.Socket[bytes], sockets: Sockets, kind: type = FromConsumer) -> ServerInput:
    """Send a Ping; return the next message that the server receives."""
    peer.send_multipart(encode(Ping()))
    return next_from(sockets, kind)


def next_from(sockets: Sockets, kind: type) -> ServerInput:
    came: list[ServerInput] = []

    def there() -> bool:
        came.extend(one for one in sockets.receive(0.05) if isinstance(one, kind))
        return bool(came)

    until(there)
    return came[0]


def guarded(sockets: Sockets, kind: type = FromConsumer) -> guard.ConnectionGuard:
    found = (sockets._consumers if kind is FromConsumer else sockets._workers).guard
    assert found is not None
    return found


# --- which have ended -------------------------------------------------------------------------------------------------


def test_the_place_of_a_killed_trainer_is_free(serve: Callable[..., Sockets]) -> None:
    sockets = serve(most_connections=1, has_session=lambda identity: True)
    script = (
        "import sys, time, zmq; peer = zmq.Context().socket(zmq.DEALER); peer.connect(sys.argv[1]); "
        f"peer.send({encode(Ping())[0]!r}); time.sleep(600)"
    )
    trainer = subprocess.Popen([sys.executable, "-c", script, sockets.address])
    try:
        arrival = next_from(sockets, FromConsumer)
        assert isinstance(arrival, FromConsumer)
        trainer.send_signal(signal.SIGKILL)
        trainer.wait()
        assert next_from(sockets, ConsumerGone) == ConsumerGone(arrival.identity)
        with raw(sockets.address) as newcomer:
            until(lambda: guarded(sockets)._connections)
            newcomer.settimeout(0.5)
            with pytest.raises(TimeoutError):
                newcomer.recv(1)  # it stays
    finally:
        trainer.kill()
        trainer.wait()


def test_the_end_of_a_connection_is_reported_after_its_late_message(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve()
    names = [b"%d" % number for number in range(20)]
    for name in names:
        peer = consumer(sockets, name)
        peer.setsockopt(zmq.LINGER, -1)
        peer.send_multipart(encode(Ping()))
        peer.close()
    other = consumer(sockets, b"other")
    heard: set[bytes] = set()
    gone: set[bytes] = set()

    def all_gone() -> bool:
        other.send_multipart(encode(Ping()))
        for one in sockets.receive(0.05):
            (gone if isinstance(one, ConsumerGone) else heard).add(one.identity)
        return b"other" in heard and gone - {b""} == heard - {b"other"}

    until(all_gone)


def test_a_last_message_is_handled_after_its_connection_has_ended(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    """A consumer says Goodbye and disconnects."""
    sockets = serve()
    peer = consumer(sockets, b"c")
    send_ping(peer, sockets)
    watched = guarded(sockets)
    peer.send_multipart(encode(Ping()))
    peer.close(linger=-1)
    until(lambda: not watched._connections)
    came: list[ServerInput] = []
    until(lambda: came.extend(sockets.receive(0.05)) or ConsumerGone(b"c") in came)
    until(lambda: came.extend(sockets.receive(0.05)) or came[-1] == ConsumerGone(b"c"))
    assert [one.identity for one in came if isinstance(one, FromConsumer)] == [b"c"]


# --- whose messages count ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_known", [True, False])
def test_a_late_message_is_not_taken_for_one_of_the_next_connection_with_its_descriptor(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], is_known: bool
) -> None:
    sockets = serve()
    connections = guarded(sockets)._connections
    early = consumer(sockets, b"early")
    if is_known:
        assert send_ping(early, sockets).identity == b"early"
    until(lambda: connections)
    descriptors = list(connections)
    for _ in range(2):
        early.send_multipart(encode(Ping()))
    early.close(linger=-1)
    until(lambda: not connections)
    honest = consumer(sockets, b"honest")
    until(lambda: list(connections) == descriptors)
    honest.send_multipart(encode(Ping()))
    came: list[ServerInput] = []

    def is_heard() -> bool:
        came.extend(sockets.receive(0.05))
        return b"honest" in [one.identity for one in came if isinstance(one, FromConsumer)]

    until(is_heard)
    sockets.cut(b"early")
    assert {one.identity for one in came if isinstance(one, FromConsumer)} == {b"honest"}
    assert ConsumerGone(b"honest") not in came
    assert sockets.send(b"honest", encode(Pong()))
    assert honest.poll(60_000)


def test_no_message_is_handled_before_its_connection_is_admitted(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    asked, answer = threading.Event(), threading.Event()

    def admits(link: socket.socket) -> bool:
        asked.set()
        return answer.wait(60.0)

    sockets = serve(admits=admits)
    peer = consumer(sockets, b"c")
    peer.send_multipart(encode(Ping()))
    assert asked.wait(60.0)
    assert [sockets.receive(0.05) for _ in range(10)] == [[]] * 10
    answer.set()
    assert next_from(sockets, FromConsumer).identity == b"c"


def test_a_refused_connection_is_ended_at_once_and_none_of_its_messages_handled(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    """Half of them send a message with their handshake, without waiting for the answer."""
    refused: set[int] = set()
    sockets = serve(admits=lambda link: link.getpeername()[1] not in refused)
    honest = consumer(sockets, b"honest")
    for number in range(20):
        with socket.socket() as stranger:
            stranger.bind(("127.0.0.1", 0))
            refused.add(stranger.getsockname()[1])
            stranger.connect(("127.0.0.1", int(sockets.address.rpartition(":")[2])))
            stranger.sendall(GREETING + READY + b"\0\x01!" * (number % 2))
            assert is_ended(stranger)
        refused.clear()
    assert send_ping(honest, sockets).identity == b"honest"
    assert [one for one in sockets.receive(0.2) if isinstance(one, FromConsumer)] == []


def test_a_message_of_a_refused_connection_gets_no_user_of_the_next_one_with_its_descriptor(
    serve: Callable[..., Sockets], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulate a connection whose message ZeroMQ has read before it is ended."""
    sockets = serve(admits=lambda link: is_own)
    connections = guarded(sockets)._connections
    is_own = False
    monkeypatch.setattr(guard, "_cut", lambda connection: setattr(connection, "is_cut", True))
    with raw(sockets.address) as stranger:
        until(lambda: connections)
        (descriptor,) = connections
        stranger.sendall(b"\0\x01!")
        assert sockets.receive(0.2) == []
        for _ in range(2):
            stranger.sendall(b"\0\x01!")
    until(lambda: not connections)  # its messages wait, unread
    is_own = True
    with raw(sockets.address) as honest:
        until(lambda: list(connections) == [descriptor])
        honest.sendall(b"\0\x06honest")
        came: list[ServerInput] = []
        until(lambda: came.extend(sockets.receive(0.05)) or [one for one in came if isinstance(one, FromConsumer)])
        came += sockets.receive(0.2)
    assert [bytes(one.frames[0]) for one in came if isinstance(one, FromConsumer)] == [b"honest"]


# --- how many there are -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [FromConsumer, FromWorker])
def test_the_oldest_connection_without_a_session_makes_room(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], kind: type
) -> None:
    """Otherwise idle connections take every descriptor that the process may open, and end it."""
    sockets = serve(most_connections=4, has_session=lambda identity: identity == b"honest")
    address = sockets.address if kind is FromConsumer else sockets.worker_address
    honest = consumer(sockets, b"honest", address)
    send_ping(honest, sockets, kind)
    idle = [raw(address) for _ in range(20)]
    until(lambda: len(guarded(sockets, kind)._connections) <= 4)
    newcomer = consumer(sockets, b"newcomer", address)
    assert send_ping(newcomer, sockets, kind).identity == b"newcomer"
    assert sockets.send(b"honest", encode(Pong()), to_worker=kind is FromWorker)
    for each in idle:
        each.close()


def test_pings_do_not_keep_a_place(serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]) -> None:
    """Peers that only send a Ping from time to time would otherwise lock out every newcomer."""
    sockets = serve(most_connections=4)
    names = [b"%d" % number for number in range(4)]
    peers = [consumer(sockets, name) for name in names]
    for peer in peers:
        send_ping(peer, sockets)
    for peer in peers:
        send_ping(peer, sockets)
    newcomer = consumer(sockets, b"newcomer")
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"0")
    assert send_ping(newcomer, sockets).identity == b"newcomer"


def test_connections_with_a_session_make_no_room(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve(most_connections=2, has_session=bool)
    for name in (b"a", b"b"):
        send_ping(consumer(sockets, name), sockets)
    with raw(sockets.address) as newcomer:
        assert is_ended(newcomer)
    assert all(sockets.send(name, encode(Pong())) for name in (b"a", b"b"))


CONNECT_MANY = f"""
import resource, socket, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (5500, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
held = []
for _ in range(int(sys.argv[2])):
    held.append(socket.create_connection(("127.0.0.1", int(sys.argv[1])), 60.0))
    held[-1].sendall({GREETING + READY!r})
print("connected", flush=True)
sys.stdin.read()
"""


def open_files() -> float:
    """Count this process's descriptors; one that has none left to look with has too many."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return math.inf


@pytest.mark.parametrize("count", [1500, pytest.param(5000, marks=pytest.mark.slow)])
def test_many_connections_with_few_descriptors_do_not_stop_a_newcomer(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], count: int
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    few = len(os.listdir("/proc/self/fd")) + 1100  # other tests may have left some open
    if hard < few + count:
        pytest.skip("the system allows fewer connections")
    resource.setrlimit(resource.RLIMIT_NOFILE, (few, hard))
    try:
        most = most_connections(8)
        sockets = serve(most_connections=most, has_session=lambda identity: identity == b"honest")
        honest = consumer(sockets, b"honest")
        send_ping(honest, sockets)
        port = sockets.address.rpartition(":")[2]
        with subprocess.Popen(
            [sys.executable, "-c", CONNECT_MANY, port, str(count)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as many:
            assert many.stdout is not None
            assert many.stdin is not None
            before = open_files()
            while not select.select([many.stdout], [], [], 0)[0]:
                sockets.receive(0.01)  # on a busy machine they may come faster than this, and find no descriptor left
            assert many.stdout.readline() == b"connected\n"
            until(lambda: (sockets.receive(0.01), open_files() <= before + most)[1])
            newcomer = consumer(sockets, b"newcomer")
            assert send_ping(newcomer, sockets).identity == b"newcomer"
            assert sockets.send(b"honest", encode(Pong()))
            many.stdin.close()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


# --- the end of one ---------------------------------------------------------------------------------------------------


def test_disconnect_ends_the_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve()
    peer = consumer(sockets, b"c")
    send_ping(peer, sockets)
    sockets.cut(b"stranger")
    sockets.cut(b"c")
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")


def test_a_connection_that_has_just_ended_is_no_error() -> None:
    """Its descriptor is closed before its event comes, and may belong to another file."""
    ours, theirs = socket.socketpair()
    ended = guard._Connection(ours.fileno(), 1, os.fstat(ours.fileno()).st_ino)
    with ours, theirs:
        others = socket.socketpair()
        with others[0], others[1]:
            os.dup2(others[0].fileno(), ended.descriptor)
            guard._cut(ended)
            others[0].sendall(b"not shut down")
    guard._cut(ended)


def test_a_message_of_too_many_frames_is_dropped_and_ends_its_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    """A thousand frames take a thousand times as long to receive as one."""
    sockets = serve()
    peer = consumer(sockets, b"c")
    send_ping(peer, sockets)
    peer.send_multipart([b""] * (MOST_MESSAGE_FRAMES + 1))
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")
    other = consumer(sockets, b"d")
    other.send_multipart([b""] * MOST_MESSAGE_FRAMES)
    arrival = next_from(sockets, FromConsumer)
    assert isinstance(arrival, FromConsumer)
    assert len(arrival.frames) == MOST_MESSAGE_FRAMES
