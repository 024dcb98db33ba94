"""Hostile peers of a router: each is disconnected, memory is bounded, and other peers are served meanwhile."""

from __future__ import annotations

import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator

import psutil
import pytest
import zmq

from tests.waiting import until
from v2v_protocol.link import guard
from v2v_protocol.messages import Ping, Pong
from v2v_protocol.wire import encode
from v2v_server.broker.actions import ToConsumer, ToWorker
from v2v_server.broker.transport import Arrival, ConsumerGone, FromConsumer, FromWorker, Sockets

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts the bytes of a connection")

ROUTER_READY = b"\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06DEALER"
GREETING = b"\xff\0\0\0\0\0\0\0\0\x7f\x03\0NULL" + bytes(16 + 1 + 31)
MIB = 1 << 20


@pytest.fixture
def serve() -> Iterator[Callable[..., Sockets]]:
    opened: list[Sockets] = []

    def start(**limits: int) -> Sockets:
        opened.append(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", **limits))
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
    """A peer that speaks ZMTP by hand, up to the end of the handshake."""
    peer = socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])))
    peer.sendall(GREETING + ROUTER_READY)
    return peer


def push(peer: socket.socket, data: bytes) -> bool:
    """Send data; return whether the other end has ended the connection, which ``sendall`` notices late."""
    left = memoryview(data)
    while left:
        readable, writable, _ = select.select([peer], [peer], [], 30.0)
        assert readable or writable, "the connection is stuck"
        try:
            if readable and not peer.recv(1 << 16):
                return True
            if writable:
                left = left[peer.send(left) :]
        except ConnectionError:
            return True
    return False


def is_cut_off(peer: socket.socket, part: bytes) -> bool:
    """Return whether the connection ends when 8 MiB of parts are sent."""
    return any(push(peer, part) for _ in range(8 * MIB // len(part)))


def next_from(sockets: Sockets, kind: type) -> Arrival:
    came: list[Arrival] = []

    def there() -> bool:
        came.extend(one for one in sockets.receive(0.05) if isinstance(one, kind))
        return bool(came)

    until(there)
    return came[0]


@pytest.mark.parametrize("part", [b"\x01\x00" * 8192, (b"\x01\xff" + bytes(255)) * 64], ids=["empty", "of 255 bytes"])
def test_parts_without_end_are_cut_off_before_they_are_collected(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], part: bytes
) -> None:
    """One peer's parts grew the server byte for byte, empty ones a hundredfold; the honest consumer notices nothing."""
    sockets = serve()
    honest = consumer(sockets, b"honest")
    before = psutil.Process().memory_info().rss
    cut: list[bool] = []
    hostile = [raw(sockets.address) for _ in range(8)]
    threads = [
        threading.Thread(target=lambda peer: cut.append(is_cut_off(peer, part)), args=(each,)) for each in hostile
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        honest.send_multipart(encode(Ping()))
        assert next_from(sockets, FromConsumer).identity == b"honest"
    for thread in threads:
        thread.join()
    for each in hostile:
        each.close()
    assert cut == [True] * 8
    assert psutil.Process().memory_info().rss - before < 300 * MIB
    assert sockets.send(ToConsumer(b"honest", encode(Pong())))
    assert honest.poll(5000)


def test_whose_connection_has_ended_is_said(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve()
    peer = consumer(sockets, b"c")
    peer.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    peer.close()
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")


def test_who_asks_for_more_than_it_takes_is_cut_off(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "_SLACK_BYTES", MIB)
    sockets = serve(most_queued_bytes=MIB)
    deaf = consumer(sockets, b"deaf")
    deaf.setsockopt(zmq.RCVHWM, 1)
    deaf.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    sample = bytes(4 * MIB)
    sent = [sockets.send(ToConsumer(b"deaf", [b"", sample])) for _ in range(30)]
    assert all(sent)
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"deaf")


@pytest.mark.parametrize(("kind", "to"), [(FromConsumer, ToConsumer), (FromWorker, ToWorker)])
def test_connections_are_bounded_and_those_that_say_nothing_make_room(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], kind: type, to: type
) -> None:
    """Idle ones took every file that the process may open, and ended it."""
    sockets = serve(most_connections=4)
    address = sockets.address if kind is FromConsumer else sockets.worker_address
    watched = (sockets._consumers if kind is FromConsumer else sockets._workers).guard
    assert watched is not None
    honest = consumer(sockets, b"honest", address)
    honest.send_multipart(encode(Ping()))
    next_from(sockets, kind)
    idle = [raw(address) for _ in range(20)]
    until(lambda: len(watched._connections) <= 4)
    newcomer = consumer(sockets, b"newcomer", address)
    newcomer.send_multipart(encode(Ping()))
    arrival = next_from(sockets, kind)
    assert isinstance(arrival, kind)
    assert arrival.identity == b"newcomer"
    assert sockets.send(to(b"honest", encode(Pong())))
    for each in idle:
        each.close()


def test_who_is_to_be_cut_off_is(serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]) -> None:
    sockets = serve()
    peer = consumer(sockets, b"c")
    peer.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    sockets.cut(b"stranger")
    sockets.cut(b"c")
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")


@pytest.fixture
def unwatched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a busy host, where the guard's thread never runs."""
    monkeypatch.setattr(guard.ConnectionGuard, "_watch", lambda _guard, _monitor: None)


@pytest.mark.usefixtures("unwatched")
def test_who_is_heard_before_the_watch_looks_is_cut_off_and_its_end_is_said(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve()
    other, hasty, left = (consumer(sockets, name) for name in (b"other", b"hasty", b"left"))
    for each in (hasty, left):
        each.send_multipart(encode(Ping()))
        next_from(sockets, FromConsumer)
    sockets.cut(b"hasty")
    left.close()
    gone: set[bytes] = set()

    def both() -> bool:
        other.send_multipart(encode(Ping()))
        gone.update(one.identity for one in sockets.receive(0.05) if isinstance(one, ConsumerGone))
        return gone == {b"hasty", b"left"}

    until(both)


@pytest.mark.usefixtures("unwatched")
def test_who_has_gone_before_it_is_heard_is_said_to_be_gone(
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


def test_a_connection_that_has_just_ended_ends_no_watch() -> None:
    """Its descriptor is closed before its event comes."""
    ours, theirs = socket.socketpair()
    file = ours.fileno()
    ours.close()
    theirs.close()
    assert guard._counted(file) is None
    assert guard._peer(file) is None
