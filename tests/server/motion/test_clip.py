"""The levels of a clip: where they lie in time, and what they are worth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.oracles.rendered import Errors, counts_of, errors, log_levels, rendered_scene
from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import MARGIN_PX, MOST_SUBSTEPS
from v2v_server.motion import cells_of, levels_between, levels_of, motions, substeps
from v2v_server.motion.matching import UNITS_PER_PX
from v2v_server.simulation.draw import draw
from v2v_server.simulation.view import Window, apply_view, source_window, without_margin
from v2v_server.simulation.voxel import FINE_STEPS, Levels

HERTZ, THRESHOLD = 30.0, 0.2
RECIPE = Recipe(voxels_per_clip=1, bins=3, crop_height_px=40, crop_width_px=48, pause_probability=0.0)


def sub_steps(frames: np.ndarray, substep_px: float = 1.0) -> Levels | None:
    return levels_between(frames, (0, 0, *frames.shape[1:]), np.arange(len(frames)), substep_px, motions(frames))


def compared(name: str, px: float, side: int, bin_seconds: float, count: int = 5) -> tuple[Errors, Errors]:
    """Return the errors of frames alone and of frames with sub-steps of 1 px, at 30 frames a second."""
    scene = rendered_scene(name, side, side, px * HERTZ)
    seconds, edges = np.arange(count) / HERTZ, np.arange(0.0, (count - 1) / HERTZ + 1e-9, bin_seconds)
    true = scene.counts(edges, THRESHOLD, HERTZ * max(24, round(8 * px)))
    frames = scene.frames(HERTZ, count)
    light, levels = frames.reshape(count, -1) / 255.0, sub_steps(frames)
    linear = errors(counts_of(log_levels(light), seconds, edges, THRESHOLD), true)
    if levels is None:
        return linear, linear
    moments = np.concatenate([seconds, (levels.at.step + levels.at.share) / HERTZ])
    light = np.concatenate([light, levels.grey.reshape(len(levels.grey), -1) / (255.0 * FINE_STEPS)])
    order = np.argsort(moments)
    return linear, errors(counts_of(log_levels(light[order]), moments[order], edges, THRESHOLD), true)


def test_levels_lie_between_the_frames_of_steps_that_move() -> None:
    moving = rendered_scene("gravel", 64, 64, 3.5 * HERTZ).frames(HERTZ, 3)
    clip = np.stack([moving[0], moving[0], moving[1], moving[2]])
    vectors = motions(clip)[:, :, 2:12, 1:13]
    levels = levels_between(clip, (8, 4, 40, 48), np.array([0, 1, 2, 2, 3]), 1.0, vectors)
    assert levels is not None
    assert levels.at.step.tolist() == [1, 1, 1, 3, 3, 3]
    np.testing.assert_allclose(levels.at.share, [0.25, 0.5, 0.75] * 2)
    assert levels.grey.shape == (6, 40, 48)
    assert levels.grey.dtype == np.uint16


def test_the_number_of_sub_steps_follows_the_motion() -> None:
    def vectors(px: float, cells: int) -> np.ndarray:
        field = np.zeros((2, 16, 16), np.int16)
        field[0].reshape(-1)[:cells] = round(px * UNITS_PER_PX)
        return field

    assert [substeps(vectors(px, 256), 1.0) for px in (0.0, 0.9, 1.0, 1.9, 7.5, 500.0)] == [
        1,
        1,
        2,
        2,
        8,
        MOST_SUBSTEPS,
    ]
    assert [substeps(vectors(4.0, cells), 2.0) for cells in (0, 1, 2, 100)] == [1, 3, 3, 3]
    assert substeps(vectors(4.0, 256), 5e-324) == MOST_SUBSTEPS


@pytest.mark.parametrize("frames", [np.zeros((3, 20, 20)), np.full((3, 3, 50), 7), np.full((2, 4, 4), 255)])
def test_nothing_that_moves_gives_no_levels(frames: np.ndarray) -> None:
    assert sub_steps(frames.astype(np.uint8)) is None


@pytest.mark.parametrize("scale", [1.0, 1.4])
def test_a_view_sees_the_levels_as_it_sees_the_frames(scale: float) -> None:
    """Resized, cropped, mirrored and degraded in contrast."""
    video = rendered_scene("gravel", 96, 112, 3.0 * HERTZ).frames(HERTZ, 4)
    params = replace(
        draw(RECIPE, seed=3, epoch=0, index=0, picture_height_px=96, picture_width_px=112, video_id="a"), scale=scale
    )
    seen: dict[bool, np.ndarray] = {}
    for flip in (False, True):
        view = replace(params, flip=flip, contrast=1.5)
        seen[flip] = _levels(video, view).grey
        frames = apply_view(_window(video, view, 0), view, RECIPE)
        nearest = (
            np.abs(seen[flip][0] / FINE_STEPS - frames[0]).mean(),
            np.abs(seen[flip][0] / FINE_STEPS - frames[2]).mean(),
        )
        assert nearest[0] < nearest[1]
    np.testing.assert_array_equal(seen[True], seen[False][:, :, ::-1])
    assert seen[True].max() <= 255 * FINE_STEPS


def test_a_wider_window_changes_nothing() -> None:
    """Flow may need a larger margin; the levels do not depend on it."""
    video = rendered_scene("gravel", 96, 112, 3.0 * HERTZ).frames(HERTZ, 4)
    params = draw(RECIPE, seed=3, epoch=0, index=0, picture_height_px=96, picture_width_px=112, video_id="a")
    for margin in (MARGIN_PX, 30, None):
        part = without_margin(_window(video, params, margin), params, RECIPE, margin, MARGIN_PX)
        np.testing.assert_array_equal(part, _window(video, params, MARGIN_PX))


def _window(video: np.ndarray, params: SampleParams, margin: int | None) -> np.ndarray:
    top, left, height, width = source_window(params, RECIPE, Window(0, 0, *video.shape[1:]), margin)
    return np.ascontiguousarray(video[:, top : top + height, left : left + width])


def _levels(video: np.ndarray, params: SampleParams) -> Levels:
    top, left, rows, columns = cells_of(params, RECIPE, Window(0, 0, *video.shape[1:]))
    vectors = motions(video)[:, :, top : top + rows, left : left + columns]
    window = _window(video, params, MARGIN_PX)
    levels = levels_of(window, params, RECIPE, np.arange(4), 1.0, vectors, Window(0, 0, *video.shape[1:]))
    assert levels is not None
    return levels


def test_fast_scenes_gain_and_slow_ones_lose_nothing() -> None:
    for name, px, worst in (("camera", 4.8, 0.06), ("thin", 4.0, 0.15)):
        linear, divided = compared(name, px, 64, 1 / HERTZ, count=3)
        assert divided.signed < min(worst, linear.signed)
        assert divided.split < linear.split / 2
    linear, divided = compared("coins", 0.3, 64, 0.01, count=4)
    assert divided == linear


@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera", "coffee", "coins"])
def test_moving_photographs(name: str) -> None:
    for px in (4.8, 12.0):
        _, divided = compared(name, px, 160, 1 / HERTZ)
        assert divided.signed <= 0.10
        assert divided.split <= 0.30
    for px, bar in ((2.0, 0.48), (4.0, 0.38), (10.0, 0.50)):
        _, divided = compared(name, px, 160, 0.01)
        assert divided.signed <= bar
    for px in (0.3, 0.8):
        linear, divided = compared(name, px, 160, 0.01)
        assert divided.signed <= linear.signed + 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bar"),
    [("parallax", 0.45), ("occlusion", 0.45), ("rotation", 0.35), ("zoom", 0.4), ("plain", 0.45), ("thin", 0.3)],
)
def test_other_motion(name: str, bar: float) -> None:
    linear, divided = compared(name, 6.0, 128, 0.01)
    assert divided.signed < min(bar, 0.6 * linear.signed)


DIGEST = """
import hashlib
import numpy as np
from tests.oracles.rendered import rendered_scene
from tests.server.motion.test_clip import sub_steps
for name in ("coins", "parallax", "flicker"):
    for px in (2.0, 9.0):
        levels = sub_steps(rendered_scene(name, 72, 88, 30 * px).frames(30, 3))
        print(hashlib.sha256(levels.grey).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS)
def test_any_processor_makes_the_same_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    exec(DIGEST)
    expected = capsys.readouterr().out.split()
    monkeypatch.setitem(os.environ, "OPENCV_CPU_DISABLE", "AVX2,FMA3")
    assert printed_on_a_generic_processor(DIGEST, tmp_path) == expected
