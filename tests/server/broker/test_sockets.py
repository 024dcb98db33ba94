"""The broker carries instructions out in their order, and reports back what it alone can know."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.waiting import until
from v2v_protocol.messages import Pong, Stop
from v2v_protocol.wire import encode
from v2v_server.broker import sockets as broker_module
from v2v_server.broker.actions import GiveUp, Instruction, LookFor, Record, ToConsumer, ToWorker
from v2v_server.broker.blame import Cause, Loss
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.leases import Request
from v2v_server.broker.quarantine import Verdict
from v2v_server.broker.sockets import Broker

VERDICT = Verdict(0, "v.mp4", "f", 0, "crash", "t")
RECORD = Record(VERDICT, Request(b"c", 0, 0))
HUNG = Loss(Cause.HUNG, "slept")


class Scripted:
    """A dispatcher whose first tick says what the test says, and which writes down what it is told."""

    def __init__(self, first: Sequence[Instruction], after_record: Sequence[Instruction] = ()) -> None:
        self.first: list[Instruction] = list(first)
        self.after_record = after_record
        self.told: list[tuple[Any, ...]] = []

    def tick(self, now: float) -> list[Instruction]:
        said, self.first = self.first, []
        return said

    def recorded(self, record: Record, written: list[Verdict], now: float) -> list[Instruction]:
        self.told.append(("recorded", record, written))
        return list(self.after_record)

    def looked_for(self, missing: LookFor, found: bool, now: float) -> list[Instruction]:
        self.told.append(("looked for", missing, found))
        return []

    def worker_lost(self, identity: bytes, loss: Loss, now: float) -> list[Instruction]:
        self.told.append(("lost", identity, loss))
        return []

    def worker_unreachable(self, identity: bytes, now: float) -> list[Instruction]:
        self.told.append(("unreachable", identity))
        return []

    def consumer_lost(self, identity: bytes) -> None:
        self.told.append(("consumer lost", identity))


def carried(dispatcher: Scripted, watched: frozenset[bytes] = frozenset()) -> list[tuple[Any, ...]]:
    """What the dispatcher was told, and what was written, in order."""
    broker = Broker("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")

    def record(instruction: Record) -> list[Verdict]:
        dispatcher.told.append(("written", instruction.verdict))
        return [instruction.verdict]

    def give_up(instruction: GiveUp) -> Loss:
        return HUNG

    ticks: list[float] = []

    def every_tick(now: float) -> list[Instruction]:
        ticks.append(now)
        return []

    try:
        broker.run(
            cast(Dispatcher, dispatcher),
            give_up=give_up,
            record=record,
            look_for=lambda missing: missing.video == "a.mp4",
            watched=watched.__contains__,
            every_tick=every_tick,
            stopping=lambda: bool(ticks),
        )
    finally:
        broker.close()
    return dispatcher.told


def test_a_record_is_written_and_reported_before_what_follows() -> None:
    gone = ToConsumer(b"gone", encode(Pong()))
    told = carried(Scripted([RECORD, gone], after_record=[ToConsumer(b"first", encode(Pong()))]))
    assert told == [
        ("written", VERDICT),
        ("recorded", RECORD, [VERDICT]),
        ("consumer lost", b"first"),
        ("consumer lost", b"gone"),
    ]


@pytest.mark.parametrize("found", [True, False])
def test_what_is_looked_for_is_reported(found: bool) -> None:
    missing = LookFor("a.mp4" if found else "b.mp4", "f", b"w", None, "cannot be read", Request(b"c", 0, 0))
    assert carried(Scripted([missing])) == [("looked for", missing, found)]


def test_a_worker_given_up_is_reported_with_what_its_loss_means() -> None:
    assert carried(Scripted([GiveUp(b"w", "slept")])) == [("lost", b"w", HUNG)]


@pytest.mark.parametrize("watched", [True, False])
def test_who_cannot_be_reached_is_reported_unless_its_end_will_be(watched: bool) -> None:
    """How a process of ours ended says whether the sample is to blame; that it is not there any more does not."""
    told = carried(Scripted([ToWorker(b"w", encode(Stop()))]), frozenset({b"w"} if watched else ()))
    assert told == ([] if watched else [("unreachable", b"w")])


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="Linux only")
def test_the_system_looks_after_connections_on_which_nothing_is_said() -> None:
    """A host that lost power closes none of them."""
    broker = Broker("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
    try:
        for address in (broker.address, broker.worker_address):
            with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as peer:
                peer.recv(1)  # ZeroMQ's greeting: it has taken the connection
                until(lambda: _keepalive_is_due(peer))
    finally:
        broker.close()


def _keepalive_is_due(peer: socket.socket) -> bool:
    """Whether the other end of a connection, which is idle, waits to send a probe: proc_net_tcp(5), timer 2."""
    ends = [f"0100007F:{port:04X}" for _, port in (peer.getpeername(), peer.getsockname())]
    rows = (line.split() for line in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines())
    return any(row[1:3] == ends and row[5].startswith("02:") for row in rows)


def test_a_farewell_to_nobody_is_no_error() -> None:
    broker = Broker("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
    try:
        broker.say_farewell([ToWorker(b"w", encode(Stop())), ToConsumer(b"c", encode(Pong()))])
    finally:
        broker.close()


def test_a_time_in_which_the_server_was_stopped_is_no_silence_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its workers were stopped along with it, or have answered to nobody: no deadline may run out."""
    ticks: list[float] = []

    def every_tick(now: float) -> list[Instruction]:
        ticks.append(now)
        return []

    monkeypatch.setattr(broker_module, "time", SimpleNamespace(monotonic=lambda: 50.0 + 100.0 * len(ticks)))
    broker = Broker("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
    try:
        broker.run(
            cast(Dispatcher, Scripted([])),
            give_up=lambda hopeless: HUNG,
            record=lambda verdict: [],
            look_for=lambda missing: True,
            watched=lambda identity: False,
            every_tick=every_tick,
            stopping=lambda: len(ticks) == 3,
        )
    finally:
        broker.close()
    assert ticks == [50.0, 51.0, 52.0]
