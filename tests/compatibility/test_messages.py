"""Peers of an earlier and of a later release: what informs is ignored, what says more is refused in words.

``peer_8.py`` is a frozen peer of each side. The pure parts of consumer, server and worker stand for this release.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import replace
from typing import Any

import msgpack
import pytest

from tests.client.fake_server import SPEC, expected
from tests.compatibility import peer_8
from tests.protocol.persisted_values import MESSAGES, example
from tests.server.named_corpus import SMALL_SPEC
from tests.server.peers import Peers, peers
from v2v_client.conversation import Conversation, Event
from v2v_client.options import Patience
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import NoWorkers, ProtocolError
from v2v_protocol.messages import Hello, Lease, Notes, Ping, Result, Want, WorkerHello, decode, encode
from v2v_protocol.sample import array_layout
from v2v_server.broker.state import Grant, ToConsumer, ToWorker
from v2v_server.corpus.catalogue import complete_lease
from v2v_server.worker.conversation import Leave, Make, Readiness, Send, WorkerConversation

LAYOUT = array_layout(SMALL_SPEC.recipe, SMALL_SPEC.voxel_dtype, ("voxels",))
EACH = pytest.mark.parametrize("name", peer_8.MESSAGES)
NOTED = {"memory_bytes": 5, "reason": "why", "of a later release": [{"any": 1}]}


def with_fields(frame: Any, **fields: Any) -> bytes:
    """The same message of a release that has more to say."""
    packed: bytes = msgpack.packb(msgpack.unpackb(bytes(frame)) | fields)
    return packed


def test_the_frozen_peer_knows_every_message_and_its_bytes_hold() -> None:
    assert {type(decode(frame)) for frame in peer_8.MESSAGES.values()} >= set(MESSAGES)
    for cls in MESSAGES:
        frame = bytes(encode(example(cls))[0])
        assert frame == peer_8.MESSAGES[msgpack.unpackb(frame)["t"]]


@EACH
def test_a_note_is_ignored_on_both_sides(name: str) -> None:
    frame = peer_8.MESSAGES[name]
    noted = with_fields(frame, notes=NOTED)
    assert msgpack.unpackb(encode(decode(noted))[0]) == msgpack.unpackb(frame) | {
        "notes": {"memory_bytes": 5, "reason": "why"}
    }
    assert peer_8.read(noted)[1].items() >= peer_8.fields_of(name).items()
    with pytest.raises(ProtocolError, match=r"Notes.memory_bytes = 'much': expected a whole number"):
        decode(with_fields(frame, notes={"memory_bytes": "much"}))


@EACH
def test_any_other_field_is_refused_on_both_sides(name: str) -> None:
    changed = with_fields(peer_8.MESSAGES[name], rotation=90)
    with pytest.raises(ProtocolError, match=r"has no field 'rotation'.*of a later release. Update the reader"):
        decode(changed)
    with pytest.raises(peer_8.Unreadable, match="has no field rotation"):
        peer_8.read(changed)


# --- a frozen consumer and worker, and this server --------------------------------------------------------------------


class Old:
    """A frozen consumer and a frozen worker at a server of this release, which may send a field more."""

    def __init__(self, at: Peers, **more: Any) -> None:
        self.at, self.more, self.now = at, more, 0.0
        self.consumer = peer_8.Consumer({}, ("voxels",))
        self.worker = peer_8.Worker(NUMERICS_VERSION, LAYOUT)

    def carry_out(self, actions: Any) -> None:
        todo = deque(actions)
        while todo:
            match todo.popleft():
                case ToConsumer(_, frames):
                    self.consumer.hears(list(map(bytes, frames)))
                case Grant() as grant:
                    completed = complete_lease(grant.leases[0], self.at.catalogue, grant.spec)
                    todo.extend(grant.messages(completed))
                case ToWorker(_, frames) if self.worker.is_there:
                    for answer in self.worker.hears(with_fields(frames[0], **self.more)):
                        todo.extend(self.at.dispatcher.from_worker(b"w", answer, self.now))

    def says(self, frame: bytes) -> None:
        self.carry_out(self.at.dispatcher.from_consumer(b"c", [frame], self.now))

    def joins(self) -> None:
        self.worker.is_there = True
        self.carry_out(self.at.dispatcher.from_worker(b"w", [self.worker.hello], self.now))


def test_a_frozen_consumer_and_worker_are_served() -> None:
    old = Old(peers())
    old.joins()
    old.says(old.consumer.hello)
    old.says(peer_8.write("want", epoch=0, indices=[0, 1, 2], arenas=[], slots=[]))
    assert sorted(old.consumer.samples) == [0, 1, 2]


@pytest.mark.parametrize("notes", [Notes(), Notes(memory_bytes=8 << 30)])
def test_a_lease_has_notes_only_for_a_worker_that_has_some_itself(notes: Notes) -> None:
    """A release before them refuses them, and would pass over each of its leases."""
    at = peers()
    at.dispatcher.from_consumer(b"c", encode(Hello(SMALL_SPEC.to_dict(), ("voxels",), 4, 0)), 0.0)
    at.dispatcher.from_consumer(b"c", encode(Want(0, [0])), 0.0)
    hello = WorkerHello("w", NUMERICS_VERSION, 2, "host", b"s" * 32, notes=notes)
    actions = at.dispatcher.from_worker(b"w", encode(hello), 0.0)
    (grant,) = actions
    assert isinstance(grant, Grant)
    (sent,) = grant.messages(replace(grant.leases[0], notes=Notes(state=(1, 2))))
    lease = decode(sent.frames[0])
    assert isinstance(lease, Lease)
    assert lease.notes == (Notes(state=(1, 2)) if notes != Notes() else Notes())


def test_a_worker_that_cannot_read_its_leases_leaves_and_the_consumer_is_told() -> None:
    """Not even with a worker that always returns, as under a supervisor."""
    old = Old(peers(), rotation=90)
    old.joins()
    old.says(old.consumer.hello)
    for _ in range(3):
        old.says(peer_8.write("want", epoch=0, indices=[0, 1], arenas=[], slots=[]))
        old.says(peer_8.write("ping"))
        assert not old.worker.is_there
        old.joins()
    assert old.consumer.samples == []
    assert len(old.consumer.troubles) == 3
    assert all("cannot read a message: lease has no field rotation" in each for each in old.consumer.troubles)
    assert old.at.broker.counters.malformed == 0
    old.more = {}  # the server is of an earlier release again
    old.joins()
    old.says(peer_8.write("ping"))
    assert sorted(old.consumer.samples) == [0, 1]
    assert old.consumer.troubles[-1] == ""


# --- this consumer and worker, and a frozen server --------------------------------------------------------------------


def test_this_consumer_is_served_by_a_frozen_server() -> None:
    talk = Conversation(
        "tcp://x:1", Hello({}, ("voxels",), 1, 5), 0, pinned=None, pinned_by="a test", patience=Patience(), now=0.0
    )
    talk.handle_event(Event.OPENED, 0.0)
    welcome = peer_8.write(
        "welcome", spec=SPEC.to_dict(), spec_digest=SPEC.digest, sequences=9, credit=2, quarantine=0, numerics_version=4
    )
    talk.handle_message(decode(welcome), [], 0.0)
    talk.want([3])
    assert [peer_8.read(encode(message)[0])[0] for message in talk.outbox] == ["hello", "want"]
    (dtype, shape), voxels = talk.layout["voxels"], expected("voxels", 5, 0, 3)
    header = peer_8.write(
        "sample", epoch=0, index=3, names=["voxels"], dtypes=[dtype], shapes=[len(shape), *shape], slot=0, packed=False,
        quarantine=0, arena="",
    )  # fmt: skip
    arrival = talk.handle_message(decode(header), [voxels.tobytes()], 0.0)
    assert arrival is not None
    assert arrival.arrays is not None
    assert (arrival.arrays["voxels"] == voxels).all()


def said(actions: list[Any]) -> list[tuple[str, dict[str, Any]]]:
    """What the frozen server reads."""
    return [peer_8.read(bytes(action.frames[0])) for action in actions if isinstance(action, Send)]


def test_this_worker_works_for_a_frozen_server() -> None:
    hello = WorkerHello("w", NUMERICS_VERSION, 2, notes=Notes(memory_bytes=1 << 30))
    talk = WorkerConversation(hello, ("tcp://x:1",), is_watched=False)
    ((name, fields),) = said(talk.start(0.0))
    assert (name, fields["memory_bytes"]) == ("worker-hello", 1 << 30)
    talk.on_messages([(0, peer_8.write("lease", lease=7, indices=[3]))], 0.0)
    *begun, make = talk.on_inspected(Readiness(True, True, False), 0.0)
    assert isinstance(make, Make)
    assert [name for name, _ in said(begun)] == ["begun"]
    talk.on_sample([b"header", b"array"], 0.0, Result(0))
    assert [(name, fields["lease"]) for name, fields in said(talk.on_messages([], 0.0))] == [("result", 7)]
    *_, leave = talk.on_messages([(0, peer_8.write("stop"))], 0.0)
    assert leave == Leave()


# --- all three of this release, under a server of a later one ---------------------------------------------------------


def test_the_reason_reaches_the_trainer_within_ten_seconds(caplog: pytest.LogCaptureFixture) -> None:
    at = peers()
    talk = Conversation(
        "tcp://x:1", Hello({}, ("voxels",), 2, 7), 0, pinned=None, pinned_by="a test", patience=Patience(), now=0.0
    )
    worker = WorkerConversation(WorkerHello("w", NUMERICS_VERSION, 2), ("tcp://x:2",), is_watched=False)
    now = 0.0

    def carry_out(actions: Any) -> None:
        todo = deque(actions)
        while todo:
            match todo.popleft():
                case ToConsumer(_, frames):
                    talk.handle_message(decode(bytes(frames[0])), list(map(bytes, frames[1:])), now)
                case Grant() as grant:
                    todo.extend(grant.messages(complete_lease(grant.leases[0], at.catalogue, grant.spec)))
                case ToWorker(_, frames) if at.broker.workers:  # it has not left
                    more = {"rotation": 90} if isinstance(decode(frames[0]), Lease) else {}
                    answers = worker.on_messages([(0, with_fields(frames[0], **more))], now)
                    for answer in answers:
                        if isinstance(answer, Send):
                            todo.extend(at.dispatcher.from_worker(b"w", answer.frames, now))

    talk.handle_event(Event.OPENED, now)
    for action in worker.start(now):
        if isinstance(action, Send):
            carry_out(at.dispatcher.from_worker(b"w", action.frames, now))

    def until(end: float) -> None:
        nonlocal now
        while now < end:
            talk.tick(now)
            outbox, talk.outbox = talk.outbox, []
            for message in outbox:
                assert isinstance(message, Hello | Want | Ping)
                carry_out(at.dispatcher.from_consumer(b"c", encode(message), now))
            if talk.outbox:
                continue
            now += talk.next_due(now)

    until(0.1)
    talk.want([0, 1])
    with caplog.at_level(logging.WARNING):
        until(10.0)
    (warning,) = caplog.messages
    assert "a worker left: it cannot read a message of the server: Lease has no field 'rotation'" in warning
    with pytest.raises(NoWorkers, match="Lease has no field 'rotation'"):
        until(100.0)
