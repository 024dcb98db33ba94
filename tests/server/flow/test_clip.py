"""Pictures and flow are transformed together: resize, crop, flip, pause; and which voxel each flow belongs to.

The estimator of most tests writes the two pictures it is given into its field, so that every pixel of the result tells
where it comes from: it must be what the virtual camera shows there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import v2v_server.flow as clip_module
from tests.server.flow.fields import RECIPE, camera_params, panned
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.flow import STILL_METHOD, Estimator, FlowSettings, flow_for, guarded
from v2v_server.simulation.draw import draw, resized_size
from v2v_server.simulation.view import Window, apply_view, source_window, without_margin

HEIGHT, WIDTH = 110, 150


def recording(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """x = what the first picture shows, y = what the second shows; grey levels are exact in float16."""
    return np.stack([first, second], axis=-1).astype(np.float32)


@contextmanager
def estimator(function: Estimator) -> Iterator[None]:
    """Every method is this one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clip_module, "estimator", lambda name: guarded(function, 1))
        yield


def video(frames: int = 9) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (frames, HEIGHT, WIDTH), np.uint8)


def window_of(frames: np.ndarray, params: SampleParams, recipe: Recipe, margin: int | None) -> np.ndarray:
    top, left, height, width = source_window(params, recipe, Window(0, 0, *frames.shape[1:]), margin)
    return frames[:, top : top + height, left : left + width]


cameras = st.builds(
    lambda index, scales, flips: (
        recipe := RECIPE.replace(
            resize_scale=scales, flip_probability=flips, pause_probability=0.3, pause_stay_probability=0.6,
            contrast_probability=0.5,
        ),
        draw(
            recipe, seed=1, epoch=0, index=index, picture_height_px=HEIGHT, picture_width_px=WIDTH, video_id="v"
        ),
    ),
    st.integers(0, 10**6),
    st.sampled_from([(1.0, 1.0), (0.6, 0.95), (1.05, 1.7)]),
    st.sampled_from([0.0, 1.0]),
)  # fmt: skip


@settings(max_examples=150)
@given(camera=cameras, margin=st.sampled_from([None, 0, 7, 500]), backward=st.booleans())
def test_flow_lies_on_the_pixels_of_the_view(
    camera: tuple[Recipe, SampleParams], margin: int | None, backward: bool
) -> None:
    recipe, params = camera
    frames = video()
    chosen = FlowSettings("dis-fast", "backward" if backward else "forward", margin_px=margin)
    window = window_of(frames, params, recipe, margin)
    with estimator(recording):
        made = flow_for(window, params, recipe, chosen).flow
    plain = replace(params, contrast=0.0)
    seen = apply_view(without_margin(window, params, recipe, margin), plain, recipe).astype(np.float16)
    source = params.source_index(recipe.steps)
    for voxel in range(4):
        start, end = source[2 * voxel], source[2 * voxel + 2]
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


def test_flow_t_belongs_to_voxel_t_behind_a_lead_voxel() -> None:
    recipe = RECIPE.replace(lead_voxels=1, lead_frames=1)
    frames = video(11)
    params = camera_params()
    window = window_of(frames, params, recipe, 0)
    with estimator(recording):
        made = flow_for(window, params, recipe, FlowSettings("dis-fast", margin_px=0)).flow
    assert made.shape == (4, 2, 64, 80)
    for voxel in range(4):
        np.testing.assert_array_equal(made[voxel, 0], frames[2 * voxel + 2, :64, :80])
        np.testing.assert_array_equal(made[voxel, 1], frames[2 * voxel + 4, :64, :80])


def test_steps_before_the_first_are_not_computed() -> None:
    chosen = FlowSettings("dis-fast", first_voxel=3, margin_px=None)
    with estimator(recording):
        made = flow_for(video(), camera_params(), RECIPE, chosen, validity=True)
    assert made.methods == ("skipped", "skipped", "skipped", "dis-fast")
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
    with estimator(counting):
        made = flow_for(video(), params, RECIPE, FlowSettings("dis-fast", margin_px=None), validity=True)
    assert made.methods == ("paused", "paused", "dis-fast", "dis-fast")
    assert not made.flow[:2].any()
    assert made.valid is not None
    assert made.valid[:2].all()
    assert len(calls) == 4  # two steps, both directions


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(UsageError, match="voxel 5: the clip has 4"):
        flow_for(video(), camera_params(), RECIPE, FlowSettings(first_voxel=5))
    with pytest.raises(UsageError, match="this draw shows 9"):
        flow_for(video(8), camera_params(), RECIPE, FlowSettings())
    with pytest.raises(UsageError, match=r"150x60 pixels.*source_window"):
        flow_for(video()[:, :60], camera_params(), RECIPE, FlowSettings())


def median_of(made: np.ndarray) -> np.ndarray:
    """[T, 2]: of the middle of each field."""
    return np.median(made[:, :, 12:-12, 12:-12].astype(np.float64), axis=(2, 3))


@pytest.mark.parametrize("scale", [1.0, 0.8, 1.5])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_a_pan_is_found_scaled_and_mirrored(scale: float, flip: bool, direction: str) -> None:
    """Two frames a voxel: 4 px right and 2 px up of the video a step."""
    frames = panned(9, 120, 170, 2, -1)
    height, width = resized_size(120, 170, scale)
    params = camera_params(
        scale=scale, flip=flip, crop_top_px=(height - 64) // 2, crop_left_px=(width - 80) // 2, pauses=((3, 2),)
    )
    chosen = FlowSettings("dis-fast-1", direction, margin_px=20)
    made = flow_for(window_of(frames, params, RECIPE, 20), params, RECIPE, chosen, validity=True)
    expected = np.float64([4.0, -2.0]) * scale * (1 if direction == "forward" else -1)
    expected[0] *= -1 if flip else 1
    assert not made.flow[1].any()
    np.testing.assert_allclose(median_of(made.flow[[0, 2, 3]]), np.tile(expected, (3, 1)), atol=0.15)
    assert made.valid is not None
    assert made.valid.mean() > 0.8


@pytest.mark.parametrize("name", ["auto", "dis-fast", "dis-fast-1"])
def test_a_still_clip_has_exactly_zero_flow(name: str) -> None:
    frames = np.repeat(panned(1, 120, 170, 0, 0), 9, axis=0)
    made = flow_for(frames, camera_params(), RECIPE, FlowSettings(name, margin_px=None))
    assert not made.flow.any()
    if name == "auto":
        assert set(made.methods) == {STILL_METHOD}


def test_the_same_bytes_again() -> None:
    frames = panned(9, 120, 170, 2, -1)
    first, second = (flow_for(frames, camera_params(), RECIPE, FlowSettings(margin_px=None)) for _ in range(2))
    np.testing.assert_array_equal(first.flow, second.flow)
    assert first.flow.dtype == np.float16
