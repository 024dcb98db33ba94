"""Leases that cannot be completed: they go back before a worker sees them, in their order, and nothing is lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import cast

import pytest

from tests.server.broker.test_hedging import practised
from tests.server.broker.test_sharing import ARENA
from tests.server.named_corpus import SMALL_SPEC, NamedCorpus, corpus, video
from tests.server.peers import Peers, peers
from v2v_protocol.messages import Lease, Ping, Pong
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Cause

NAMES = tuple(f"v{number}.mp4" for number in range(5))
BATCH = 4
SIBLINGS = replace(SMALL_SPEC, samples_per_decode=3)
CLIPS = [(0, 4, 8), (1, 5, 9), (2, 6, 10), (3, 7, 11)]


def locked(spec: StreamSpec = SMALL_SPEC, share_bytes: int = 0) -> tuple[Peers, set[str]]:
    """A server whose index is locked by another process until the set is cleared."""
    held = set(NAMES)
    at = peers(corpus(*map(video, NAMES), held=held), spec, share_bytes=share_bytes)
    return at, held


def in_order(at: Peers, *workers: bytes) -> list[Lease]:
    return sorted((lease for worker in workers for lease in at.leases[worker]), key=lambda lease: lease.lease)


@pytest.mark.parametrize("ticks", [1, 3])
def test_all_clips_that_wait_for_a_locked_index_keep_their_order(ticks: int) -> None:
    at, held = locked(SIBLINGS)
    for name in (b"w1", b"w2"):
        at.join(name)
    at.hello(batch_size=BATCH)
    at.want(*range(12))
    for _ in range(ticks):
        at.tick(0.1)
    broker = at.broker
    assert not at.leases[b"w1"]
    assert not at.leases[b"w2"]
    assert (len(broker.leases), broker.waiting, broker.leases.held, broker.leases.out) == (0, 12, {}, {})
    assert [request.index for request in next(iter(broker.sessions)).waiting] == [
        index for clip in CLIPS for index in clip
    ]
    (pong,) = at.consumer_says(b"c", Ping())
    assert isinstance(pong, Pong)
    assert pong.trouble.endswith("database is locked; retried ten times a second")
    held.clear()
    at.tick(0.1)
    assert [lease.indices for lease in in_order(at, b"w1", b"w2")] == [
        clip[first:] for clip in CLIPS for first in range(3)
    ]
    for name in (b"w1", b"w2"):
        at.work_off(name)
    assert sorted(at.samples()) == [(0, index) for index in range(12)]
    counters = broker.counters
    assert (counters.refused_candidates, counters.returned_leases, counters.second_leases) == (0, 0, 0)


def test_the_siblings_of_a_damaged_clip_move_on_together() -> None:
    damaged: list[str] = []
    for _ in range(2):  # once to learn which video clip 0 is made from
        at = peers(corpus(*map(video, NAMES), unreadable=tuple(damaged)), SIBLINGS)
        at.join(credit=8)
        at.hello(batch_size=BATCH)
        at.want(*range(12))
        leases = list(at.leases[b"w"])
        damaged.append(leases[0].video)
    assert damaged[0] not in {lease.video for lease in leases}
    assert [lease.candidate for lease in leases if lease.indices[-1] == 8][:3] == [1, 1, 1]
    assert sorted(lease.indices for lease in leases) == sorted(clip[first:] for clip in CLIPS for first in range(3))
    for first, second in pairwise(leases):
        assert len(first.indices) == 1 or first.indices[1:] == second.indices  # each follows its sibling
    refused = [lease.refusals["refusals"] for lease in leases if lease.candidate]
    assert all("is damaged" in each["reason"] for refusals in refused for each in refusals)
    assert [lease.lease for lease in leases] == at.broker.leases.held[b"w"]
    at.work_off()
    assert len(at.samples()) == 12


@pytest.mark.parametrize("is_damaged", [True, False])
def test_memory_of_a_lease_that_was_not_sent_is_free_and_its_followers_wait_again(is_damaged: bool) -> None:
    at, held = locked(share_bytes=1 << 20)
    if is_damaged:
        at = peers(corpus(*map(video, NAMES), unreadable=NAMES), share_bytes=1 << 20)
    for identity in (b"c", b"d"):
        at.hello(identity)
        at.want(0, 1, 2, identity=identity, arena=ARENA, slots=[1, 2, 3])
    at.join(credit=8)
    broker = at.broker
    assert broker.ring is not None
    assert (broker.makers, broker.followers, broker.ring.being_made) == ({}, {}, {})
    if is_damaged:
        assert [[each.index for each in at.unavailable(identity)] for identity in (b"c", b"d")] == [[0, 1, 2]] * 2
        return
    assert [[request.index for request in session.waiting] for session in broker.sessions] == [[0, 1, 2]] * 2
    held.clear()
    at.tick(0.1)
    assert len(at.leases[b"w"]) == 3
    at.work_off()
    assert at.samples(b"c") == at.samples(b"d") == [(0, 0), (0, 1), (0, 2)]


def test_a_second_lease_that_was_not_sent_leaves_the_first_alone() -> None:
    at, first = practised()
    at.join(b"fast")
    cast(NamedCorpus, at.catalogue).held.add(first.video)
    for _ in range(3):
        at.tick(1.6)
    assert not at.leases[b"fast"]
    assert at.broker.counters.second_leases == 0
    before = at.samples()
    at.finish(b"slow")
    assert at.samples() == [*before, (0, 20)]


def test_siblings_whose_candidate_is_in_quarantine_keep_their_order() -> None:
    at = peers(spec=SIBLINGS)
    at.hello(batch_size=BATCH)
    at.want(*range(12))
    at.join()
    assert at.begin().indices == CLIPS[0]
    at.die(cause=Cause.CRASHED)
    at.join()
    assert [(lease.indices, lease.candidate) for lease in list(at.leases[b"w"])[:3]] == [
        (CLIPS[0], 1),
        (CLIPS[0][1:], 1),
        (CLIPS[0][2:], 1),
    ]
