"""Defects made from clean clips are found after coding; clean clips have none."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from skimage import data

from tests.clips import panned_luma, write_clip
from tests.oracles.decoded import stream_luma
from v2v_protocol.errors import VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.scenes import picture_check
from v2v_server.corpus.scenes.analysis import analyse
from v2v_server.corpus.scenes.picture_check import (
    BARS,
    BLACK,
    COMBED,
    CUTS,
    DUPLICATES,
    FADES,
    NOISY,
    STILL,
    WHITE,
    Defect,
    check_in_background,
    defects_of,
)  # fmt: skip
from v2v_server.corpus.scenes.scene import Sides
from v2v_server.video.probe import probe

HEIGHT, WIDTH, FRAMES = 144, 208, 96
FOLDER = Path(os.environ.get("V2V_TEST_VIDEOS", Path(__file__).parents[5] / "shared" / "data" / "videos"))
Film = npt.NDArray[np.uint8]

BIT_RATES = {"fine": ({"crf": "20"}, 3), "coarse": ({"crf": "36"}, 0)}
"""Options of the encoder, and B-frames. Weighted B-frames of few bits blend a repeated frame with its neighbours."""


@cache
def film(photograph: str = "camera", frames: int = FRAMES, noise: float = 0.0, pace: int = 1) -> Film:
    """Return a window that winds over a photograph by up to 3 px a frame, times ``pace``."""
    picture = np.asarray(getattr(data, photograph)(), np.float32)
    picture = picture.mean(axis=2) if picture.ndim == 3 else picture
    room = np.array(picture.shape) - (HEIGHT, WIDTH)
    angle = np.arange(frames)[:, None] * pace * np.array([0.012, 0.02]) + (0.2, 0.9)
    corners = room / 2 + room / 2.2 * np.sin(angle)
    moved = [
        cv2.warpAffine(picture, np.array([[1, 0, -left], [0, 1, -top]], np.float32), (WIDTH, HEIGHT))
        for top, left in corners
    ]
    noisy = np.array(moved) + noise * np.random.default_rng(1).standard_normal((frames, HEIGHT, WIDTH))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def found(luma: Film, folder: Path, rate: str) -> dict[str, Defect]:
    options, b_frames = BIT_RATES[rate]
    path = write_clip(
        folder / "clip.mp4", luma, gop=48, b_frames=b_frames, options={**options, "preset": "veryfast"}, full_range=True
    )
    scene = analyse(stream_luma(path, probe(path).index, 0, len(luma)))
    assert scene.end == len(luma)
    return {defect.kind: defect for defect in defects_of(scene)}


def repeated(luma: Film, source: Callable[[int], int]) -> Film:
    return luma[[source(at) for at in range(len(luma))]]


def boxed(luma: Film, sides: Sides) -> Film:
    box = np.zeros_like(luma)
    box[:, sides.top : HEIGHT - sides.bottom, sides.left : WIDTH - sides.right] = luma[
        :, sides.top : HEIGHT - sides.bottom, sides.left : WIDTH - sides.right
    ]
    return box


@pytest.mark.parametrize("rate", BIT_RATES)
@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize("photograph", ["camera", "coffee"])
def test_clean_clips_have_no_defects(photograph: str, noise: float, rate: str, tmp_path: Path) -> None:
    assert found(film(photograph, noise=noise), tmp_path, rate) == {}


@pytest.mark.parametrize(("rate", "noise"), [("fine", 3.0), ("coarse", 0.0)])  # few bits leave no noise
@pytest.mark.parametrize(
    ("source", "name", "per_mille"),
    [
        (lambda at: at * 4 // 5, "24 in 30", 200),
        (lambda at: at * 2 // 5, "24 in 60, 3:2 pulldown", 600),
        (lambda at: at // 2, "every picture twice", 500),
        (lambda at: at // 3, "2 of every 3", 667),
    ],
)
def test_duplicated_frames_and_their_pattern(
    source: Callable[[int], int], name: str, per_mille: int, noise: float, rate: str, tmp_path: Path
) -> None:
    defects = found(repeated(film(noise=noise), source), tmp_path, rate)
    assert set(defects) == {DUPLICATES}
    assert name in defects[DUPLICATES].text
    assert abs(defects[DUPLICATES].per_mille - per_mille) < 40


def test_few_irregular_repeats_are_found_at_their_places(tmp_path: Path) -> None:
    places = (9, 26, 31, 55, 78)
    defects = found(repeated(film(), lambda at: at - (at in places)), tmp_path, "fine")
    assert defects[DUPLICATES].spans == tuple((at - 1, at + 1) for at in places)
    assert "no regular pattern" in defects[DUPLICATES].text
    assert defects[DUPLICATES].touches(8, 10)
    assert not defects[DUPLICATES].touches(9, 25)  # only one frame of each pair


@pytest.mark.parametrize(
    ("sides", "rate"),
    [
        (Sides(18, 18, 0, 0), "fine"),
        (Sides(0, 0, 26, 26), "coarse"),
        (Sides(8, 0, 0, 0), "coarse"),
        (Sides(0, 0, 0, 11), "fine"),
        *((Sides(10, 12, 20, 22), rate) for rate in BIT_RATES),
    ],
)
def test_bars_on_each_side(sides: Sides, rate: str, tmp_path: Path) -> None:
    defects = found(boxed(film("coffee"), sides), tmp_path, rate)
    assert set(defects) == {BARS}
    measured = defects[BARS].sides
    assert measured is not None
    for name in ("top", "bottom", "left", "right"):
        assert abs(getattr(measured, name) - getattr(sides, name)) <= 2


@pytest.mark.parametrize("rate", BIT_RATES)
def test_cuts(rate: str, tmp_path: Path) -> None:
    luma = np.concatenate((film()[:40], film("coffee")[:30], film("brick")[:26]))
    defects = found(luma, tmp_path, rate)
    assert set(defects) == {CUTS}
    assert defects[CUTS].spans == ((39, 41), (69, 71))
    assert defects[CUTS].touches(30, 41)
    assert not defects[CUTS].touches(40, 70)  # a sequence may begin at a cut and end before the next


def test_fast_motion_with_repeats_makes_no_cuts() -> None:
    """Half of the steps are still, so the others stand out from the median."""
    defects = defects_of(analyse(repeated(film(pace=4), lambda at: at // 2)))
    assert [defect.kind for defect in defects] == [DUPLICATES]


@pytest.mark.parametrize(("rate", "noise"), [("fine", 1.0), ("coarse", 0.0)])
def test_still_stretches(noise: float, rate: str, tmp_path: Path) -> None:
    moving = film(frames=FRAMES)
    luma = repeated(moving, lambda at: min(at, 30) if at < 70 else at - 40)
    luma = np.clip(luma + noise * np.random.default_rng(2).standard_normal(luma.shape), 0, 255).astype(np.uint8)
    defects = found(luma, tmp_path, rate)
    assert set(defects) == {STILL}
    (span,) = defects[STILL].spans
    assert 30 <= span[0] <= 42
    assert 68 <= span[1] <= 72


@pytest.mark.parametrize("rate", BIT_RATES)
def test_black_stretches(rate: str, tmp_path: Path) -> None:
    luma = film().copy()
    luma[40:60] = 2
    defects = found(luma, tmp_path, rate)
    assert {BLACK} <= set(defects) <= {BLACK, CUTS}
    assert defects[BLACK].spans == ((40, 60),)


@pytest.mark.parametrize("rate", BIT_RATES)
@pytest.mark.parametrize("frames", [12, 40])
def test_fades_to_and_from_black(frames: int, rate: str, tmp_path: Path) -> None:
    gain = np.interp(np.arange(FRAMES), (44 - frames, 44, 50, 50 + frames), (1, 0, 0, 1))[:, None, None]
    defects = found(np.rint(film() * gain).astype(np.uint8), tmp_path, rate)
    assert {FADES} <= set(defects) <= {FADES, BLACK}
    (out, _), (_, back) = defects[FADES].spans[0], defects[FADES].spans[-1]
    assert abs(out - (44 - frames)) <= 4
    assert abs(back - (50 + frames)) <= 4


@pytest.mark.parametrize("rate", BIT_RATES)
def test_combing_is_found_where_something_moves(rate: str, tmp_path: Path) -> None:
    moving = film(frames=2 * FRAMES)
    woven = moving[::2].copy()
    woven[:, 1::2] = moving[1::2, 1::2]
    defects = found(woven, tmp_path, rate)
    assert set(defects) == {COMBED}
    assert defects[COMBED].per_mille > 700


def test_white_and_noisy_stretches() -> None:
    luma = film().copy()
    luma[20:40] = 250
    noise = 2.0 * np.random.default_rng(3).standard_normal(luma[:40].shape)
    luma[56:] = np.clip(np.rint(luma[56] + noise), 0, 255)
    defects = {defect.kind: defect for defect in defects_of(analyse(luma))}
    assert {WHITE, NOISY, STILL} <= set(defects) <= {WHITE, NOISY, STILL, CUTS}
    assert defects[WHITE].spans == ((20, 40),)
    assert defects[NOISY].spans[-1][1] == FRAMES


def test_frames_without_anything_to_compare() -> None:
    for luma in (film()[:0], film()[:1], np.zeros((3, 5, 6), np.uint8)):
        assert defects_of(analyse(luma)) == ()


TRUE_DEFECTS = {
    ("intel_one-by-one-person.mp4", STILL),
    ("lerobot_chess_av1.mp4", CUTS),
    ("lerobot_chess_av1.mp4", DUPLICATES),
    ("lerobot_chess_av1.mp4", STILL),
    ("sleap_small_robot.mp4", STILL),
}
"""Verified by eye: an empty room; a camera that repeats a third of its frames and jumps; two robots that pause."""


@pytest.mark.slow
@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no {FOLDER}; set V2V_TEST_VIDEOS")
def test_false_alarms_on_real_clips() -> None:
    said = set()
    for path in sorted(FOLDER.iterdir()):
        try:
            index = probe(path).index
            count = min(len(index), 160)
            defects = defects_of(analyse(stream_luma(path, index, (len(index) - count) // 2, count)))
        except VideoError:
            continue  # damaged on purpose
        said |= {(path.name, defect.kind) for defect in defects}
    assert len(said - TRUE_DEFECTS) <= 2, said
    assert ("lerobot_chess_av1.mp4", DUPLICATES) in said


@pytest.mark.parametrize("ends_first", [False, True])
def test_a_server_says_once_which_share_of_its_sequences_has_defects(
    ends_first: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(picture_check, "_SERVER_WAITS_SECONDS", 0.0)
    moving = panned_luma(60, 96, 128)
    for name, luma in {"clean": moving, "twos": moving[np.arange(60) // 2]}.items():
        write_clip(tmp_path / f"{name}.mkv", luma, codec="ffv1", pixel_format="gray", full_range=True)
    spec = StreamSpec(recipe=Recipe(voxels_per_clip=1, bins=29, crop_height_px=32, crop_width_px=32))
    said, stop = list[str](), threading.Event()
    with closing(open_catalogue(tmp_path, cache_dir=tmp_path / "index", processes=0)) as catalogue:
        if ends_first:
            stop.set()
        thread = check_in_background(catalogue, spec, stop, said.append, processes=0)
        assert thread is not None
        thread.join(60)
        assert not thread.is_alive()
    expected = (
        "pictures: of 4 sequences of 2 videos, 50% have duplicated frames: --scene auto leaves these out; "
        "v2v-doctor --videos names the videos"
    )
    assert said == ([] if ends_first else [expected])
