"""Videos that cannot give what they promised, and what real footage brings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.stream.conftest import SMALL, SMALL_FLAGS, digest, epoch_of
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import SampleUnavailable
from v2v_protocol.recipe import Recipe

SHARED_VIDEOS = Path(__file__).parents[3] / "shared" / "data" / "videos"
CORRUPT = "decord_corrupted.mp4"


@pytest.fixture(scope="module")
def one_worker(clips_with_a_broken_one: Path) -> Iterator[LocalServer]:
    """A server over good clips and a broken one."""
    with LocalServer(clips_with_a_broken_one, workers=1, flags=SMALL_FLAGS) as running:
        yield running


def test_the_next_candidate_is_served_and_marked(clips_with_a_broken_one: Path, one_worker: LocalServer) -> None:
    with LocalServer(clips_with_a_broken_one, workers=2, flags=SMALL_FLAGS) as server:
        batches = [batch for epoch in range(4) for batch in epoch_of(server.address, epoch=epoch)]
    again = [batch for epoch in range(4) for batch in epoch_of(one_worker.address, epoch=epoch)]
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


@pytest.mark.skipif(not SHARED_VIDEOS.is_dir(), reason=f"needs the real clips in {SHARED_VIDEOS}")
@pytest.mark.slow
def test_every_real_clip_that_is_long_enough_is_served() -> None:
    recipe = Recipe(voxels_per_clip=5)
    long_enough = set(_long_enough(recipe.steps + 1))
    served: set[str] = set()
    refused: dict[str, str] = {}
    with LocalServer(SHARED_VIDEOS, workers=2) as server:
        dataset = V2VStreamDataset(server.address, batch_size=4, recipe=recipe, shuffle=False)
        for batch in dataset:
            for item in batch.provenance:
                served.add(item.video)
                refused |= {refusal.video: refusal.reason for refusal in item.refusals}
    assert long_enough - {CORRUPT} <= served
    assert set(refused) <= {CORRUPT}
    assert all(refused.values())


def _long_enough(frames: int) -> list[str]:
    manifest = (SHARED_VIDEOS.parent / "MANIFEST.tsv").read_text(encoding="utf-8").splitlines()
    header, *lines = (line.split("\t") for line in manifest)
    name, decoded = header.index("file"), header.index("frames_decoded")
    return [
        line[name].removeprefix("videos/")
        for line in lines
        if line[name].startswith("videos/") and int(line[decoded]) >= frames
    ]
