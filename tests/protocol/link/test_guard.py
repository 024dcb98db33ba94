"""Hostile peers of a router: each is disconnected, memory is bounded, and other peers are served meanwhile."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
import zmq

from tests.waiting import until
from v2v_protocol.link import guard
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.link.router import MOST_FRAMES
from v2v_protocol.messages import Ping, Pong
from v2v_protocol.wire import encode
from v2v_server.broker.actions import ToConsumer, ToWorker
from v2v_server.broker.transport import Arrival, ConsumerGone, FromConsumer, FromWorker, Sockets
from v2v_server.keys.folder import KeyFolder

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts the bytes of a connection")

READY = b"\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06DEALER"
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
    """Return a peer that speaks ZMTP by hand, after the handshake."""
    peer = socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2])), 30.0)
    peer.sendall(GREETING + READY)
    answer = b""
    while b"READY" not in answer and (piece := peer.recv(4096)):
        answer += piece
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
    """Return whether the connection ends, while 8 MiB of parts are sent or once they are read."""
    return any(push(peer, part) for _ in range(8 * MIB // len(part))) or is_ended(peer)


def is_ended(peer: socket.socket) -> bool:
    """Return whether the other end ends the connection within 5 s, before it is idle or slow."""
    peer.settimeout(5.0)
    try:
        while peer.recv(1 << 16):
            pass
    except ConnectionError:
        pass
    except TimeoutError:
        return False
    return True


def next_from(sockets: Sockets, kind: type) -> Arrival:
    came: list[Arrival] = []

    def there() -> bool:
        came.extend(one for one in sockets.receive(0.05) if isinstance(one, kind))
        return bool(came)

    until(there)
    return came[0]


@pytest.mark.parametrize("part", [b"\x01\x00" * 8192, (b"\x01\xff" + bytes(255)) * 64], ids=["empty", "of 255 bytes"])
def test_a_message_without_end_ends_its_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], part: bytes
) -> None:
    """Memory stays bounded, and the honest consumer is served meanwhile."""
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
    assert honest.poll(60_000)


def test_the_end_of_a_connection_is_reported(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve()
    peer = consumer(sockets, b"c")
    peer.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    peer.close()
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")


def test_a_peer_that_requests_more_than_it_reads_is_disconnected(
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
def test_connections_are_bounded_and_silent_ones_make_room(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], kind: type, to: type
) -> None:
    """Otherwise idle connections take every descriptor that the process may open, and end it."""
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


def test_an_idle_connection_makes_room_although_it_once_sent_a_message(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Peers that sent one Ping and nothing since would otherwise lock out every newcomer."""
    monkeypatch.setattr(guard, "IDLE_SECONDS", 0.5)
    sockets = serve(most_connections=4)
    peers = [consumer(sockets, b"%d" % number) for number in range(4)]
    for peer in peers:
        peer.send_multipart(encode(Ping()))
    heard: set[bytes] = set()

    def said(*names: bytes) -> Callable[[], bool]:
        def is_said() -> bool:
            heard.update(each.identity for each in sockets.receive(0.05) if isinstance(each, FromConsumer))
            return heard >= set(names)

        return is_said

    until(said(b"0", b"1", b"2", b"3"))
    watched = sockets._consumers.guard
    assert watched is not None
    until(
        lambda: (
            not sockets.receive(0.05) and watched._now - watched._connections[watched._descriptors[b"0"]].heard_at > 0.5
        )
    )
    heard.clear()
    peers[0].send_multipart(encode(Ping()))  # the others are idle
    until(said(b"0"))
    newcomer = consumer(sockets, b"newcomer")
    newcomer.send_multipart(encode(Ping()))
    until(said(b"newcomer"))
    assert sockets.send(ToConsumer(b"0", encode(Pong())))
    until(lambda: len(watched._connections) == 4)


def test_active_connections_do_not_make_room(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    sockets = serve(most_connections=2)
    for name in (b"a", b"b"):
        consumer(sockets, name).send_multipart(encode(Ping()))
        next_from(sockets, FromConsumer)
    with raw(sockets.address) as newcomer:
        while newcomer.recv(4096):
            pass
    assert all(sockets.send(ToConsumer(name, encode(Pong()))) for name in (b"a", b"b"))


@pytest.mark.parametrize("part", [b"\x01\x00", b"\x01\x22" + bytes(34)], ids=["empty", "of 34 bytes"])
def test_unfinished_messages_are_bounded_over_all_connections(
    serve: Callable[..., Sockets],
    consumer: Callable[..., zmq.Socket[bytes]],
    monkeypatch: pytest.MonkeyPatch,
    part: bytes,
) -> None:
    """Each connection stays below its own limit; those with the most bytes end first, and small requests are safe."""
    monkeypatch.setattr(guard, "_MOST_UNFINISHED_IN_ALL_BYTES", MIB)
    sockets = serve()
    honest = consumer(sockets, b"honest")
    honest.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    watched = sockets._consumers.guard
    assert watched is not None
    hostile = [raw(sockets.address) for _ in range(20)]
    for peer in hostile:
        push(peer, part * (100_000 // len(part)))
    until(lambda: len(watched._connections) <= 11)
    assert sum(watched._unfinished.values()) <= MIB
    assert sockets.send(ToConsumer(b"honest", encode(Pong())))
    assert honest.poll(60_000)
    for each in hostile:
        each.close()


def test_small_segments_do_not_keep_whole_buffers(serve: Callable[..., Sockets]) -> None:
    """ZeroMQ reads into 8 KiB at a time; without copying, each small part that arrives alone keeps all of them."""
    sockets = serve()
    before = psutil.Process().memory_info().rss
    watched = sockets._consumers.guard
    assert watched is not None
    part = b"\x01\x22" + bytes(34)
    with raw(sockets.address) as peer:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        until(lambda: watched._connections)
        (descriptor,) = watched._connections
        counted = guard._counted(descriptor)
        assert counted is not None
        consumed = counted[0]
        for _ in range(6000):
            peer.send(part)
            consumed += len(part)
            while (counted := guard._counted(descriptor)) is not None and counted[0] < consumed:
                os.sched_yield()
            assert counted is not None
        assert psutil.Process().memory_info().rss - before < 16 * MIB


def test_a_message_that_does_not_end_in_time_ends_its_connection(
    serve: Callable[..., Sockets], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "_MOST_SLOW_SECONDS", 0.2)
    sockets = serve()
    with raw(sockets.address) as peer, raw(sockets.address) as small:
        assert not push(small, b"\x01\x00" * 1000)  # less than the smallest that counts
        assert not push(peer, b"\x01\x00" * 4000)
        watched = sockets._consumers.guard
        assert watched is not None
        until(lambda: not sockets.receive(0.05) and len(watched._connections) == 1)
        while peer.recv(4096):
            pass


def test_messages_that_wait_for_the_loop_end_no_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop may be held up for longer than a message may take, for instance by storage that does not answer."""
    monkeypatch.setattr(guard, "_MOST_SLOW_SECONDS", 0.2)
    monkeypatch.setattr(guard, "IDLE_SECONDS", 0.3)  # of a peer that sends its first message
    monkeypatch.setattr(guard, "_LONGEST_TURN_SECONDS", 0.1)
    sockets = serve()
    watched = sockets._consumers.guard
    assert watched is not None
    peer = consumer(sockets, b"c")
    peer.send_multipart([bytes(20_000)])
    until(lambda: sum(watched._unfinished.values()) > 19_000)
    began = watched._checked_at
    until(lambda: watched._checked_at - began > 0.6)
    next_from(sockets, FromConsumer)
    assert sockets.send(ToConsumer(b"c", encode(Pong())))
    assert peer.poll(60_000)


def test_a_worker_may_send_a_large_sample_slowly(
    serve: Callable[..., Sockets], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample of 4 MB takes half a minute at 1 Mbit/s."""
    monkeypatch.setattr(guard, "_MOST_SLOW_SECONDS", 0.1)
    sockets = serve()
    watched = sockets._workers.guard
    assert watched is not None
    with raw(sockets.worker_address) as worker:
        assert not push(worker, b"\x02" + (MIB).to_bytes(8, "big") + bytes(MIB - 1))
        began = watched._now
        until(lambda: not sockets.receive(0.05) and watched._now - began > 0.5)
        assert not push(worker, b"\x00")
        arrival = next_from(sockets, FromWorker)
        assert isinstance(arrival, FromWorker)
        assert len(arrival.frames[0]) == MIB


@pytest.mark.parametrize("keyed", [False, True])
def test_no_byte_of_a_whole_message_counts_as_unfinished(tmp_path: Path, keyed: bool) -> None:
    """The guard knows the size of our handshake, and of each frame on the wire."""
    keys = KeyFolder(tmp_path / "keys") if keyed else None
    if keys is not None:
        keys.init()
        keys.new("gpu", "consumer", tmp_path / "gpu.key")
    sockets = Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", keys=keys)
    watched = sockets._consumers.guard
    assert watched is not None
    peer = Dealer(sockets.address, str(tmp_path / "gpu.key") if keyed else "")
    try:
        peer.connect()
        for size in (1, 100, 222, 223, 255, 256, 5000, 65_000):
            peer.send([bytes(size)])
            next_from(sockets, FromConsumer)
            until(lambda: watched._unfinished and not watched._to_check)
            assert [*watched._unfinished.values()] == [0]
    finally:
        peer.close()
        sockets.close()


def test_idle_connections_are_not_measured(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measuring all of 2,000 idle connections took most of the loop's time."""
    measured: list[int] = []
    counted = guard._counted
    monkeypatch.setattr(guard, "_counted", lambda descriptor: measured.append(descriptor) or counted(descriptor))
    sockets = serve()
    watched = sockets._consumers.guard
    assert watched is not None
    idle, active = consumer(sockets, b"idle"), consumer(sockets, b"active")
    for peer in (idle, active):
        peer.send_multipart(encode(Ping()))
        next_from(sockets, FromConsumer)
    until(lambda: not watched._to_check)
    del measured[:]
    for _ in range(3):
        active.send_multipart(encode(Ping()))
        next_from(sockets, FromConsumer)
        until(lambda: not watched._to_check)
    assert set(measured) == {watched._descriptors[b"active"]}


def test_disconnect_ends_the_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
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
def test_a_peer_is_disconnected_before_the_guard_runs_and_its_end_is_reported(
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


@pytest.mark.parametrize("is_known", [True, False])
def test_a_late_message_does_not_end_the_next_connection_with_its_descriptor(
    monkeypatch: pytest.MonkeyPatch,
    serve: Callable[..., Sockets],
    consumer: Callable[..., zmq.Socket[bytes]],
    is_known: bool,
) -> None:
    monkeypatch.setattr(guard, "_LATE_SECONDS", 1e9)
    sockets = serve()
    connections = sockets._consumers.guard._connections  # type: ignore[union-attr]
    early = consumer(sockets, b"early")
    if is_known:
        early.send_multipart(encode(Ping()))
        assert next_from(sockets, FromConsumer).identity == b"early"  # type: ignore[union-attr]
    until(lambda: connections)
    descriptors = list(connections)
    for _ in range(2):
        early.send_multipart(encode(Ping()))
    early.close(linger=-1)
    until(lambda: not connections)
    honest = consumer(sockets, b"honest")
    until(lambda: list(connections) == descriptors)
    honest.send_multipart(encode(Ping()))
    came: list[Arrival] = []

    def is_served() -> bool:
        for one in sockets.receive(0.05):
            came.append(one)
            if isinstance(one, FromConsumer):
                if one.identity == b"early":
                    sockets.cut(one.identity)
                else:
                    sockets.send(ToConsumer(one.identity, encode(Pong())))
        return bool(honest.poll(0))

    until(is_served)
    assert b"early" in [one.identity for one in came if isinstance(one, FromConsumer)]
    assert not is_known or ConsumerGone(b"honest") not in came


def test_a_connection_that_has_just_ended_is_no_error() -> None:
    """Its descriptor is closed before its event comes."""
    ours, theirs = socket.socketpair()
    file = ours.fileno()
    ours.close()
    theirs.close()
    assert guard._counted(file) is None
    assert guard._peer(file) is None


def test_a_message_of_too_many_frames_is_dropped_and_ends_its_connection(
    serve: Callable[..., Sockets], consumer: Callable[..., zmq.Socket[bytes]]
) -> None:
    """A thousand frames take a thousand times as long to receive as one."""
    sockets = serve()
    peer = consumer(sockets, b"c")
    peer.send_multipart(encode(Ping()))
    next_from(sockets, FromConsumer)
    peer.send_multipart([b""] * (MOST_FRAMES + 1))
    assert next_from(sockets, ConsumerGone) == ConsumerGone(b"c")
    other = consumer(sockets, b"d")
    other.send_multipart([b""] * MOST_FRAMES)
    arrival = next_from(sockets, FromConsumer)
    assert isinstance(arrival, FromConsumer)
    assert len(arrival.frames) == MOST_FRAMES
