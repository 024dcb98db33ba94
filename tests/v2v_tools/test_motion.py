"""The whole picture of a clip, and seeds whose cameras look where something moves."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.clips import panned_luma, write_clip
from tests.oracles.decoded import stream_luma
from v2v_pictures.camera import Camera
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.scenes.picture_check import BARS, COMBED, CUTS, DUPLICATES, FADES, Defect
from v2v_server.motion.measure import MeasuredMotion
from v2v_server.simulation import simulate
from v2v_server.video.rows import Rows
from v2v_tools import motion
from v2v_tools import preview as command
from v2v_tools.motion import (
    WholePictures,
    describe_motion,
    describe_start,
    moving_seeds,
    noise_rate,
    quiet_voxels,
    start_events,
)
from v2v_tools.remake import Remaker
from v2v_tools.tradeoff import command as tradeoff

RECIPE = {"voxels_per_clip": 3, "bins": 2, "crop_height_px": 48, "crop_width_px": 48, "frame_stride": 2}


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    """One clip of 160 x 96: the right 64 columns move."""
    folder = tmp_path_factory.mktemp("half")
    luma = np.full((14, 96, 160), 120, np.uint8)
    luma[:, :, 96:] = panned_luma(14, 96, 64)
    write_clip(folder / "half.mkv", luma, codec="ffv1", pixel_format="gray")
    catalogue = open_catalogue(folder, rows=Rows.parse("full"), cache_dir=folder / "cache")
    yield catalogue
    catalogue.close()


def stream(**recipe: Any) -> StreamSpec:
    return StreamSpec.from_dict({"recipe": RECIPE | recipe})


def test_the_whole_picture_is_simulated_small_and_without_noise(
    corpus: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = stream(noise_sigma=[0.1, 0.1], pause_probability=0.5, threshold=[2.0, 2.0], shot_noise_hz=[5.0, 5.0])
    job = Remaker(corpus, spec).job(0, 0, 0)
    whole = WholePictures(corpus).camera(job)
    assert whole.voxels.shape == (3, 2, 96, 160)
    assert not whole.voxels[..., :95].any()
    assert whole.voxels[..., 96:].any()
    path, index = corpus.path("half.mkv"), corpus.frame_index("half.mkv")
    frames = np.stack(list(stream_luma(path, index, job.clip.start_frame, 13)))[::2]
    assert np.array_equal(whole.voxels, simulate(frames, threshold_pos=0.2, threshold_neg=0.2, bins=2).voxels)
    monkeypatch.setattr(motion, "LONGEST_SIDE_PX", 80)
    assert WholePictures(corpus).camera(job).voxels.shape == (3, 2, 48, 80)


def test_seeds_are_chosen_whose_crops_show_motion(corpus: Catalogue) -> None:
    spec = stream(threshold=[0.1, 0.2], noise_sigma=[0.0, 0.01])
    remaker = Remaker(corpus, spec)
    seeds, moving = moving_seeds(remaker, WholePictures(corpus), 3)
    assert (len(set(seeds)), moving) == (3, 3)
    assert seeds == sorted(seeds)
    lefts = [remaker.sample(seed, 0, 0).provenance.params.crop_left_px for seed in seeds]
    assert min(lefts) > 96 - 48 + 12  # more than a quarter of the crop moves
    assert seeds == moving_seeds(remaker, WholePictures(corpus), 3)[0]


def test_seeds_are_counted_where_nothing_can_be_read(corpus: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_arguments: object) -> Camera:
        raise motion.VideoError("half.mkv", 3, "is damaged")

    monkeypatch.setattr(WholePictures, "camera", broken)
    spec = stream()
    assert moving_seeds(Remaker(corpus, spec), WholePictures(corpus), 3) == ([0, 1, 2], 0)


def test_a_noisy_camera_counts_as_one_that_sees_no_motion(corpus: Catalogue) -> None:
    spec = stream(threshold=[0.1, 0.1], noise_sigma=[5.0, 5.0])
    assert moving_seeds(Remaker(corpus, spec), WholePictures(corpus), 2)[1] == 0


@pytest.mark.parametrize("arrays", [("voxels", "frames"), ("voxels", "frames", "flow")])
def test_a_sample_without_its_noise_is_the_same_camera(corpus: Catalogue, arrays: tuple[str, ...]) -> None:
    """The same bytes as a recipe that has no noise gives, from the frames that were decoded for the loud one."""
    loud = {"noise_sigma": [0.1, 0.1], "hot_pixel_share": [0.01, 0.01], "leak_hz": [3.0, 3.0]}
    made = Remaker(corpus, stream(**loud), arrays).made(3, 0, 0)
    quiet = Remaker(corpus, stream(noise_sigma=[0.0, 0.0], hot_pixel_share=[0.0, 0.0])).sample(3, 0, 0)
    assert np.array_equal(quiet_voxels(made), quiet.arrays["voxels"])
    assert not np.array_equal(made.sample.arrays["voxels"], quiet.arrays["voxels"])


@pytest.mark.parametrize(("sigma", "threshold"), [(0.02, 0.2), (0.1, 0.2), (0.3, 0.2)])
def test_the_rate_of_noise_is_estimated_to_a_factor_of_two(corpus: Catalogue, sigma: float, threshold: float) -> None:
    params = Remaker(corpus, stream()).sample(0, 0, 0).provenance.params
    params = dataclasses.replace(
        params, threshold_pos=threshold, threshold_neg=threshold, noise_sigma=sigma, effects={}, hot_pixel_count=0
    )
    still = np.full((401, 32, 32), 90, np.uint8)
    made = simulate(still, threshold_pos=threshold, threshold_neg=threshold, noise_sigma=sigma, seed=1, bins=100)
    rate = float(np.abs(made.voxels[1:].astype(int)).mean())
    assert rate / 2 < noise_rate(params, 0.0) < 2 * rate
    assert noise_rate(dataclasses.replace(params, noise_sigma=0.0, effects={"leak_hz": 3.0}), 0.5) == 1.5


def _drawn(clip: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, *flags: str) -> tuple[list[Camera], Camera]:
    """Return the cameras and the whole picture of a preview."""
    seen: list[Camera] = []
    wholes: list[Camera] = []

    def keep(shown: list[Camera], title: str, *, moments: int, whole: Camera) -> npt.NDArray[np.uint8]:
        seen.extend(shown)
        wholes.append(whole)
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr("v2v_tools.preview.draw_sheet", keep)
    sets = [f"--set={name}={value}" for name, value in RECIPE.items()]
    out = ["--out", str(folder / "p.png"), "--cache-dir", str(folder), "--no-flow"]
    assert command.main([str(clip), *out, *sets, *flags]) == 0
    return seen, wholes[0]


def test_a_seed_that_is_given_is_kept(corpus: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = corpus.path("half.mkv")
    seen, whole = _drawn(clip, tmp_path, monkeypatch, "--seed=5", "--seeds=2")
    assert [camera.provenance.id.seed for camera in seen] == [5, 6]
    assert whole.voxels.shape[2:] == (96, 160)
    chosen, _ = _drawn(clip, tmp_path, monkeypatch, "--seeds=2", "--set=threshold=[0.1,0.2]")
    assert all(camera.provenance.params.crop_left_px > 60 for camera in chosen)


def test_the_share_of_noise_is_measured(corpus: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = np.full((14, 96, 160), 90, np.uint8)
    write_clip(tmp_path / "still.mkv", still, codec="ffv1", pixel_format="gray")
    for clip, flags, share in (
        (corpus.path("half.mkv"), ("--recipe=noise-free", "--set=threshold=0.1"), 0.0),
        (tmp_path / "still.mkv", ("--seed=0", "--set=noise_sigma=0.3", "--set=pause_probability=0"), 1.0),
    ):
        shown, _ = _drawn(clip, tmp_path, monkeypatch, *flags)
        assert shown[0].noise_share([0, 1, 2]) == share


def test_the_start_makes_the_events_of_a_still_clip_and_none_if_it_is_zero(tmp_path: Path) -> None:
    """Where levels waver by one, only residuals near a threshold cross it: those that a start puts there."""
    frames = np.full((22, 64, 64), 60, np.uint8)
    frames[1::2] = 61
    write_clip(tmp_path / "still.mkv", frames, codec="ffv1", pixel_format="gray")
    catalogue = open_catalogue(tmp_path, rows=Rows.parse("full"), cache_dir=tmp_path / "cache")
    size = {"voxels_per_clip": 2, "bins": 2, "crop_height_px": 32, "crop_width_px": 32, "threshold": 0.2}
    shares = {}
    for start in ("uniform", "triangular", "zero"):
        spec = StreamSpec.from_dict({"recipe": {**size, "start": start}})
        shares[start] = start_events(Remaker(catalogue, spec).made(0, 0, 0))
    warm = Remaker(catalogue, StreamSpec.from_dict({"recipe": {**size, "start": "frames"}}))
    samples = [warm.made(0, 0, index) for index in range(warm.count)]
    for sample in samples:  # frames before the clip wavered too, so these residuals have crossed already
        assert (start_events(sample)[0] == 0) == (sample.sample.provenance.run_in == 5)
    assert {sample.sample.provenance.run_in for sample in samples} == {0, 5}
    catalogue.close()
    assert shares["uniform"][0] > 3 * shares["triangular"][0] > 0
    assert all(events[1] == 0 for events in shares.values())
    assert "makes 100% of its events" in describe_start(shares["uniform"])
    assert "makes 0% of its events" in describe_start(shares["zero"])


QUIET = MeasuredMotion(
    changed=1000, lost=30, uncovered=120, paired=100, turned=7, speeds=(0,) * 4 + (600,) + (0,) * 252
)
TOLD = "tells the error without and with sub-steps"
FAST = QUIET._replace(speeds=(0,) * 12 + (500,) + (0,) * 7 + (100,) + (0,) * 236)
SMALL = FAST._replace(lost=210)


@pytest.mark.parametrize(
    ("found", "numbers", "change"),
    [
        (MeasuredMotion(), ("0 px", "0 px", "0%", "0%", "0%"), ""),
        (QUIET, ("1 px", "1 px", "7%", "12%", "3%"), ""),
        (FAST, ("3 px", "5 px", "7%", "12%", "3%"), f"{motion.JUDGE} {TOLD}"),
        (SMALL, ("3 px", "5 px", "7%", "12%", "21%"), "something small or fast moves, or flickers, or is noise: "
         "sub-steps do not help"),
    ],
)  # fmt: skip
def test_what_moves_is_said_in_words(found: MeasuredMotion, numbers: tuple[str, ...], change: str) -> None:
    text = (
        "{} a frame where something moves ({} and more in the fastest tenth), {} of it turns back from frame to frame; "
        "of the pixels that change, {} are uncovered background, and no block follows {}"
    )
    assert describe_motion(found) == (text.format(*numbers), change)


def test_the_command_that_is_named_can_be_typed() -> None:
    name, *arguments = shlex.split(motion.JUDGE)
    parser = tradeoff._parser()
    assert parser.prog == name
    assert parser.parse_args(arguments).vary == ["substep_px=0,1"]


@pytest.mark.parametrize(("kind", "lost", "hidden"), [
    (CUTS, 0, False), (CUTS, 500, True), (FADES, 500, True), (DUPLICATES, 0, True), (COMBED, 0, True),
    (BARS, 500, False),
])  # fmt: skip
def test_defects_are_named_in_place_of_motion_where_they_are_what_changes(kind: str, lost: int, hidden: bool) -> None:
    text, change = describe_motion(FAST._replace(lost=lost), [Defect(kind, ((0, 2),), 10, "some frames")])
    assert text.startswith("changes that motion does not explain: some frames: ") == hidden
    assert bool(change) != hidden
