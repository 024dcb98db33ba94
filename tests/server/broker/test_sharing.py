"""Equal samples are made once, and nothing else changes for anybody."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import settings

from tests.server.broker.test_interleaving import WithSlots, walk
from tests.server.named_corpus import SMALL_SPEC
from tests.server.peers import Peers, peers
from v2v_client.memory import open_sample
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import Hello, Lease, SampleHeader, Want, encode
from v2v_protocol.sample import Form, array_layout
from v2v_server.sharing import SampleRing
from v2v_server.worker.process import slot_arrays

ARENA = f"17:9:12:{'0123456789abcdef' * 2}"
LAYOUT = array_layout(SMALL_SPEC.recipe, "int8", ("voxels",))
SIZES = Form.of(LAYOUT).sizes


def sharing(*consumers: bytes, seed: int = 0) -> Peers:
    at = peers(share_bytes=1 << 20)
    for identity in consumers:
        at.hello(identity, seed=seed)
    return at


@pytest.mark.parametrize("waited", [True, False])
def test_a_request_for_a_sample_in_work_follows_it(waited: bool) -> None:
    at = sharing(b"c", b"d")
    if not waited:
        at.join()
    at.want(0, identity=b"c")
    at.want(0, identity=b"d")
    if waited:
        at.join()
    assert len(at.leases[b"w"]) == 1
    at.work_off()
    assert at.samples(b"c") == at.samples(b"d") == [(0, 0)]
    assert (at.broker.counters.samples, at.broker.counters.shared) == (2, 1)
    assert at.broker.counters.decodes == 1


def test_a_consumer_gets_no_more_shared_samples_than_it_reads() -> None:
    at = sharing(b"c", b"d")
    at.join()
    at.want(*range(4), identity=b"c")
    at.work_off()
    at.dispatcher.in_flight(b"d", 1 << 40, at.now)
    at.want(*range(4), identity=b"d")
    assert at.samples(b"d") == []
    at.want(*range(4), 4, 5, identity=b"c")
    at.work_off()
    assert len(at.samples(b"c")) == 10
    at.carry_out(at.dispatcher.in_flight(b"d", 0, at.now))
    assert sorted(at.samples(b"d")) == [(0, index) for index in range(4)]
    assert at.broker.counters.decodes == 6


def test_a_finished_sample_is_sent_even_if_no_worker_is_left() -> None:
    at = sharing(b"c", b"d")
    at.join()
    at.want(0, identity=b"c")
    at.work_off()
    at.die()
    at.want(0, 1, identity=b"d")
    assert at.samples(b"d") == [(0, 0)]
    assert at.broker.waiting == 1


def test_other_streams_share_nothing() -> None:
    at = sharing(b"c")
    at.hello(b"d", seed=1)
    at.hello(b"e", voxel_dtype="float32")
    at.carry_out(at.dispatcher.from_consumer(b"k", encode(Hello({}, ("voxels",), 4, 0)), at.now, "another key"))
    at.join()
    for identity in (b"c", b"d", b"e"):
        at.want(0, identity=identity)
        at.work_off()
    at.carry_out(at.dispatcher.from_consumer(b"k", encode(Want(0, (0,))), at.now, "another key"))
    at.work_off()
    assert all(at.samples(identity) == [(0, 0)] for identity in (b"c", b"d", b"e", b"k"))
    assert at.broker.counters.shared == 0


def test_a_worker_gets_memory_of_the_server_and_consumers_their_own_slot_back() -> None:
    at = sharing(b"c", b"d")
    at.join()
    at.want(0, identity=b"c", arena=ARENA, slots=[5])
    at.want(0, identity=b"d", arena=ARENA, slots=[7])
    lease = at.begin()
    assert lease.arena not in ("", ARENA)
    at.finish(in_slot=True)
    for identity, number in ((b"c", 5), (b"d", 7)):
        answer = at.heard[identity][-1]
        assert isinstance(answer, SampleHeader)
        assert (answer.arena, answer.slot, len(at.frames[identity][-1])) == (lease.arena, number, 1)
    assert at.broker.counters.in_slots == 2


@pytest.mark.parametrize("packed", [True, False])
def test_without_memory_of_the_server_shared_samples_are_messages(
    packed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are never only in the arena of the consumer that came first. No memory is lent to packed samples."""
    if not packed:
        monkeypatch.setattr(SampleRing, "lend", lambda *_: None)
    at = peers(share_bytes=1 << 20)
    for identity in (b"c", b"d", b"e"):
        at.consumer_says(identity, Hello({}, ("voxels",), 4, 0, packed=packed))
    at.join()
    at.want(0, identity=b"c", arena=ARENA, slots=[5])
    at.want(0, identity=b"d", arena=ARENA, slots=[7])
    lease = at.begin()
    assert (lease.packed, lease.arena, lease.slot) == (packed, "", NO_SLOT)
    at.finish()
    at.want(0, identity=b"e")
    for identity, number in ((b"c", 5), (b"d", 7), (b"e", NO_SLOT)):
        answer = at.heard[identity][-1]
        assert isinstance(answer, SampleHeader)
        assert (answer.arena, answer.slot, len(at.frames[identity][-1])) == ("", number, 2)


class Sharing(WithSlots):
    """The interleaving with slots, and with a ring of five samples in real memory. A sample holds its seed, so a
    consumer sees that it reads no other stream's, nor half of one. A sample that the ring has dropped is requested
    again, without a slot."""

    share_bytes = 5 * 4096

    def __init__(self) -> None:
        super().__init__()
        self.read_shared = 0
        self.dropped = 0

    def answer(self, identity: bytes) -> Lease:
        lease = self.at.leases[identity][0]
        arrays = None if lease.slot == NO_SLOT else slot_arrays(Slot(lease.arena, lease.slot), LAYOUT)
        if arrays is not None:
            arrays["voxels"][:] = lease.seed
            del arrays
        return super().answer(identity)

    def receive_sample(self, identity: bytes, header: SampleHeader, *, in_message: bool) -> None:
        super().receive_sample(identity, header, in_message=in_message or bool(header.arena))
        if header.arena:
            arrays = open_sample(header.arena, SIZES)
            self.read_shared += bool(arrays)
            if arrays:
                assert np.all(np.frombuffer(arrays[0], np.int8) == self.seed[identity])
            else:
                self.dropped += 1
                self.again.append((identity, header.epoch, header.index))

    def _listen(self) -> None:
        self.again: list[tuple[bytes, int, int]] = []
        super()._listen()
        for identity, epoch, index in self.again:
            self.owed[identity].add((epoch, index))
            self.at.want(index, identity=identity, epoch=epoch)
        if self.again:
            self._listen()

    def teardown(self) -> None:
        super().teardown()
        if hasattr(self, "at"):
            broker = self.at.broker
            assert broker.ring is not None
            assert (broker.makers, broker.followers, broker.ring.being_made) == ({}, {}, {})


TestInterleavingOfSharing = Sharing.TestCase
TestInterleavingOfSharing.settings = settings(max_examples=20, stateful_step_count=40, deadline=None)


def test_long_walks_with_sharing_keep_the_promise() -> None:
    seen: Counter[str] = Counter()
    for seed in range(6):
        model = Sharing()
        walk(seed, 120, lambda model=model: model)  # type: ignore[arg-type,misc]
        seen["shared"] += model.at.broker.counters.shared
        seen["read"] += model.read_shared
        seen["dropped"] += model.dropped
    assert all(seen[state] >= 5 for state in ("shared", "read", "dropped")), seen
