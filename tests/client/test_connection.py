"""Test a connection alone, where the order of messages matters and timers must not help."""

from __future__ import annotations

import inspect
import itertools
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from types import FrameType

import pytest
import zmq
import zmq.sugar.context
import zmq.sugar.socket

from tests.client.fake_server import SPEC, FakeServer
from tests.waiting import until
from v2v_client import V2VStreamDataset
from v2v_client.connection import Connection, order
from v2v_client.conversation import Conversation, Event, WorkerShortage
from v2v_client.options import Patience
from v2v_protocol.errors import NoWorkers, ServerLost, StateMismatch, UsageError
from v2v_protocol.keys import addresses
from v2v_protocol.link import dealer
from v2v_protocol.messages import Frames, Hello
from v2v_protocol.sample import DEFAULT_ARRAYS

HELLO = Hello(SPEC.to_dict(), DEFAULT_ARRAYS, 4, 5)
NEVER_BY_THE_CLOCK = Patience(timeout_seconds=60.0, ping_seconds=1000.0, rewant_seconds=1000.0)


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer(sequences=23, credit=4) as running:
        yield running


def test_requests_denied_for_credit_are_repeated_when_a_sample_comes_twice(server: FakeServer) -> None:
    """Sample 0 is requested again while it is on its way, so it is made twice, and the server still counts it."""
    with closing(Connection(server.address, HELLO, 0, patience=NEVER_BY_THE_CLOCK)) as connection:
        connection.open()
        server.held = True
        connection.want(range(4))
        until(lambda: len(server.wants) == 4)
        server.call(lambda: server.answer(0, 0))
        connection.conversation.handle_event(Event.DISCONNECTED, connection._now())
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
    with closing(Connection(server.address, HELLO, 0, patience=NEVER_BY_THE_CLOCK)) as connection:
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
    with closing(Connection(server.address, HELLO, 0, clock=lambda: time.monotonic() + sum(stopped))) as connection:
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

    def clock() -> float:
        return time.monotonic() + sum(waited)

    with closing(Connection(server.address, HELLO, 0, patience=NEVER_BY_THE_CLOCK, clock=clock)) as connection:
        listen = dealer.Dealer.receive

        def receive(self: dealer.Dealer, seconds: float) -> Frames | None:
            if len(waited) < 20:
                waited.append(0.9)
                return None
            return listen(self, seconds)

        monkeypatch.setattr(dealer.Dealer, "receive", receive)
        connection.open()
        assert connection.receive(wait=False) is None
        assert connection.conversation.silence(connection._now()) >= 0.0


@pytest.mark.parametrize(("host", "kinds"), [("localhost", [0, 1, 0]), ("127.0.0.1", [0, 1, 0]), ("[::1]", [1] * 3)])
def test_a_host_name_is_tried_as_ipv4_then_ipv6_in_turn(host: str, kinds: list[int], unused_port: int) -> None:
    """On most hosts "localhost" has an IPv4 and an IPv6 address, and a server listens on 127.0.0.1."""
    found = []
    with closing(dealer.Dealer(f"tcp://{host}:{unused_port}")) as tried:
        for _ in kinds:
            tried.connect(1 << 20, again=bool(found))
            assert tried._socket is not None
            found.append(tried._socket.getsockopt(zmq.IPV6))
    assert found == kinds


def test_a_reconnection_keeps_the_ip_version_that_worked(server: FakeServer) -> None:
    with closing(Connection(server.address, HELLO, 0)) as connection:
        connection.open()
        made_anew = connection._open_link()
        assert isinstance(made_anew, dealer.Dealer)
        made_anew.connect(1 << 20, again=True)
        assert made_anew._socket is not None
        assert made_anew._socket.getsockopt(zmq.IPV6) == 0


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

        connection = Connection(server.address, HELLO, 0)
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


QUICK = Patience(ping_seconds=0.05, takeover_seconds=0.3)
PATIENT = Patience(ping_seconds=0.05, takeover_seconds=60.0)


@pytest.fixture
def servers() -> Iterator[tuple[FakeServer, FakeServer]]:
    with FakeServer(sequences=24, credit=4) as one, FakeServer(sequences=24, credit=6) as other:
        yield one, other


def dataset(brokers: object, **options: object) -> V2VStreamDataset:
    options = {"rank": 0, "world_size": 1, "patience": PATIENT} | options
    return V2VStreamDataset(brokers, 4, DEFAULT_ARRAYS, seed=5, **options)  # type: ignore[arg-type]


@pytest.fixture
def only_mute_is_silent(servers: tuple[FakeServer, FakeServer], monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a broker silent because it is mute, never because this host is busy."""

    def silence(self: Conversation, now: float) -> float:
        return math.inf if any(server.mute and server.address == self._address for server in servers) else 0.0

    monkeypatch.setattr(Conversation, "silence", silence)


# --- the rule ---------------------------------------------------------------------------------------------------------


def test_neighbouring_consumers_share_a_broker_and_hosts_use_their_own() -> None:
    homes = [order("abcd", rank, 32)[0] for rank in range(32)]
    assert homes == [name for name in "abcd" for _ in range(8)]


@pytest.mark.parametrize("brokers", range(1, 9))
@pytest.mark.parametrize("consumers", [1, 2, 3, 7, 8, 24])
def test_consumers_are_spread_evenly_even_after_a_broker_is_lost(brokers: int, consumers: int) -> None:
    names = "abcdefgh"[:brokers]
    orders = [order(names, consumer, consumers) for consumer in range(consumers)]
    assert all(sorted(each) == list(names) for each in orders)  # every broker comes once
    loads = Counter(each[0] for each in orders)
    assert max(loads.values()) - min(loads[name] for name in names) <= 1
    for lost in names if brokers > 1 else "":
        stand_ins = Counter(each[1] for each in orders if each[0] == lost)
        assert max(stand_ins.values(), default=0) <= -(-loads[lost] // (brokers - 1))


@pytest.mark.parametrize("given", ["tcp://a:1, tcp://b:2", ["tcp://a:1", "tcp://b:2"]])
def test_addresses_are_a_list_or_comma_separated(given: object) -> None:
    assert addresses(given) == ("tcp://a:1", "tcp://b:2")  # type: ignore[arg-type]


@pytest.mark.parametrize("given", ["", [], "tcp://a:1,", ["tcp://a:1", "tcp://a:1"]])
def test_no_address_or_a_repeated_one_is_refused(given: object) -> None:
    with pytest.raises(UsageError, match="address"):
        addresses(given)  # type: ignore[arg-type]


# --- what it is for ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("only_mute_is_silent")
@pytest.mark.parametrize("is_killed", [False, True])
def test_after_a_broker_falls_silent_every_sample_still_comes_once(
    servers: tuple[FakeServer, FakeServer], is_killed: bool
) -> None:
    one, other = servers
    stream = dataset([one.address, other.address])
    whole = [batch.indices for batch in dataset(other.address)]
    asked_before = len(other.wants)
    indices, silenced = [], False
    for batch in stream:
        indices.append(batch.indices)
        if not silenced:
            assert len(other.wants) == asked_before, "only compared until then"
            if is_killed:
                one.restart(mute=True)
            else:
                one.call(lambda: setattr(one, "mute", True))
            silenced = True
    assert indices == whole
    assert len(other.wants) > asked_before


def test_a_broker_that_never_answers_is_skipped(servers: tuple[FakeServer, FakeServer], unused_port: int) -> None:
    assert len(list(dataset([f"tcp://127.0.0.1:{unused_port}", servers[0].address], patience=QUICK))) == 6


def test_brokers_of_different_videos_are_refused_with_both_named(servers: tuple[FakeServer, FakeServer]) -> None:
    one, other = servers
    other.catalogue = "catalogue-2"
    for rank in (0, 1):
        with pytest.raises(StateMismatch, match="catalogue") as refused:
            next(iter(dataset([one.address, other.address], rank=rank, world_size=2)))
        assert one.address in str(refused.value)
        assert other.address in str(refused.value)


@pytest.mark.usefixtures("only_mute_is_silent")
def test_a_broker_that_takes_over_with_other_videos_is_refused(
    servers: tuple[FakeServer, FakeServer],
) -> None:
    """The broker may have been restarted on another folder since the comparison."""
    one, other = servers
    batches = iter(dataset([one.address, other.address]))
    next(batches)
    other.call(lambda: setattr(other, "catalogue", "catalogue-2"))
    one.call(lambda: setattr(one, "mute", True))
    with pytest.raises(StateMismatch, match="catalogue") as refused:
        list(batches)
    assert one.address in str(refused.value)
    assert other.address in str(refused.value)


def test_the_server_is_lost_once_each_broker_had_its_turn(unused_port: int) -> None:
    brokers = [f"tcp://127.0.0.1:{unused_port}", f"tcp://localhost:{unused_port}"]
    with pytest.raises(ServerLost, match=r"^tcp.*no sample for") as lost:
        next(iter(dataset(brokers, patience=QUICK, timeout_seconds=0.5)))
    assert ", ".join(brokers) in str(lost.value)


def test_a_broker_without_workers_is_not_left(servers: tuple[FakeServer, FakeServer]) -> None:
    """The brokers share their workers, so the others have none either."""
    one, other = servers
    one.held, one.trouble = True, "no worker is connected"
    with closing(Connection([one.address, other.address], HELLO, 0, patience=PATIENT)) as connection:
        connection.open()
        connection.conversation._shortage = WorkerShortage(connection._now(), 0.0)  # no patience with one
        connection.want([0])
        with pytest.raises(NoWorkers, match="no worker is connected"):
            _next(connection)
    assert other.wants == []
