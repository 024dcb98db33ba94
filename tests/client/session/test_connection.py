"""Test a connection alone, where the order of messages matters and timers must not help."""

from __future__ import annotations

import inspect
import itertools
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from types import FrameType

import pytest
import zmq
import zmq.sugar.context
import zmq.sugar.socket

from tests.client.fake_server import SPEC, FakeServer
from tests.waiting import until
from v2v_client.session.connection import Connection
from v2v_client.session.liveness import Patience
from v2v_client.session.states import Event
from v2v_protocol.link import dealer
from v2v_protocol.messages import Frames, Hello
from v2v_protocol.sample import DEFAULT_ARRAYS

NEVER_BY_THE_CLOCK = Patience(timeout_seconds=60.0, ping_seconds=1000.0, rewant_seconds=1000.0)


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer(sequences=23, credit=4) as running:
        yield running


def test_requests_denied_for_credit_are_repeated_when_a_sample_comes_twice(server: FakeServer) -> None:
    """Sample 0 is requested again while it is on its way, so it is made twice, and the server still counts it."""
    hello = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)
    with closing(Connection(server.address, hello, 0, patience=NEVER_BY_THE_CLOCK)) as connection:
        connection.open()
        server.held = True
        connection.want(range(4))
        until(lambda: len(server.wants) == 4)
        server.call(lambda: server.answer(0, 0))
        connection._conversation.handle_event(Event.DISCONNECTED, connection._now())
        connection.want(())  # and all four are asked for again
        until(lambda: len(server.wants) == 8)
        assert _next(connection) == 0
        connection.want([4])
        until(lambda: server.refused_for_credit)
        server.call(lambda: (server.answer(0, 0), setattr(server, "held", False)))
        assert _next(connection) == 0
        seen = set()
        while seen != {1, 2, 3, 4}:  # or the server is given up
            seen.add(_next(connection))
    assert server.refused_for_credit == 1


def test_a_reopened_session_keeps_the_newest_quarantine_snapshot_received(server: FakeServer) -> None:
    """This includes samples whose provenance was not decoded yet."""
    hello = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)
    with closing(Connection(server.address, hello, 0, patience=NEVER_BY_THE_CLOCK)) as connection:
        connection.open()
        for index, snapshot in enumerate((7, 3)):
            server.call(lambda snapshot=snapshot: setattr(server, "snapshot", snapshot))
            connection.want([index])
            assert _next(connection) == index
        greeted = len(server.hellos)
        server.forget()
        connection.want([2])
        assert _next(connection) == 2
        assert [again.quarantine for again in server.hellos[greeted:]] == [7]


def test_time_in_which_the_trainer_was_stopped_is_not_silence(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trainer may be stopped for hours together with its server; that time is not the server's silence."""
    stopped = [0.0]
    hello = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)
    with closing(Connection(server.address, hello, 0, clock=lambda: time.monotonic() + sum(stopped))) as connection:
        connection.open()
        listen = dealer.Dealer.receive

        def receive(self: dealer.Dealer, seconds: float) -> Frames | None:
            if len(stopped) < 3:
                stopped.append(3600.0)
                return None
            return listen(self, seconds)

        monkeypatch.setattr(dealer.Dealer, "receive", receive)
        connection.want([0])
        assert _next(connection) == 0


def test_time_spent_opening_counts_as_listening(server: FakeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a server needs most of the deadline to start, and is then killed, it counts as lost after one deadline."""
    waited: list[float] = []
    hello = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)

    def clock() -> float:
        return time.monotonic() + sum(waited)

    with closing(Connection(server.address, hello, 0, patience=NEVER_BY_THE_CLOCK, clock=clock)) as connection:
        listen = dealer.Dealer.receive

        def receive(self: dealer.Dealer, seconds: float) -> Frames | None:
            if len(waited) < 20:
                waited.append(0.9)
                return None
            return listen(self, seconds)

        monkeypatch.setattr(dealer.Dealer, "receive", receive)
        connection.open()
        assert connection.receive(wait=False) is None
        assert connection._conversation.silence(connection._now()) >= 0.0


@pytest.mark.parametrize(
    ("address", "kinds"),
    [("tcp://localhost:1", [0, 1, 0]), ("tcp://127.0.0.1:1", [0, 1, 0]), ("tcp://[::1]:1", [1] * 3)],
)
def test_a_host_name_is_tried_as_ipv4_then_ipv6_in_turn(address: str, kinds: list[int]) -> None:
    """On most hosts "localhost" has an IPv4 and an IPv6 address, and a server listens on 127.0.0.1."""
    found = []
    with closing(dealer.Dealer(address)) as tried:
        for _ in kinds:
            tried.connect(1 << 20, again=bool(found))
            assert tried._socket is not None
            found.append(tried._socket.getsockopt(zmq.IPV6))
    assert found == kinds


def test_a_reconnection_keeps_the_ip_version_that_worked(server: FakeServer) -> None:
    with closing(Connection(server.address, Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5), 0)) as connection:
        connection.open()
        made_anew = connection._open_link()
        assert isinstance(made_anew, dealer.Dealer)
        made_anew.connect(1 << 20, again=True)
        assert made_anew._socket is not None
        assert made_anew._socket.getsockopt(zmq.IPV6) == 0


@pytest.mark.timeout(20)
@pytest.mark.parametrize("which", [1, 2])
def test_a_signal_while_closing_raises_instead_of_hanging(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch, which: int
) -> None:
    """ZeroMQ's context waits indefinitely for a socket that was not closed."""
    connection = Connection(server.address, Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5), 0)
    connection.open()
    closing_socket, calls = zmq.Socket.close, iter(range(1, 100))

    def interrupted(self: zmq.Socket[bytes], linger: int | None = None) -> None:
        if next(calls) == which:
            raise KeyboardInterrupt
        closing_socket(self, linger)

    monkeypatch.setattr(zmq.Socket, "close", interrupted)
    with pytest.raises(KeyboardInterrupt):
        connection.close()


@pytest.mark.timeout(60)
@pytest.mark.filterwarnings("ignore:Unclosed (socket|context):ResourceWarning")  # the collector closes some of them
def test_a_signal_at_any_line_of_opening_and_closing_raises_instead_of_hanging(server: FakeServer) -> None:
    """ZeroMQ's context waits indefinitely for a socket that was not closed, even one that is being created or closed.

    The exception's traceback keeps it alive, as that of an interrupted program does.
    """
    sugar = {inspect.getfile(module) for module in (dealer, zmq.sugar.context, zmq.sugar.socket)}

    def interrupted_at(line: int) -> bool:
        """Return whether enough lines ran to reach the one to interrupt."""
        passed = 0

        def trace(frame: FrameType, event: str, argument: object) -> object:
            nonlocal passed
            if frame.f_code.co_filename not in sugar or frame.f_code.co_name == "__del__":
                return None
            passed += event == "line"
            if passed == line:
                sys.settrace(None)
                raise KeyboardInterrupt
            return trace

        connection = Connection(server.address, Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5), 0)
        before = sys.gettrace()
        sys.settrace(trace)
        try:
            connection.open()
            connection.close()
        except KeyboardInterrupt:
            sys.settrace(None)
            connection.close()
            return True
        finally:
            sys.settrace(before)
        return False

    lines = itertools.count(1)
    while interrupted_at(line := next(lines)):
        pass
    assert line > 100


def _next(connection: Connection) -> int:
    arrival = connection.receive()
    assert arrival is not None
    return arrival.header.index
