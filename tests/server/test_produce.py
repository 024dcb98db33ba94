"""From a lease to a sample: what may be wrong with a lease that a sound server sent."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.server.corpus import SMALL_SPEC
from v2v_protocol.errors import VideoError
from v2v_protocol.messages import Lease
from v2v_server.jobs import describe
from v2v_server.leases import Task
from v2v_server.produce import decode_for, make_sample
from v2v_server.schedule import Schedule
from v2v_server.sequences import SequenceTable
from v2v_server.video.catalogue import Catalogue, open_catalogue


@pytest.fixture
def catalogue(tmp_path: Path) -> Iterator[Catalogue]:
    write_clip(tmp_path / "a.mp4", panned_luma(30, 16, 24), gop=12)
    with closing(open_catalogue(tmp_path, processes=0)) as opened:
        yield opened


@pytest.fixture
def lease(catalogue: Catalogue) -> Lease:
    schedule = Schedule.of(SequenceTable(catalogue.videos, catalogue.rows, SMALL_SPEC), SMALL_SPEC)
    return describe(
        Task(b"", 0, 2),
        number=1,
        sequence=schedule.candidate(0, 0, 2, 0),
        quarantine=0,
        catalogue=catalogue,
        spec=SMALL_SPEC,
        seed=0,
        arrays=("voxels", "frames"),
        deadline_seconds=60.0,
    )


def test_a_whole_index_and_its_slice_make_the_same_sample(catalogue: Catalogue, lease: Lease) -> None:
    index = catalogue.frame_index("a.mp4")
    assert lease.frame_index == index.to_bytes()
    needed = SMALL_SPEC.recipe.frames_needed
    cut = dataclasses.replace(lease, frame_index=index.slice(lease.start_frame, needed).to_bytes())
    whole, part = (make_sample(each, decode_for(each, each.indices, catalogue.root)[0]) for each in (lease, cut))
    assert whole.provenance == part.provenance
    assert all(np.array_equal(array, part.arrays[name]) for name, array in whole.arrays.items())


@pytest.mark.parametrize("damage", ["garbage", "cut short", "too few frames"])
def test_a_damaged_index_costs_its_video_only(catalogue: Catalogue, lease: Lease, damage: str) -> None:
    """The server hands a small one on unopened."""
    index = catalogue.frame_index("a.mp4")
    damaged = {
        "garbage": b"no index",
        "cut short": index.to_bytes()[:-3],
        "too few frames": index.slice(0, lease.start_frame + 1).to_bytes(),
    }[damage]
    with pytest.raises(VideoError, match=r"^a\.mp4.*: the server's index of it is damaged: "):
        decode_for(dataclasses.replace(lease, frame_index=damaged), lease.indices, catalogue.root)
