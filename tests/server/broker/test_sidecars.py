"""A file beside a video fails: no video is blamed for it, and none takes its place."""

from __future__ import annotations

import pytest

from tests.server.named_corpus import corpus, video
from tests.server.peers import Peers, peers
from v2v_protocol import sample
from v2v_protocol.messages import Hello, Unavailable, Welcome
from v2v_protocol.sample import ArrayForm, Needs
from v2v_server.corpus.videos import Sidecars

ENDING, ARRAYS = ".label.json", ("voxels", "label")


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Peers:
    """Two workers, and a consumer that asks for an array from a sidecar, which one of two videos has."""
    monkeypatch.setitem(
        sample.ARRAYS, "label", ArrayForm(lambda recipe, _: ("float32", (1,)), Needs(sidecars=(ENDING,)))
    )
    labels = Sidecars({"a.mp4": "3-abc"}, "d" * 32)
    made = peers(corpus(video("a.mp4"), video("b.mp4"), sidecars={ENDING: labels}))
    for name in (b"w1", b"w2"):
        made.join(name, credit=1)
    return made


def hello(at: Peers, arrays: tuple[str, ...] = ARRAYS) -> Welcome:
    (welcome,) = at.consumer_says(b"c", Hello({}, arrays, 4, 0))
    assert isinstance(welcome, Welcome)
    return welcome


def ask_for_a_label(at: Peers) -> int:
    """Ask until the first worker holds a lease of the video with a sidecar, alone; return the index."""
    for index in range(20):
        at.want(index)
        if at.leases[b"w1"][0].video == "a.mp4":
            return index
        at.work_off(b"w1")
    raise AssertionError


def test_a_lease_has_the_fingerprints_that_its_arrays_need(at: Peers) -> None:
    plain, labelled = hello(at, ("voxels",)), hello(at)
    assert (plain.sidecars, plain.catalogue_digest) == ("", labelled.catalogue_digest)
    assert labelled.sidecars
    seen = {}
    for index in range(20):
        at.want(index)
        lease = at.leases[b"w1"][0]
        seen[lease.video] = lease.sidecars
        at.work_off(b"w1")
    assert seen == {"a.mp4": {ENDING: "3-abc"}, "b.mp4": {}}
    hello(at, ("voxels",))
    ask_for_a_label(at)
    assert not at.leases[b"w1"][0].sidecars


@pytest.mark.parametrize("here", [False, True])
def test_a_sidecar_that_fails_is_an_error_of_that_sample(at: Peers, here: bool) -> None:
    hello(at)
    index = ask_for_a_label(at)
    if here:
        at.gone.add("a.mp4")  # the server's host has no such sidecar either
    at.fail(b"w1", "has no frame 3", None, here=here, sidecar=ENDING)
    (told,) = [message for message in at.heard[b"c"] if isinstance(message, Unavailable)]
    assert (told.index, told.text) == (index, "a.mp4: its sidecar .label.json: has no frame 3")
    assert not at.passed_over
    counters = at.broker.counters
    assert (counters.unavailable, counters.refused_candidates) == (1, 0)


def test_a_worker_cannot_name_a_sidecar_that_the_lease_has_not(at: Peers) -> None:
    hello(at, ("voxels",))
    at.want(0)
    video_of = at.leases[b"w1"][0].video
    at.fail(b"w1", "cut short", 7, sidecar=ENDING)
    assert [refusal.video for refusal in at.passed_over] == [video_of]
