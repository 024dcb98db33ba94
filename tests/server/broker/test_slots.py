"""Slots on the server's side: which consumer is told of one, and never of one that a worker may still write to."""

from __future__ import annotations

import dataclasses

import pytest

from tests.server.peers import Peers, answer_to, peers, serving
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import Buffer, ErrorCode, Result, SampleHeader, Want, decode, encode

ARENA = f"17:9:12:{'0123456789abcdef' * 2}"


def at_work(*, workers: int = 1) -> Peers:
    """A consumer that asked for index 0 in slot 5, and so many workers; the first has the lease."""
    at = serving()
    at.want(0, arena=ARENA, slots=[5])
    for number in range(1, workers):
        at.join(f"w{number}".encode())
    return at


def test_a_lease_names_the_slot_and_its_header_goes_alone() -> None:
    at = at_work()
    at.want(0, arena=ARENA, slots=[6])  # an index that is asked for again keeps its first slot
    lease = at.begin()
    assert (lease.arena, lease.slot) == (ARENA, 5)
    at.finish(in_slot=True)
    (header,) = (message for message in at.heard[b"c"] if isinstance(message, SampleHeader))
    assert header.slot == 5
    assert [len(frames) for frames in at.frames[b"c"]] == [1, 1]
    counters = at.broker.counters
    assert (counters.in_slots, counters.bytes) == (1, 2 * 2 * 8 * 8)


def test_each_index_of_a_request_has_its_own_arena_or_none() -> None:
    at, other = peers(), ARENA.replace("17:9", "17:10")
    at.hello()
    at.consumer_says(b"c", Want(0, (0, 1, 2), (ARENA, "", other), (5, NO_SLOT, 5)))
    at.join(b"w")
    at.join(b"w2")
    leases = {lease.indices[0]: (lease.arena, lease.slot) for held in at.leases.values() for lease in held}
    assert leases == {0: (ARENA, 5), 1: ("", NO_SLOT), 2: (other, 5)}


def test_a_worker_that_cannot_reach_it_sends_the_arrays_and_says_that_the_slot_is_free() -> None:
    at = at_work()
    at.begin()
    at.fail()
    # The next candidate keeps the slot, because the worker answered.
    again = at.begin()
    assert (again.candidate, again.slot) == (1, 5)
    at.finish(in_slot=False)
    assert [len(frames) for frames in at.frames[b"c"]] == [1, 2]
    assert at.heard[b"c"][-1].slot == 5  # type: ignore[union-attr]
    assert at.broker.counters.in_slots == 0


@pytest.mark.parametrize(
    ("arena", "slots"),
    [
        (ARENA, [1, 2]),
        (ARENA, [0]),
        (ARENA, [13]),
        ("", [1]),
        ("17:9:short", [1]),
        ("../../etc/passwd", [1]),
        (ARENA.upper(), [1]),
    ],
)
def test_malformed_slots_are_refused_and_no_request_is_taken(arena: str, slots: list[int]) -> None:
    at = serving()
    at.want(0, arena=arena, slots=slots)
    assert [refused.code for refused in at.refusals()] == [ErrorCode.MALFORMED]
    assert not at.leases[b"w"]
    assert at.broker.waiting == 0


@pytest.mark.parametrize("slot", [NO_SLOT, 6])
def test_a_result_in_another_slot_than_was_lent_is_none(slot: int) -> None:
    at = at_work(workers=2)
    lease = at.begin()
    frames = answer_to(lease)
    header = at_header(frames[0], slot)
    at.worker_says(b"w", Result(lease.lease), header, *frames[1:])
    assert at.samples() == []
    assert [held.indices for held in at.leases[b"w1"]] == [(0,)]


def at_header(raw: Buffer, slot: int) -> bytes:
    """The header with another slot."""
    message = decode(raw)
    assert isinstance(message, SampleHeader)
    return bytes(encode(dataclasses.replace(message, slot=slot))[0])
