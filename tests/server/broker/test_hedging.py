"""Second leases for slow samples: the consumer gets the sample once, from whichever worker is first."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.server.broker.test_slots import ARENA
from tests.server.named_corpus import SMALL_SPEC
from tests.server.peers import Peers, peers, serving
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import Lease
from v2v_server.broker.leases import ALONE_AFTER, Cause


def practised() -> tuple[Peers, Lease]:
    """A consumer whose samples take half a second, and a worker with room for no more that has begun its index 20."""
    at = serving(*range(8), worker=b"before", batch_size=20)
    for _ in range(8):
        at.begin(b"before")
        at.now += 0.5
        at.finish(b"before")
    at.die(b"before")
    at.join(b"slow", credit=1)
    at.want(20, arena=ARENA, slots=[5])
    return at, at.begin(b"slow")


def slowed() -> tuple[Peers, Lease, Lease]:
    """A worker that is slow at index 20, and another that has been given it as well."""
    at, first = practised()
    at.join(b"fast")
    at.tick(1.5)
    assert not at.leases[b"fast"]
    at.tick(0.1)
    (second,) = at.leases[b"fast"]
    assert (first.arena, first.slot) == (ARENA, 5)
    assert second == replace(first, lease=second.lease, arena="", slot=NO_SLOT)  # the first may still write to it
    assert at.broker.counters.second_leases == 1
    return at, first, second


@pytest.mark.parametrize("order", [(b"slow", b"fast"), (b"fast", b"slow")])
def test_the_first_answer_is_delivered_and_the_second_dropped(order: tuple[bytes, bytes]) -> None:
    at, *_ = slowed()
    before = at.samples()
    at.finish(order[0])
    assert at.samples() == [*before, (0, 20)]
    assert at.heard[b"c"][-1].slot == (5 if order[0] == b"slow" else NO_SLOT)  # type: ignore[union-attr]
    at.finish(order[1])
    assert at.samples() == [*before, (0, 20)]
    assert at.broker.counters.late_results == 1
    assert len(at.broker.leases) == 0
    # And the room of both is free again.
    at.want(21, 22, 23, 24)
    assert (len(at.leases[b"slow"]), len(at.leases[b"fast"])) == (1, 2)


def test_a_lone_task_has_no_twin() -> None:
    at = serving(*range(8), batch_size=20)
    at.work_off(b"w")
    at.die(b"w")
    at.want(20)
    for _ in range(ALONE_AFTER):
        at.join(b"w")
        at.begin(b"w")
        at.die(b"w", Cause.UNEXPLAINED)
    at.join(b"w")
    at.begin(b"w")
    at.join(b"idle")
    at.tick(20.0)
    assert not at.leases[b"idle"]
    assert at.broker.counters.second_leases == 0


def test_a_twin_is_of_the_snapshot_of_the_first_though_a_verdict_fell_meanwhile() -> None:
    """Both are the same candidate under the same snapshot, so a remake of either asks for that snapshot."""
    at, hanging = practised()
    at.want(21)
    at.join(b"dies", credit=1)
    at.begin(b"dies")
    at.die(b"dies", Cause.CRASHED)
    assert at.quarantine.latest == 1
    at.join(b"fast", credit=1)
    at.work_off(b"fast")
    at.tick(2.0)
    (twin,) = at.leases[b"fast"]
    assert (twin.indices, twin.candidate, twin.quarantine) == (hanging.indices, 0, 0)


def test_a_twin_does_not_take_the_worker_that_a_lone_task_waits_for() -> None:
    at, hanging = practised()
    at.hello(b"other")
    at.want(1, identity=b"other")
    for _ in range(ALONE_AFTER):
        at.join(b"dies", credit=1)
        at.begin(b"dies")
        at.die(b"dies", Cause.UNEXPLAINED)
    at.join(b"busy", credit=2)
    (alone,) = at.leases[b"busy"]
    assert at.asked_by(alone) == b"other"
    at.hello(b"third")
    at.want(2, 3, identity=b"third")
    at.join(b"empties", credit=2)
    at.finish(b"empties")
    at.die(b"busy", Cause.KILLED)
    # The one in work is all that stands between the lone request and its worker, and nothing is added to it.
    at.tick(2.0)
    assert [at.asked_by(lease) for lease in at.leases[b"empties"]] == [b"third"]
    at.finish(b"empties")
    assert [at.asked_by(lease) for lease in at.leases[b"empties"]] == [b"other"]
    assert hanging.indices == (20,)


def test_a_clip_takes_as_long_as_other_clips_not_as_siblings_that_need_no_decoding() -> None:
    at = peers(spec=replace(SMALL_SPEC, samples_per_decode=3))
    at.join(b"w", credit=1)
    at.hello(batch_size=4)
    at.want(*range(24))
    for place in range(24):
        decodes = place % 3 == 0
        at.begin()
        at.now += 3.0 if decodes else 0.2
        at.finish(decoded=decodes)
    at.want(24, 28, 32)
    at.begin()
    at.join(b"idle")
    at.tick(8.9)
    assert not at.leases[b"idle"]
    at.tick(0.2)
    assert [lease.indices for lease in at.leases[b"idle"]] == [(24,)]
