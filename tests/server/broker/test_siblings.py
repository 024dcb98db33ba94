"""Several samples of one decode: where they lie in an epoch, and that they reach the same worker together."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.server.named_corpus import corpus, video
from tests.server.peers import SMALL_SPEC, Peers, peers
from v2v_protocol.errors import UsageError
from v2v_protocol.messages import ErrorCode, Hello
from v2v_protocol.spec import StreamSpec
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.video.rows import Rows

BATCH = 4
VIEWS = 3
SIBLINGS = replace(SMALL_SPEC, samples_per_decode=VIEWS)


def schedule(frames: int, views: int, spacing: int) -> Schedule:
    videos = corpus(*(video(f"v{number}.mp4", frames=frames) for number in range(5))).videos
    spec = replace(SMALL_SPEC, samples_per_decode=views, sibling_spacing=spacing if views > 1 else 0)
    return Schedule(SequenceTable(videos, Rows.parse("full"), spec), spec)


@given(
    views=st.integers(1, 5),
    ranks=st.integers(1, 3),
    batch=st.integers(1, 4),
    loaders=st.integers(1, 3),
    frames=st.integers(5, 40),
)
def test_siblings_come_in_different_batches_of_one_consumer_within_k_of_its_batches(
    views: int, ranks: int, batch: int, loaders: int, frames: int
) -> None:
    of = schedule(frames, views, ranks * batch * loaders)
    seen: dict[int, list[tuple[int, int, int]]] = {}
    for index in range(of.count):
        local, rank = divmod(index, ranks)
        number = local // batch
        seen.setdefault(of.place(index), []).append((rank, number % loaders, number // loaders))
    for where in seen.values():
        if views == 1:
            assert len(where) == 1
            continue
        assert len(where) == views
        assert len({(rank, loader) for rank, loader, _ in where}) == 1
        numbers = [number for _, _, number in where]
        assert numbers == list(range(numbers[0], numbers[0] + views))


@settings(max_examples=50)  # views and spacing are 48 cases
@given(views=st.integers(1, 4), spacing=st.integers(1, 12), seed=st.integers(0, 2**64 - 1), epoch=st.integers(0, 9))
def test_every_sequence_that_is_not_dropped_comes_once_for_each_view(
    views: int, spacing: int, seed: int, epoch: int
) -> None:
    of = schedule(30, views, spacing)
    found = Counter(
        (sequence.video.id, sequence.start_frame)
        for sequence in (of.candidate(seed, epoch, index, 0) for index in range(of.count))
    )
    assert set(found.values()) <= {views}
    # A refused candidate is refused for all views, which move on together.
    moved = {
        (of.place(index), sequence.video.id, sequence.start_frame)
        for index in range(of.count)
        for sequence in [of.candidate(seed, epoch, index, 1)]
    }
    assert len(moved) == of.count // views
    everything = schedule(30, 1, 0).count
    assert len(found) == (everything if views == 1 else everything // spacing * spacing)


def test_a_schedule_needs_the_spacing() -> None:
    videos = corpus(video("a.mp4", frames=30)).videos
    with pytest.raises(UsageError, match="sibling_spacing = 0: set sibling_spacing to the number"):
        Schedule(SequenceTable(videos, Rows.parse("full"), SIBLINGS), SIBLINGS)


# --- through the dispatcher -------------------------------------------------------------------------------------------


def opened(credit: int = 2) -> Peers:
    at = peers(spec=SIBLINGS)
    welcome = at.hello(batch_size=BATCH)
    assert StreamSpec.from_dict(welcome.spec) == replace(SIBLINGS, sibling_spacing=BATCH)
    # Two blocks, and what the client collects before it asks: an eighth of everything.
    assert welcome.credit - welcome.credit // 8 >= 2 * BATCH * VIEWS
    assert welcome.credit <= 2 * BATCH * VIEWS * 8 / 7 + 1
    at.want(*range(2 * BATCH * VIEWS))
    at.join(credit=credit)
    return at


def test_a_worker_gets_the_siblings_in_a_row_and_knows_of_those_to_come() -> None:
    at = opened()
    assert [lease.indices for lease in at.leases[b"w"]] == [(0, 4, 8), (4, 8), (8,), (1, 5, 9), (5, 9), (9,)]
    first = at.leases[b"w"][0]
    same = [(lease.video, lease.start_frame) for lease in list(at.leases[b"w"])[:3]]
    assert same == [(first.video, first.start_frame)] * 3


def test_room_is_counted_in_clips() -> None:
    at = opened(credit=1)
    assert [lease.indices[0] for lease in at.leases[b"w"]] == [0, 4, 8]
    for _ in range(2):
        at.begin()
        at.finish()
        assert len({lease.indices[0] % BATCH for lease in at.leases[b"w"]}) == 1
    at.begin()
    at.finish()
    assert [lease.indices[0] for lease in at.leases[b"w"]] == [1, 5, 9]


def test_siblings_that_were_not_asked_for_yet_come_later() -> None:
    at = peers(spec=SIBLINGS)
    at.hello(batch_size=BATCH)
    at.join()
    at.want(0, 1, 2)
    assert [lease.indices for lease in at.leases[b"w"]] == [(0,), (1,)]
    at.want(4, 6, 8)
    at.finish()
    assert [lease.indices for lease in at.leases[b"w"]] == [(1,), (2, 6), (6,)]
    at.work_off()
    assert sorted(at.samples()) == [(0, index) for index in (0, 1, 2, 4, 6, 8)]


def test_an_epoch_without_a_whole_block_is_refused() -> None:
    at = peers(spec=replace(SIBLINGS, sibling_spacing=1000))
    at.consumer_says(b"c", Hello({}, ("voxels",), BATCH, 0))
    (refused,) = at.refusals()
    assert refused.code == ErrorCode.SPEC
    assert "50 sequences do not fill a block of sibling_spacing = 1000" in refused.text
