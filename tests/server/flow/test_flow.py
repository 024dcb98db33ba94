"""Flow: each method against exact shifts and hard pictures, the check of validity, and flow of the view.

The estimator of most tests of a clip writes the two pictures it is given into its field, so that every pixel of the
result tells where it comes from: it must be what the virtual camera shows there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import FlowMethod, StreamSpec
from v2v_server import flow as flow_module
from v2v_server.flow import (
    AUTO,
    METHODS,
    MOVING_METHOD,
    SLOW_METHOD,
    STILL_METHOD,
    Estimator,
    FlowSettings,
    choose,
    consistent,
    estimator,
    flow_for,
    guarded,
    one_thread,
)
from v2v_server.simulation.draw import draw
from v2v_server.simulation.view import Window, apply_view, source_window, without_margin

RECIPE = Recipe(voxels_per_clip=4, bins=2, crop_height_px=64, crop_width_px=80)
"""Eight steps; a voxel spans two."""


_PLAIN = SampleParams(
    threshold_pos=0.2, threshold_neg=0.2, noise_sigma=0.0, hot_pixel_count=0, hot_pixel_sigma=0.0, pauses=(),
    scale=1.0, crop_top_px=0, crop_left_px=0, flip=False, contrast=0.0, noise_key=(0, 0, 0, 0),
)  # fmt: skip


def camera_params(**changes: Any) -> SampleParams:
    """A virtual camera that sees the picture as it is; ``changes`` are fields of it."""
    return replace(_PLAIN, **changes)


def panned(count: int, height: int, width: int, right: int, down: int) -> np.ndarray:
    """[count, height, width] uint8: what the photograph shows moves by (right, down) whole pixels a frame."""
    picture = np.array(data.camera(), np.uint8)
    rows = 150 - down * np.arange(count)
    columns = 150 - right * np.arange(count)
    return np.stack([picture[y : y + height, x : x + width] for y, x in zip(rows, columns, strict=True)])


# --- every method -----------------------------------------------------------------------------------------------------

ESTIMATING = sorted(set(METHODS) - {"zero"})
INSIDE = np.s_[24:-24, 24:-24]


@pytest.mark.parametrize("name", ESTIMATING)
@pytest.mark.parametrize(("right", "down"), [(3, 0), (0, -2), (-4, 3)])
def test_sign_and_order_of_axes(name: str, right: int, down: int) -> None:
    first, second = panned(2, 128, 160, right, down)
    field = estimator(name)(first, second)
    assert field.shape == (128, 160, 2)
    assert field.dtype == np.float32
    error = np.linalg.norm(field[INSIDE] - np.float32([right, down]), axis=-1)
    assert np.median(error) < 0.25
    back = estimator(name)(second, first)
    assert np.median(np.linalg.norm(back[INSIDE] + np.float32([right, down]), axis=-1)) < 0.25


@pytest.mark.parametrize("name", sorted(METHODS))
def test_equal_pictures_have_exactly_zero_flow(name: str) -> None:
    picture = panned(1, 90, 120, 0, 0)[0]
    assert not estimator(name)(picture, picture.copy()).any()


@pytest.mark.parametrize("name", sorted(METHODS))
@pytest.mark.parametrize(
    "size", [(1, 1), (2, 300), (11, 12), (13, 40), (16, 300), (24, 600), (40, 40), (48, 48), (600, 20), (23, 64)]
)
def test_small_and_thin_pictures_are_survived(name: str, size: tuple[int, int]) -> None:
    """OpenCV refuses some of these sizes and dies of others; a fault here ends the whole test run."""
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 256, (2, *size), np.uint8)
    for one, other in ((first, second), (first, np.zeros_like(first)), (np.zeros_like(first), first)):
        field = estimator(name)(one, other)
        assert field.shape == (*size, 2)
        assert np.isfinite(field).all()


@pytest.mark.parametrize("name", sorted(METHODS))
def test_pictures_without_texture_do_not_move(name: str) -> None:
    """Nor does a change of brightness break anything: there is nothing to track."""
    flat = np.full((96, 130), 80, np.uint8)
    assert np.abs(estimator(name)(flat, flat + np.uint8(9))).max() < 1e-3


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_result_does_not_depend_on_what_came_before(name: str) -> None:
    frames = panned(4, 100, 140, 2, 1)
    fresh = estimator(name)(frames[0], frames[1])
    used = estimator(name)
    used(frames[2], frames[3])
    used(np.ascontiguousarray(frames[3, :70, :90]), np.ascontiguousarray(frames[2, :70, :90]))
    np.testing.assert_array_equal(used(frames[0], frames[1]), fresh)


@settings(max_examples=40)
@given(height=st.integers(1, 70), width=st.integers(1, 70))
def test_the_guard_enlarges_for_the_method_alone(height: int, width: int) -> None:
    seen = []

    def estimate(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        seen.append(first.shape)
        y, x = np.mgrid[: first.shape[0], : first.shape[1]]
        return np.stack([x, y], axis=-1).astype(np.float32)

    picture = np.zeros((height, width), np.uint8)
    field = guarded(estimate, 48)(picture, picture + np.uint8(1))
    assert seen == [(max(48, height), max(48, width))]
    y, x = np.mgrid[:height, :width]
    np.testing.assert_array_equal(field, np.stack([x, y], axis=-1))


def test_the_number_of_threads_is_put_back() -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with one_thread():
            assert cv2.getNumThreads() == 1
        with pytest.raises(ZeroDivisionError), one_thread():
            raise ZeroDivisionError
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


def test_an_unknown_method_is_named_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match=r"'dis-slow'.*dis-fast.*dis-fast-1"):
        estimator("dis-slow")


def test_auto_looks_at_the_motion() -> None:
    still = panned(1, 128, 160, 0, 0)[0]
    noise = np.random.default_rng(0).integers(-2, 3, still.shape)
    assert choose(still, np.clip(still.astype(int) + noise, 0, 255).astype(np.uint8)) == STILL_METHOD
    moved = panned(2, 128, 160, 4, 1)
    assert choose(moved[0], moved[1]) == MOVING_METHOD
    # A quarter of a pixel: the photograph enlarged four times, moved by one pixel and made small again.
    large = cv2.resize(panned(1, 130, 170, 0, 0)[0], None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    slow = [cv2.resize(large[:512, start : start + 640], (160, 128), interpolation=cv2.INTER_AREA) for start in (0, 1)]
    assert choose(slow[0], slow[1]) == SLOW_METHOD


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (9, 9), (20, 700)])
def test_auto_looks_at_any_size(size: tuple[int, int]) -> None:
    first, second = np.random.default_rng(2).integers(0, 256, (2, *size), np.uint8)
    assert choose(first, second) in METHODS


# --- the forward-backward check ---------------------------------------------------------------------------------------


def uniform(x: float, y: float, height: int = 40, width: int = 50) -> np.ndarray:
    return np.broadcast_to(np.float32([x, y]), (height, width, 2)).copy()


def test_what_leaves_the_picture_is_invalid() -> None:
    valid = consistent(uniform(5, -3), uniform(-5, 3))
    expected = np.zeros((40, 50), bool)
    expected[3:, :45] = True
    np.testing.assert_array_equal(valid, expected)


def test_the_two_fields_must_agree() -> None:
    # |f + g|^2 = 4 is above 0.01 (25 + 9) + 0.5, and 0.25 is below it.
    assert not consistent(uniform(5, 0), uniform(-3, 0)).any()
    assert consistent(uniform(5, 0), uniform(-4.5, 0))[:, :45].all()
    assert not consistent(uniform(5, 0), uniform(5, 0)).any()


def test_the_opposite_field_is_read_where_the_first_one_leads() -> None:
    """A block moves 8 px right over a still ground: what it uncovers is visible in one picture only."""
    forward, backward = uniform(0, 0), uniform(0, 0)
    forward[10:20, 10:20] = (8, 0)
    backward[10:20, 18:28] = (-8, 0)
    valid = consistent(forward, backward)
    assert valid[10:20, 10:20].all()  # the block
    assert not valid[10:20, 20:28].any()  # ground that the block covers in the later picture
    assert valid[:10].all()
    assert valid[20:].all()


# --- the fields of a spec ---------------------------------------------------------------------------------------------


def test_both_sides_know_the_same_names() -> None:
    assert (AUTO, *METHODS) == get_args(FlowMethod)
    assert FlowSettings.of(StreamSpec()) == FlowSettings()


def test_settings_of_a_spec() -> None:
    spec = StreamSpec(flow_method="dis-fast-1", flow_direction="backward", flow_from=20, flow_margin_px=-1)
    assert FlowSettings.of(spec) == FlowSettings("dis-fast-1", "backward", 20, None)


def test_what_cannot_be_is_refused_before_anything_is_sent() -> None:
    for field, wrong in (
        ("flow_method", "dis"), ("flow_direction", "up"), ("flow_from", 41), ("flow_from", -1), ("flow_margin_px", -2),
        ("flow_margin_px", True),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=field):
            StreamSpec(**{field: wrong})  # type: ignore[arg-type]


# --- of a clip --------------------------------------------------------------------------------------------------------

HEIGHT, WIDTH = 110, 150


def recording(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """x = what the first picture shows, y = what the second shows; grey levels are exact in float16."""
    return np.stack([first, second], axis=-1).astype(np.float32)


@contextmanager
def every_method_is(function: Estimator) -> Iterator[None]:
    """Every method is this one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow_module, "estimator", lambda name: guarded(function, 1))
        yield


def video(frames: int = 9) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (frames, HEIGHT, WIDTH), np.uint8)


def window_of(frames: np.ndarray, params: SampleParams, recipe: Recipe, margin: int | None) -> np.ndarray:
    top, left, height, width = source_window(params, recipe, Window(0, 0, *frames.shape[1:]), margin)
    return frames[:, top : top + height, left : left + width]


cameras = st.builds(
    lambda index, scales, flips, leads: (
        recipe := RECIPE.replace(
            lead_voxels=leads, lead_frames=leads, resize_scale=scales, flip_probability=flips,
            pause_probability=0.3, pause_stay_probability=0.6, contrast_probability=0.5,
        ),
        draw(
            recipe, seed=1, epoch=0, index=index, picture_height_px=HEIGHT, picture_width_px=WIDTH, video_id="v"
        ),
    ),
    st.integers(0, 10**6),
    st.sampled_from([(1.0, 1.0), (0.6, 0.95), (1.05, 1.7)]),
    st.sampled_from([0.0, 1.0]),
    st.integers(0, 1),
)  # fmt: skip


@settings(max_examples=60)
@given(camera=cameras, margin=st.sampled_from([None, 0, 7, 500]), backward=st.booleans())
def test_flow_lies_on_the_pixels_of_the_view(
    camera: tuple[Recipe, SampleParams], margin: int | None, backward: bool
) -> None:
    recipe, params = camera
    frames, lead = video(recipe.frames_needed), 2 * recipe.lead_voxels
    chosen = FlowSettings("dis-fast", "backward" if backward else "forward", margin_px=margin)
    window = window_of(frames, params, recipe, margin)
    with every_method_is(recording):
        made = flow_for(window, params, recipe, chosen).flow
    plain = replace(params, contrast=0.0)
    seen = apply_view(without_margin(window, params, recipe, margin), plain, recipe).astype(np.float16)
    source = params.source_index(recipe.steps)
    for voxel in range(4):
        start, end = source[lead + 2 * voxel], source[lead + 2 * voxel + 2]
        if start == end:
            assert not made[voxel].any()
            continue
        first, second = (end, start) if backward else (start, end)
        np.testing.assert_array_equal(made[voxel, 0], -seen[first] if params.flip else seen[first])
        np.testing.assert_array_equal(made[voxel, 1], seen[second])


@settings(max_examples=60)
@given(camera=cameras, margin=st.sampled_from([None, 0, 9]), top=st.integers(0, 30))
def test_the_view_is_the_same_whichever_window_was_decoded(
    camera: tuple[Recipe, SampleParams], margin: int | None, top: int
) -> None:
    """Asking for flow must not change the other arrays."""
    recipe, params = camera
    picture = np.random.default_rng(6).integers(0, 256, (2, HEIGHT + 40, WIDTH), np.uint8)

    def decoded(window: tuple[int, int, int, int]) -> np.ndarray:
        first, left, height, width = window
        assert first >= top
        assert left >= 0
        assert first + height <= top + HEIGHT
        assert left + width <= WIDTH
        return picture[:, first : first + height, left : left + width]

    alone = apply_view(decoded(source_window(params, recipe, Window(top, 0, HEIGHT, WIDTH))), params, recipe)
    window = decoded(source_window(params, recipe, Window(top, 0, HEIGHT, WIDTH), margin))
    np.testing.assert_array_equal(apply_view(without_margin(window, params, recipe, margin), params, recipe), alone)


def test_steps_before_the_first_are_not_computed() -> None:
    chosen = FlowSettings("dis-fast", first_voxel=3, margin_px=None)
    with every_method_is(recording):
        made = flow_for(video(), camera_params(), RECIPE, chosen, validity=True)
    assert made.methods == ("skipped", "skipped", "skipped", "dis-fast")
    assert made.flow.dtype == np.float16
    assert not made.flow[:3].any()
    assert made.flow[3].any()
    assert made.valid is not None
    assert not made.valid[:3].any()


def test_a_paused_step_is_never_estimated() -> None:
    calls = []

    def counting(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        calls.append(1)
        return recording(first, second)

    params = camera_params(pauses=((1, 4), (7, 1)))
    with every_method_is(counting):
        made = flow_for(video(), params, RECIPE, FlowSettings("dis-fast", margin_px=None), validity=True)
    assert made.methods == ("paused", "paused", "dis-fast", "dis-fast")
    assert not made.flow[:2].any()
    assert made.valid is not None
    assert (made.valid[:2] == 1).all()
    assert len(calls) == 4  # two steps, both directions


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(UsageError, match="voxel 5: the clip has 4"):
        flow_for(video(), camera_params(), RECIPE, FlowSettings(first_voxel=5))
    with pytest.raises(UsageError, match="this draw shows 9"):
        flow_for(video(8), camera_params(), RECIPE, FlowSettings())
    with pytest.raises(UsageError, match=r"150x60 pixels.*source_window"):
        flow_for(video()[:, :60], camera_params(), RECIPE, FlowSettings())
