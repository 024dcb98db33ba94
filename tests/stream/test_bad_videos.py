"""Videos that cannot give what they promised."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.store.test_verified import FORMS, Corpus
from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of, made_here
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import SampleUnavailable


@pytest.fixture(scope="module")
def one_worker(clips_with_a_broken_one: Path) -> Iterator[LocalServer]:
    """A server over good clips and a broken one."""
    with LocalServer(clips_with_a_broken_one, workers=1, flags=SMALL_FLAGS) as running:
        yield running


def test_the_next_candidate_is_served_and_marked(clips_with_a_broken_one: Path, one_worker: LocalServer) -> None:
    batches = [batch for epoch in range(2) for batch in epoch_of(one_worker.address, epoch=epoch)]
    again = made_here(clips_with_a_broken_one, 0, 1)
    refusals = [refusal for batch in batches for item in batch.provenance for refusal in item.refusals]
    assert refusals
    assert {refusal.video for refusal in refusals} == {"broken.mp4"}
    assert all(refusal.frame is not None and refusal.reason for refusal in refusals)
    assert [digest(batch) for batch in batches] == [digest(batch) for batch in again]


def test_a_consumer_may_want_to_be_told_instead(one_worker: LocalServer) -> None:
    with pytest.raises(SampleUnavailable, match=r"broken\.mp4 at frame"):
        _four_epochs(one_worker.address)


def _four_epochs(address: str) -> None:
    for epoch in range(4):
        list(V2VStreamDataset(address, batch_size=3, recipe=SMALL, seed=3, epoch=epoch, on_bad_video="raise"))


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_a_video_that_is_changed_in_place_is_refused_until_it_is_restored(
    compiled: None, tmp_path: Path, form: str
) -> None:
    """With a cache, which would keep wrong frames for good; another video stands in."""
    corpus = Corpus(tmp_path, form)
    other = corpus.root / ("b.avi" if form == "video" else "b")
    (shutil.copy if form == "video" else shutil.copytree)(next(corpus.root.iterdir()), other)
    flags = ("--videos-kind", "sequences", "--rate", "25") if corpus.kind.has_parts else ()
    flags = (*SMALL_FLAGS, *flags, "--cache-dir", str(tmp_path / "index"))

    def pixels(address: str) -> list[bytes]:
        return [batch.voxels.numpy().tobytes() + batch.frames.numpy().tobytes() for batch in epoch_of(address)]

    with LocalServer(corpus.root, workers=1, flags=flags) as running:
        right = pixels(running.address)
    with LocalServer(corpus.root, workers=1, flags=(*flags, "--cache", str(tmp_path / "cache"))) as running:
        corpus.change()
        batches = list(epoch_of(running.address))
        refusals = [refusal for batch in batches for item in batch.provenance for refusal in item.refusals]
        assert {refusal.video for refusal in refusals} == {"a.avi" if form == "video" else "a/"}
        assert all("changed since it was catalogued" in refusal.reason for refusal in refusals)
        corpus.restore()
        assert pixels(running.address) == right
        assert pixels(running.address) == right
