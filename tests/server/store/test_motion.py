"""Motion is the same from the source, from stores and from caches, with and without a plane of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.oracles.leases import open_leases
from tests.server.prepare.test_prepare import run
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server import motion
from v2v_server.corpus.sources.folder import Folder
from v2v_server.store.cache import Cache, make_cache
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import decode_for

ROWS, PLANES = "top:0.9", ("motion",)
RECIPE = Recipe(
    voxels_per_clip=3, bins=3, crop_height_px=26, crop_width_px=32, resize_scale=(0.7, 1.3), pause_probability=0.5
)
SPECS = [
    StreamSpec(recipe=RECIPE.replace(resize_scale=(1.0, 1.0)), substep_px=0.5, samples_per_decode=2, sibling_spacing=1),
    StreamSpec(recipe=RECIPE, substep_px=1.0),
    StreamSpec(recipe=RECIPE.replace(frame_stride=2, voxels_per_clip=2), substep_px=0.5),
]


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("v2v_server.store.cache.piece_frames", lambda rows, width_px: 7)
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "index"))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("motion")
    write_clip(folder / "source" / "turned.mov", panned_luma(40, 60, 80), rotation_degrees=90, b_frames=2)
    assert run(folder / "source", folder / "plain", rows=ROWS).complete
    assert run(folder / "source", folder / "planes", rows=ROWS, planes=PLANES).complete
    return {name: folder / name for name in ("source", "plain", "planes")}


def samples(videos: Path, spec: StreamSpec, cache: Cache | None = None, count: int = 5) -> list[Sample]:
    found = []
    with open_leases(videos, ROWS, spec) as (root, leases):
        for lease in islice(leases, count):
            job = SampleJob.of(replace(lease, arrays=("voxels", "event_counts")))
            all_decoded = decode_for(job.clip, lease.indices, Folder(root), cache)
            for index, decoded in zip(lease.indices, all_decoded, strict=True):
                found.append(make_sample(replace(job, index=index), decoded))
    return found


def require_equal(found: list[Sample], expected: list[Sample]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert one.provenance.params == other.provenance.params
        for name, array in other.arrays.items():
            np.testing.assert_array_equal(one.arrays[name], array, err_msg=name)


@pytest.mark.parametrize("spec", SPECS, ids=["siblings", "resized", "stride"])
def test_samples_with_sub_steps_are_those_of_the_source(
    folders: dict[str, Path], spec: StreamSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = samples(folders["source"], spec)
    plain = samples(folders["source"], replace(spec, substep_px=0.0))
    assert any(not np.array_equal(a.arrays["voxels"], b.arrays["voxels"]) for a, b in zip(expected, plain, strict=True))
    assert {sample.provenance.params.flip for sample in expected} == {False, True}
    require_equal(samples(folders["plain"], spec), expected)
    make_cache(tmp_path / "cache")
    cache = Cache(tmp_path / "cache", 1 << 30, 0)
    samples(folders["source"], replace(spec, substep_px=0.0), cache)
    full = Cache(tmp_path / "cache", 1, 0)
    require_equal(samples(folders["source"], spec, full), expected)  # from pieces that cannot get the motion
    require_equal(samples(folders["source"], spec, cache), expected)
    if spec.recipe.frame_stride == 1:
        monkeypatch.delattr(motion.MotionOfCuts, "add")  # the motion is read
    require_equal(samples(folders["source"], spec, cache), expected)
    require_equal(samples(folders["planes"], spec), expected)


@pytest.mark.parametrize("flow", [False, True])
def test_where_nothing_moves_no_margin_is_read_for_sub_steps(tmp_path: Path, flow: bool) -> None:
    write_clip(tmp_path / "source" / "still.mp4", np.repeat(panned_luma(1, 80, 90), 20, axis=0))
    assert run(tmp_path / "source", tmp_path / "planes", rows=ROWS, planes=PLANES).complete
    spec = StreamSpec(recipe=RECIPE.replace(resize_scale=(1.0, 1.0)), substep_px=0.5, flow_margin_px=4)
    made = []
    for folder in ("source", "planes"):
        with open_leases(tmp_path / folder, ROWS, spec) as (root, leases):
            job = SampleJob.of(replace(next(leases), arrays=("voxels", "flow") if flow else ("voxels",)))
            (decoded,) = decode_for(job.clip, [job.index], Folder(root))
            made.append((decoded.clip.frames.shape[1:], make_sample(job, decoded)))
    ((around, expected), (read, found)) = made
    require_equal([found], [expected])
    assert read[0] - 26 <= (8 if flow else 0) < around[0] - 26
    assert read[1] - 32 <= (8 if flow else 0) < around[1] - 32
