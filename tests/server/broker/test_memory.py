"""Workers with less memory than a clip takes: others make it, or its consumer is told, and no worker dies for it."""

from __future__ import annotations

import pytest

from tests.server.named_corpus import SMALL_SPEC, corpus, video
from tests.server.peers import Peers, peers
from v2v_protocol.messages import Ping, Pong
from v2v_protocol.sample import array_layout, layout_bytes
from v2v_server.broker.assignment import TOO_LARGE_SECONDS
from v2v_server.broker.leases import ALONE_AFTER, Cause
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES, lease_bytes

MIB = 1 << 20
BIG = video("big.mp4", height_px=2160, width_px=3840)
NEEDS = lease_bytes(
    BIG, corpus(BIG).rows, SMALL_SPEC, layout_bytes(array_layout(SMALL_SPEC.recipe, "int8", ("voxels",)))
)
SMALL_WORKER, LARGE_WORKER = 300 * MIB, NEEDS


def mixed(*indices: int, expected_workers: int = 0) -> Peers:
    """A consumer that asked for samples, in order, of a small video and of the big one: indices 10 and above."""
    at = peers(corpus(video("a.mp4"), BIG), expected_workers=expected_workers)
    at.hello(shuffle=False)
    at.want(*indices)
    return at


def trouble(at: Peers) -> str:
    at.tick(0.1)
    (pong,) = at.consumer_says(b"c", Ping())
    assert isinstance(pong, Pong)
    return pong.trouble


def videos(at: Peers, worker: bytes) -> list[str]:
    return [lease.video for lease in at.leases[worker]]


@pytest.mark.parametrize("first", [b"small", b"large"])
def test_a_clip_goes_to_a_worker_that_can_hold_it_and_no_other_waits(first: bytes) -> None:
    at = mixed(0, 10, 11, 1)
    for name in sorted((b"small", b"large"), key=first.__ne__):
        at.join(name, memory_bytes=SMALL_WORKER if name == b"small" else LARGE_WORKER)
    for _ in range(4):
        for name in (b"small", b"large"):
            assert "big.mp4" not in videos(at, b"small")
            if at.leases[name]:
                at.begin(name)
                at.finish(name)
    assert sorted(at.samples()) == [(0, 0), (0, 1), (0, 10), (0, 11)]
    assert trouble(at) == ""


def test_siblings_of_a_large_clip_stay_together() -> None:
    at = peers(corpus(video("a.mp4"), BIG))
    at.hello(shuffle=False, samples_per_decode=2, sibling_spacing=1)
    at.want(20, 21)
    at.join(b"small", memory_bytes=SMALL_WORKER)
    assert at.broker.waiting == 2
    at.join(b"large", memory_bytes=LARGE_WORKER + MIB)
    assert [lease.indices for lease in at.leases[b"large"]] == [(20, 21), (21,)]


def test_a_second_worker_for_a_slow_sample_can_hold_it() -> None:
    at = mixed(*range(10, 18))
    at.join(b"large", memory_bytes=LARGE_WORKER)
    at.join(b"small", memory_bytes=SMALL_WORKER)
    for _ in range(8):
        at.begin(b"large")
        at.finish(b"large")
    at.want(18)
    at.begin(b"large")
    at.tick(10.0)
    assert videos(at, b"small") == []
    at.join(b"other", memory_bytes=LARGE_WORKER)
    at.tick(0.1)
    assert videos(at, b"other") == ["big.mp4"]


def test_a_clip_that_no_worker_can_hold_is_an_error_of_its_consumer_within_ten_seconds() -> None:
    at = mixed(0, 10)
    at.join(b"small", memory_bytes=SMALL_WORKER)
    at.work_off(b"small")
    said = (
        f"big.mp4 from frame 0 needs {NEEDS / 1e9:.2f} GB of memory under this spec, the largest worker has 0.31: give "
    )
    assert trouble(at).startswith(said)
    at.tick(TOO_LARGE_SECONDS)
    (error,) = at.unavailable()
    assert error.index == 10
    assert error.text.startswith(said)
    assert at.samples() == [(0, 0)]
    assert (at.recorded, at.broker.waiting, trouble(at)) == ([], 0, "")


def test_it_waits_for_workers_that_are_to_come_and_says_so_meanwhile() -> None:
    at = mixed(10, expected_workers=2)
    at.join(b"small", memory_bytes=SMALL_WORKER)
    at.tick(4 * TOO_LARGE_SECONDS)
    assert at.unavailable() == []
    assert "needs 0.47 GB" in trouble(at)
    at.join(b"large", memory_bytes=LARGE_WORKER)
    at.tick(TOO_LARGE_SECONDS)
    assert trouble(at) == ""
    at.work_off(b"large")
    assert at.samples() == [(0, 10)]


def test_a_worker_that_states_no_limit_has_that_of_all_workers() -> None:
    for stated in (0, LARGEST_MEMORY_BYTES, 2**63):
        at = mixed(10)
        at.join(memory_bytes=stated)
        assert at.broker.registry.most_memory == LARGEST_MEMORY_BYTES
        assert videos(at, b"w") == ["big.mp4"]


def killed_at_its_limit(at: Peers, worker: bytes, memory_bytes: int = LARGE_WORKER) -> bool:
    """A worker joins and dies over a lease; return False if it gets none."""
    at.join(worker, memory_bytes=memory_bytes)
    if not at.leases[worker]:
        return False
    at.begin(worker)
    at.die(worker, Cause.MEMORY, "was ended by SIGKILL for lack of memory")
    return True


@pytest.mark.parametrize("limit", [LARGE_WORKER, 0])
def test_a_clip_that_was_underestimated_kills_three_workers_and_is_then_refused(limit: int) -> None:
    """Never in quarantine: a server with larger workers makes it. And not for its consumer's next life either."""
    at = mixed(10)
    deaths = 0
    while killed_at_its_limit(at, b"w", limit):
        deaths += 1
    assert deaths == ALONE_AFTER + 1
    for life in range(3):
        at.tick(TOO_LARGE_SECONDS)
        assert len(at.unavailable()) == life + 1
        assert f"needs more than {(limit or LARGEST_MEMORY_BYTES) / 1e9:.2f} GB" in at.unavailable()[life].text
        at.hello(shuffle=False)
        at.want(10)
        assert videos(at, b"w") == []
    assert (at.recorded, at.quarantine.latest) == ([], 0)
    at.want(0)
    at.work_off()
    assert at.samples() == [(0, 0)]


def test_a_larger_worker_makes_what_killed_a_smaller_one() -> None:
    at = mixed(10, 11)
    while killed_at_its_limit(at, b"w"):
        at.leases.pop(b"w", None)
    at.join(b"larger", memory_bytes=LARGE_WORKER + MIB)
    assert videos(at, b"larger") == ["big.mp4"], "it runs alone"
    at.work_off(b"larger")
    at.work_off(b"w")
    assert sorted(at.samples()) == [(0, 10), (0, 11)]


def test_a_worker_is_kept_empty_for_a_lone_clip_only_if_it_can_hold_it() -> None:
    at = mixed(10, 0, 1, 2, 3, 4)
    for _ in range(ALONE_AFTER):
        assert killed_at_its_limit(at, b"w")
    at.join(b"large", memory_bytes=LARGE_WORKER)
    assert videos(at, b"large") == ["big.mp4"]
    at.join(b"small", memory_bytes=SMALL_WORKER)
    assert len(at.leases[b"small"]) == 2
    at.work_off(b"small")
    at.work_off(b"large")
    assert len(at.samples()) == 6


def test_a_consumer_that_leaves_takes_its_large_clips_along() -> None:
    at = mixed(10)
    at.join(b"small", memory_bytes=SMALL_WORKER)
    assert at.broker.waiting == 1
    at.dispatcher.consumer_lost(b"c")
    assert at.broker.waiting == 0
    at.tick(TOO_LARGE_SECONDS)
    assert at.unavailable() == []
