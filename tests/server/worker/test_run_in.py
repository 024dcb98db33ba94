"""Samples whose pixels start from frames before the clip: they equal the end of a longer sample, and say so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from tests.digests.clips import write_photographs
from tests.oracles.noise import start_uniforms
from tests.pieces import pieces, shots
from tests.server.simulation import reference
from tests.server.simulation.test_effects import params_of
from tests.server.simulation.test_pixel import moving_frames
from v2v_protocol.recipe import FRAMES, Recipe, preset
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.scenes.scene import COLUMNS, Flag, Scene, frames_before
from v2v_server.kinds.photographs import KIND as PHOTOGRAPHS
from v2v_server.schedule import VideoSequence
from v2v_server.simulation.clip import RunIn, simulate_clip
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.kernels import list_events
from v2v_server.simulation.pixel import triangular
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import decode_for
from v2v_server.worker.scene_choice import CleanFrames
from v2v_tools.remake import lease_for

SIZE = {"crop_height_px": 16, "crop_width_px": 20, "pause_probability": 0.0}
FRAME_BY_FRAME = {**SIZE, "bins": 1, "frames_per_bin": 1, "threshold": (0.1, 0.2)}
ALTERNATING = {
    "preset": "davis346-measured", "shot_noise_hz": 0.0, "noise_band_share": (0.08, 0.25), "noise_band_hz": (15.0, 60.0)
}  # fmt: skip
ARRAYS = ("voxels", "event_counts", "frames")


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    folder = tmp_path_factory.mktemp("videos")
    write_clip(folder / "a.mp4", panned_luma(60, 32, 40), gop=12)
    write_clip(folder / "quick.mp4", panned_luma(60, 32, 40), gop=12, rate=100)
    with closing(open_catalogue(folder, cache_dir=folder / "index", processes=0)) as opened:
        yield opened


def made(
    catalogue: Catalogue, start: int, recipe: Recipe, video: str = "a.mp4", arrays: tuple[str, ...] = ARRAYS
) -> Sample:
    """Make a sample of the clip that begins at a frame."""
    entry = next(each for each in catalogue.videos if each.id == video)
    lease = lease_for(
        Request(b"", 1, 5), sequence=VideoSequence(entry, start), catalogue=catalogue, spec=StreamSpec(recipe=recipe),
        seed=3, arrays=arrays,
    )  # fmt: skip
    job = SampleJob.of(lease)
    return make_sample(job, decode_for(job.clip, [job.index], catalogue.source)[0])


@pytest.mark.parametrize(
    ("fields", "start", "run_in"),
    [
        ({"preset": "paper"}, 20, 5),
        (ALTERNATING, 20, 5),
        (ALTERNATING | {"frame_stride": 3, "grids_per_frame": 1}, 15, 5),
        ({"preset": "paper", "noise_unit": "second", "resize_scale": (0.6, 0.9)}, 5, 5),
    ],
)
def test_a_sample_is_the_end_of_a_longer_one(
    catalogue: Catalogue, fields: dict[str, Any], start: int, run_in: int
) -> None:
    """Noise and all: its words are counted from the first frame that is simulated."""
    recipe = Recipe.from_dict({**FRAME_BY_FRAME, "voxels_per_clip": 4, **fields, "start": FRAMES})
    short = made(catalogue, start, recipe)
    longer = recipe.replace(start="triangular", voxels_per_clip=4 + run_in)
    long = made(catalogue, start - run_in * recipe.frame_stride, longer)
    assert short.provenance.run_in == run_in
    assert long.provenance.run_in is None
    assert np.abs(short.arrays["voxels"]).sum() > 100
    for name, array in short.arrays.items():
        np.testing.assert_array_equal(array, long.arrays[name][run_in:], name)
    cold = made(catalogue, start, recipe.replace(start="triangular"))
    assert (cold.arrays["voxels"][0] != short.arrays["voxels"][0]).any()
    np.testing.assert_array_equal(cold.arrays["frames"], short.arrays["frames"])


@pytest.mark.parametrize(
    ("video", "start", "stride", "run_in"),
    [
        ("a.mp4", 4, 1, 0), ("a.mp4", 5, 1, 5), ("a.mp4", 9, 2, 0), ("a.mp4", 10, 2, 5),
        ("quick.mp4", 14, 1, 0), ("quick.mp4", 15, 1, 15), ("quick.mp4", 16, 2, 8),
    ],
)  # fmt: skip
def test_too_few_frames_make_a_triangular_start_and_the_provenance_says_so(
    catalogue: Catalogue, video: str, start: int, stride: int, run_in: int
) -> None:
    recipe = Recipe(**SIZE, voxels_per_clip=2, bins=3, frame_stride=stride, start=FRAMES)
    sample, triangular = (made(catalogue, start, recipe.replace(start=law), video) for law in (FRAMES, "triangular"))
    assert (sample.provenance.run_in, sample.provenance.start_frame) == (run_in, start)
    assert np.array_equal(sample.arrays["voxels"], triangular.arrays["voxels"]) == (run_in == 0)
    np.testing.assert_array_equal(sample.arrays["frames"], triangular.arrays["frames"])


@pytest.mark.parametrize("fields", [{"voxel_seconds": 0.1}, {"grids_per_frame": 2}, {"pause_probability": 0.5}])
def test_what_a_sample_shows_does_not_depend_on_its_start(catalogue: Catalogue, fields: dict[str, Any]) -> None:
    recipe = Recipe.from_dict({**SIZE, "voxels_per_clip": 2, "bins": 2, "threshold": 0.1, **fields, "start": FRAMES})
    arrays = (*ARRAYS, "flow", "voxels_bilinear", "time_surface")
    warm, cold = (made(catalogue, 12, recipe.replace(start=law), arrays=arrays) for law in (FRAMES, "triangular"))
    assert warm.provenance.params == cold.provenance.params
    for name in ("frames", "flow"):
        np.testing.assert_array_equal(warm.arrays[name], cold.arrays[name])
    assert (warm.arrays["voxels"][0] != cold.arrays["voxels"][0]).any()
    counts = warm.arrays["event_counts"].astype(int)
    np.testing.assert_array_equal(counts[:, 1] - counts[:, 0], warm.arrays["voxels"])


def test_a_world_has_a_past_before_its_first_frame(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos")
    recipe = preset("worlds").replace(**SIZE, voxels_per_clip=2, bins=3, threshold=(0.1, 0.1))
    arrays = ("voxels", "frames", "flow", "flow_valid", "masks", "tracks")
    with closing(open_catalogue(tmp_path / "photos", cache_dir=tmp_path, kind=PHOTOGRAPHS, processes=0)) as opened:
        video = opened.videos[0].id
        for start in (0, 12):
            warm, cold = (
                made(opened, start, recipe.replace(start=law), video, arrays) for law in (FRAMES, "triangular")
            )
            assert warm.provenance.run_in == 9  # 0.15 s at 60 Hz
            for name in arrays[1:]:
                np.testing.assert_array_equal(warm.arrays[name], cold.arrays[name], name)
            assert (warm.arrays["voxels"][0] != cold.arrays["voxels"][0]).any()


# --- the kernel -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["int8", "float32"])
def test_the_kernel_equals_the_slow_one(dtype: str) -> None:
    """The paper's pixel and its noise, over both parts in one run, but from the uniform law at its beginning."""
    run_in, recipe = 7, Recipe(voxels_per_clip=3, bins=2, crop_height_px=21, crop_width_px=33, noise_unit="second")
    steps, frames = run_in + recipe.steps, moving_frames(run_in + recipe.steps + 1, 21, 33)
    params = replace(params_of({}, noise_sigma=0.2, hot_pixel_count=6, hot_pixel_sigma=3.0), pauses=())
    seconds = np.linspace(0.01, 0.3, steps)
    before = RunIn(frames[: run_in + 1], seconds[:run_in])
    got = simulate_clip(frames[run_in:], params, recipe.replace(start=FRAMES), dtype, seconds[run_in:], run_in=before)
    uniform = start_uniforms(params.noise_key, 21 * 33).astype(np.float32)
    thresholds = np.float32(params.threshold_pos), np.float32(params.threshold_neg)
    expected, _ = reference.simulate(
        log_table(2.2, 1e-3)[frames.reshape(steps + 1, -1)], params.noise_key, threshold_pos=params.threshold_pos,
        threshold_neg=params.threshold_neg, noise_scale=0.2 * np.sqrt(seconds), hot_count=6, hot_sigma=3.0,
        hot_scale=seconds, frames_per_bin=1, dtype="float32",
        residual=np.array([triangular(each, *thresholds) for each in uniform], np.float32),
    )  # fmt: skip
    np.testing.assert_array_equal(got.voxels.reshape(recipe.steps, -1), expected[run_in:].astype(dtype))
    listed = list_events(got.given, got.real, np.full(recipe.steps, 1000.0))
    assert np.where(listed.p, 1, -1).sum() == expected[run_in:].sum()


# --- which frames -----------------------------------------------------------------------------------------------------


@given(data=st.data(), start=st.integers(0, 90), count=st.integers(1, 40))
def test_server_and_worker_choose_the_same_frames(data: st.DataObject, start: int, count: int) -> None:
    """A worker has the part of the scene that begins with the first frame that its server chose."""
    ends = sorted(data.draw(st.sets(st.integers(1, 63))) | {64})
    flags = [data.draw(st.sampled_from([0, Flag.CUT, Flag.REPEAT, Flag.REPEAT | Flag.CUT])) for _ in ends]
    scene = Scene.of(pieces(*zip(ends, flags, strict=True)), np.zeros((4, COLUMNS)))
    found = frames_before(scene, start, count, has_repeats=False)
    first = int(found[0]) if len(found) else 0
    part = Scene.from_bytes(scene.slice(first, start + 9 - first).to_bytes())
    np.testing.assert_array_equal(frames_before(part, start, count, has_repeats=False), found)
    shot = max((0, *(at for at in scene.shot_boundaries if at <= start)))
    usable = np.setdiff1d(np.arange(shot, start), scene.repeats)
    np.testing.assert_array_equal(found, usable[-count:] if len(usable) >= count else [])


@pytest.mark.parametrize(
    ("boundaries", "start", "stride", "before"),
    [
        ((), 4, 1, []),
        ((), 5, 1, [0, 1, 2, 3, 4]),
        ((), 12, 2, [2, 4, 6, 8, 10]),
        ((20,), 24, 1, []),
        ((20,), 25, 1, [20, 21, 22, 23, 24]),
        ((25,), 25, 1, []),
        ((26,), 25, 1, [20, 21, 22, 23, 24]),
    ],
)
def test_frames_before_a_clip_lie_in_its_shot(
    boundaries: tuple[int, ...], start: int, stride: int, before: list[int]
) -> None:
    recipe = Recipe(**SIZE, start=FRAMES, voxels_per_clip=1, bins=2, frame_stride=stride)
    scene, spec = Scene.of(shots(64, *boundaries), np.zeros((4, COLUMNS))), StreamSpec(recipe=recipe, scene="auto")
    found = CleanFrames.of(scene, start, spec, recipe.frames_needed, int(recipe.run_in_at(25.0)))
    assert (found.before.tolist(), found.stride) == (before, stride)
    assert found.count(3) == len(before) + 3


def test_repeated_frames_before_a_clip_are_left_out() -> None:
    recipe = Recipe(**SIZE, start=FRAMES, voxels_per_clip=1, bins=2)
    scene = Scene.of(pieces((10, 0), (12, Flag.REPEAT), (32, 0)), np.zeros((2, COLUMNS)))
    found = CleanFrames.of(scene, 14, StreamSpec(recipe=recipe, scene="auto"), 3, 5)
    assert found.before.tolist() == [7, 8, 9, 12, 13]
    assert (found.first, found.count(3)) == (7, 10)
    assert found.places(np.arange(3)).tolist() == [7, 8, 9]


@pytest.mark.parametrize(
    ("rate", "stride", "frames"), [(0.0, 1, 5), (25.0, 1, 5), (30.0, 4, 20), (60.0, 1, 9), (240.0, 1, 36), (100, 2, 16)]
)
def test_the_frames_before_a_clip_last_five_frames_and_a_seventh_of_a_second(
    rate: float, stride: int, frames: int
) -> None:
    recipe = Recipe(start=FRAMES, frame_stride=stride)
    assert recipe.run_in_at(rate) == frames
    assert recipe.replace(start="triangular").run_in_at(rate) == 0
    assert recipe.held_at(rate) == recipe.reach_at(rate) + frames
