"""A session belongs to its secret and its key: no other peer can end it, move it or receive its samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import closing

import pytest
import zmq

from tests.server.broker.test_dispatcher import refused
from tests.server.peers import Peers, peers
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.link.router import FromConsumer, FromWorker, Sockets
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    Goodbye,
    Hello,
    Message,
    Ping,
    Want,
    Welcome,
    WorkerHello,
    decode,
    encode,
)
from v2v_server.broker.state import ToConsumer, ToWorker

OURS, THEIRS = b"o" * 32, b"t" * 32


def hello(secret: bytes, seed: int = 0) -> Hello:
    return Hello({}, ("voxels",), 4, seed, secret=secret)


def say(at: Peers, identity: bytes, message: Message, user: str) -> list[Message]:
    """Send a message over a connection with a key."""
    actions = at.dispatcher.from_consumer(identity, encode(message), at.now, user)
    return [decode(action.frames[0]) for action in actions if isinstance(action, ToConsumer)]


def test_a_hello_that_is_refused_changes_nothing() -> None:
    at = peers()
    at.consumer_says(b"c", hello(OURS))
    at.want(0, 1)
    text = refused(at.consumer_says(b"c", hello(THEIRS, seed=9)), ErrorCode.MALFORMED)
    assert text == "this routing id belongs to the session of another consumer: connect with a random one"
    refused(at.consumer_says(b"c", hello(b"", seed=9)), ErrorCode.MALFORMED)
    refused(at.consumer_says(b"c", Hello({"colour": 1}, ("voxels",), 4, 0, secret=OURS)), ErrorCode.SPEC)
    at.join()
    at.work_off()
    assert at.samples() == [(0, 0), (0, 1)]


def test_the_secret_moves_a_session_to_a_new_connection_with_its_debt() -> None:
    at = peers()
    at.consumer_says(b"before", hello(OURS))
    at.broker.sessions.queue.charge(b"before", 3.0)
    (welcome,) = at.consumer_says(b"after", hello(OURS))
    assert isinstance(welcome, Welcome)
    (session,) = at.broker.sessions
    assert (session.identity, at.broker.sessions.queue.balance_ns(b"after")) == (b"after", -3_000_000_000)


def test_another_key_cannot_act_for_a_session_even_with_its_secret() -> None:
    at = peers()
    say(at, b"c", hello(OURS), "gpu-1")
    assert say(at, b"c", Goodbye(0.0), "gpu-2") == []
    (answer,) = say(at, b"c", Want(0, (0,)), "gpu-2")
    assert isinstance(answer, Denied)
    assert answer.code == ErrorCode.UNKNOWN_SESSION
    refused(say(at, b"c", hello(OURS), "gpu-2"), ErrorCode.MALFORMED)
    say(at, b"d", hello(OURS), "gpu-2")
    assert {(session.identity, session.user) for session in at.broker.sessions} == {
        (b"c", "gpu-1"),
        (b"d", "gpu-2"),
    }


def test_a_secret_that_is_too_long_is_refused() -> None:
    at = peers()
    assert "65 bytes; the limit is 64" in refused(at.consumer_says(b"c", hello(b"x" * 65)), ErrorCode.MALFORMED)
    assert "65 bytes; the limit is 64" in enter(at, b"w", "worker", b"x" * 65)


def enter(at: Peers, identity: bytes, name: str, secret: bytes, user: str = "") -> str:
    """Say hello as a worker; return the text of the denial, empty if there is none."""
    at.leases[identity] = deque()
    hello = WorkerHello(name, NUMERICS_VERSION, 2, secret=secret)
    at.carry_out(at.dispatcher.from_worker(identity, encode(hello), at.now, user))
    last = at.told.pop(identity, [Ping()])[-1]
    return last.text if isinstance(last, Denied) else ""


@pytest.mark.parametrize(
    ("identity", "secret", "user"),
    [(b"2", THEIRS, "gpu-1"), (b"2", b"", "gpu-1"), (b"2", OURS, "gpu-2"), (b"1", THEIRS, "gpu-1")],
)
def test_a_worker_that_knows_the_name_of_another_gets_none_of_its_work(
    identity: bytes, secret: bytes, user: str
) -> None:
    at = peers()
    assert enter(at, b"1", "worker", OURS, "gpu-1") == ""
    at.consumer_says(b"c", hello(OURS))
    at.want(0, 1)
    held = list(at.leases[b"1"])
    assert "'worker' is connected; both must be unique" in enter(at, identity, "worker", secret, user)
    at.leases[b"1"] = deque(held)
    at.work_off(b"1")
    assert at.samples() == [(0, 0), (0, 1)]
    assert at.broker.counters.returned_leases == 0


def test_the_secret_of_a_worker_moves_its_name_and_returns_its_leases() -> None:
    at = peers()
    enter(at, b"1", "worker", OURS)
    at.consumer_says(b"c", hello(OURS))
    at.want(0, 1)
    assert enter(at, b"2", "worker", OURS) == ""
    assert list(at.broker.registry.members) == [b"2"]
    assert at.broker.registry.named("worker") == b"2"
    assert len(at.leases[b"2"]) == 2
    at.work_off(b"2")
    assert at.samples() == [(0, 0), (0, 1)]


def test_no_key_holds_the_name_of_a_worker_of_this_host() -> None:
    at = peers()
    assert enter(at, b"1", "w1-0.1", THEIRS, "gpu-1") == ""
    assert enter(at, b"2", "w1-0.1", OURS) == ""
    assert list(at.broker.registry.members) == [b"2"]
    assert enter(at, b"1", "w1-0.1", THEIRS, "gpu-1") != ""


def test_a_name_that_is_too_long_is_refused() -> None:
    assert "256 bytes; the limit is 255" in enter(peers(), b"w", "x" * 256, OURS)


def test_a_peer_at_the_wrong_port_is_told() -> None:
    at = peers()
    at.leases[b"c"] = deque()
    (answer,) = at.dispatcher.from_worker(b"c", encode(hello(OURS)), at.now)
    assert isinstance(answer, ToWorker)
    denied = decode(answer.frames[0])
    assert isinstance(denied, Denied)
    assert "this is the workers' port: connect to the address of --bind" in denied.text
    (reply,) = at.consumer_says(b"w", WorkerHello("w", NUMERICS_VERSION, 1))
    assert isinstance(reply, Denied)
    assert "this is the consumers' port: connect to the address of --worker-bind" in reply.text


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with closing(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")) as made:
        yield made


@pytest.mark.parametrize("side", ["consumer", "worker"])
def test_a_second_connection_with_a_routing_id_in_use_gets_nothing(sockets: Sockets, side: str) -> None:
    kind = FromConsumer if side == "consumer" else FromWorker
    address = sockets.address if side == "consumer" else sockets.worker_address

    def dealer(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.ROUTING_ID, b"\x01honest")
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVTIMEO, 60_000)
        return socket

    def arrived() -> list[Message]:
        """Return what has come under the honest routing id, once something has."""
        while True:
            came = [each for each in sockets.receive(1.0) if isinstance(each, kind)]
            if honestly := [decode(each.frames[0]) for each in came if each.identity == b"\x01honest"]:
                return honestly

    with zmq.Context() as context, dealer(context) as honest:
        honest.connect(address)
        honest.send_multipart(encode(Ping()))
        assert arrived() == [Ping()]
        with dealer(context) as thief, thief.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED) as shaken_hands:
            thief.connect(address)
            assert shaken_hands.poll(60_000)
            for _ in range(3):
                thief.send_multipart(encode(Goodbye(0.0)))
            assert sockets.send(b"\x01honest", [b"sample"], to_worker=side == "worker")
            assert honest.recv() == b"sample"
            honest.send_multipart(encode(Ping()))
            assert arrived() == [Ping()]
            assert thief.poll(0) == 0
            thief.disable_monitor()
