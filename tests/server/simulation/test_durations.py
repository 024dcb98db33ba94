"""Grids of a duration (``voxel_seconds``): which frames they span, and what is in their bins."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import MOST_STEPS_PER_GRID, Recipe
from v2v_protocol.sample import SampleParams, array_layout
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import FrameTimes, draw, grid_steps
from v2v_server.simulation.voxel import step_seconds, timed_edges

RECIPE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=8, crop_width_px=8, voxel_seconds=0.05)


def drawn(recipe: Recipe, seconds: np.ndarray, rate: float, *, index: int = 0) -> SampleParams:
    return draw(
        recipe, seed=1, epoch=0, index=index, picture_height_px=20, picture_width_px=20, video_id="a",
        times=FrameTimes(seconds, rate),
    )  # fmt: skip


def lasting(params: SampleParams, recipe: Recipe, seconds: np.ndarray, rate: float) -> np.ndarray:
    """Return the durations of the grids, s."""
    ends = params.ends(recipe)
    steps, _ = step_seconds(seconds, params.source_index(int(ends[-1])), rate)
    return np.diff(np.concatenate(([0.0], np.cumsum(steps)))[ends])


_rates = st.sampled_from((24.0, 24_000 / 1001, 25.0, 30.0, 60.0, 240.0))


@given(_rates, st.floats(0.004, 0.3), st.integers(0, 1), st.integers(1, 3), st.integers(0, 1000))
def test_grids_last_alike_at_every_rate(rate: float, shortest: float, lead: int, stride: int, index: int) -> None:
    recipe = RECIPE.replace(voxel_seconds=(shortest, 2 * shortest), lead_voxels=lead, frame_stride=stride)
    frames = int(recipe.sequence_at(rate)) // stride + 1
    seconds = np.arange(frames) * stride / rate
    params = drawn(recipe, seconds, rate / stride, index=index)
    assert shortest <= params.voxel_seconds <= 2 * shortest
    assert len(params.grid_steps) == recipe.spans
    step = stride / rate
    off = np.abs(lasting(params, recipe, seconds, rate / stride) - max(params.voxel_seconds, step))
    assert (off <= step / 2 + 1e-9).all()


@given(st.integers(0, 2**32), st.floats(0.01, 0.2), st.sampled_from((0.0, 0.3)), st.integers(0, 1000))
def test_time_stamps_decide_where_the_rate_varies(seed: int, duration: float, paused: float, index: int) -> None:
    """Each grid is within half of the steps at its end, as long as the video goes on."""
    recipe = RECIPE.replace(voxel_seconds=duration, pause_probability=paused, pause_stay_probability=0.5)
    steps = np.random.default_rng(seed).choice((1 / 240, 1 / 60, 1 / 30, 1 / 24, 1 / 8), 1000)
    seconds = np.concatenate(([0.0], np.cumsum(steps)))
    params = drawn(recipe, seconds, 1 / steps.mean(), index=index)
    ends = params.ends(recipe)
    durations, _ = step_seconds(seconds, params.source_index(len(steps)), 1 / steps.mean())
    lengths = lasting(params, recipe, seconds, 1 / steps.mean())
    for (first, end), lasts in zip(pairwise(ends.tolist()), lengths, strict=True):
        at_its_end = max(durations[end - 1], durations[end], steps.mean())  # the next step may have been a pause
        assert lasts - duration <= at_its_end / 2 + 1e-9 or end == first + 1
        assert duration - lasts <= at_its_end / 2 + 1e-9


@given(st.integers(0, 1000), st.floats(0.01, 0.1), st.floats(1.0, 3.0))
def test_a_shorter_duration_takes_a_prefix(index: int, shortest: float, factor: float) -> None:
    seconds = np.arange(400) / 60
    short, long = (
        drawn(RECIPE.replace(voxel_seconds=duration, pause_probability=0.2), seconds, 60.0, index=index)
        for duration in (shortest, shortest * factor)
    )
    steps = int(short.ends(RECIPE)[-1])
    assert steps <= long.ends(RECIPE)[-1]
    assert long.source_index(sum(long.grid_steps))[: steps + 1].tolist() == short.source_index(steps).tolist()


@given(
    st.lists(st.floats(1e-6, 10.0), min_size=1, max_size=60),
    st.floats(1e-6, 100.0),
    st.integers(1, 12),
)
def test_every_grid_gets_a_step(durations: list[float], duration: float, grids: int) -> None:
    grids = min(grids, len(durations))
    spans = grid_steps(np.array(durations), duration, grids)
    assert len(spans) == grids
    assert min(spans) >= 1
    assert {type(span) for span in spans} == {int}  # they travel in a message
    assert sum(spans) <= len(durations)


def test_a_video_that_ends_early_shares_its_time_among_the_grids() -> None:
    """Time stamps may be closer at the end of a video than its average rate says."""
    assert grid_steps(np.full(40, 0.01), 0.2, 4) == (10, 10, 10, 10)
    assert grid_steps(np.full(41, 0.01), 0.02, 4) == (2, 2, 2, 2)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), st.integers(1, 7), st.integers(0, 2**32))
def test_bins_are_equal_parts_of_the_time_of_their_grid(spans: list[int], bins: int, seed: int) -> None:
    ends = np.concatenate(([0], np.cumsum(spans)))
    durations = np.random.default_rng(seed).uniform(0.001, 0.1, ends[-1])
    edges = timed_edges(ends, bins, durations)
    since = np.concatenate(([0.0], np.cumsum(durations)))
    at = since[edges.step] + edges.share * np.append(durations, 0.0)[edges.step]
    expected = np.concatenate([np.linspace(since[one], since[two], bins + 1)[:-1] for one, two in pairwise(ends)])
    np.testing.assert_allclose(at[:-1], expected, rtol=0, atol=2e-6 * durations.max())
    assert ((edges.share >= 0) & (edges.share < 1)).all()
    assert edges.step[::bins].tolist() == ends.tolist()


def test_bins_of_equal_steps_are_those_of_a_whole_number_of_frames() -> None:
    """Without noise, grids of 10 frames with 5 bins are what ``frames_per_bin=2`` makes, event for event."""
    recipe = RECIPE.replace(noise_sigma=0.0, hot_pixel_share=0.0, pause_probability=0.0, voxel_seconds=0.2)
    frames = np.random.default_rng(1).integers(0, 256, (41, 8, 8), np.uint8)
    seconds = np.arange(41) / 50
    params = drawn(recipe, seconds, 50.0)
    assert params.grid_steps == (10,) * 4
    made = simulate_clip(frames, params, recipe, "int8", np.full(40, 0.02)).voxels
    plain = recipe.replace(voxel_seconds=0.0, frames_per_bin=2)
    expected = simulate_clip(frames, params, plain, "int8").voxels
    np.testing.assert_array_equal(made, expected)
    assert made.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames_per_bin": 2}, r"frames_per_bin = 2: the duration of a grid is that of voxel_seconds"),
        ({"grids_per_frame": 2}, r"grids_per_frame = 2: .* set grids_per_frame to 0, or voxel_seconds to 0"),
        ({"voxel_seconds": 101}, "from 1e-06 to 100 s, or 0 for off"),
        ({"voxel_seconds": (0, 0.1)}, r"voxel_seconds = \[0, 0.1\]"),
    ],
)
def test_what_does_not_go_together_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        RECIPE.replace(**changes)


def test_a_draw_without_time_stamps_is_refused() -> None:
    with pytest.raises(UsageError, match="time stamps of 3 frames: 4 grids of voxel_seconds need those of 5"):
        drawn(RECIPE, np.arange(3) / 30, 30.0)
    with pytest.raises(RecipeError, match="frames lie at other steps in each sample"):
        _ = RECIPE.target_steps
    with pytest.raises(UsageError, match="frames_all has one shape for all samples"):
        array_layout(RECIPE, "int8", ("voxels", "frames_all"))


def test_steps_by_rate() -> None:
    steps = RECIPE.steps_at([24.0, 30.0, 60.0, 240.0, 1.0, 1e9, math.nan, 0.0]).tolist()
    assert steps == [1, 2, 3, 12, 1, 50_000_000, 0, 0]
    assert RECIPE.steps_per_frame == MOST_STEPS_PER_GRID
    assert Recipe().steps_at(math.nan) == 5


# --- durations of steps, from good and bad time stamps ----------------------------------------------------------------


def test_regular_and_variable_rates_are_taken_as_they_are() -> None:
    durations, irregular = step_seconds(np.array([0.0, 0.1, 0.4, 0.45]), np.arange(4), 25.0)
    np.testing.assert_allclose(durations, [0.1, 0.3, 0.05])
    assert irregular == 0


def test_missing_and_non_increasing_stamps_use_the_average_and_are_counted() -> None:
    seconds = np.array([0.0, np.nan, 0.2, 0.2, 0.1, 0.3])
    durations, irregular = step_seconds(seconds, np.arange(6), 20.0)
    np.testing.assert_allclose(durations, [0.05, 0.05, 0.05, 0.05, 0.2])
    assert irregular == 4


def test_a_paused_step_lasts_the_average_and_is_not_counted() -> None:
    durations, irregular = step_seconds(np.array([0.0, 0.1, 0.2]), np.array([0, 1, 1, 1, 2]), 4.0)
    np.testing.assert_allclose(durations, [0.1, 0.25, 0.25, 0.1])
    assert irregular == 0


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_a_useless_average_rate_is_refused(fps: Any) -> None:
    with pytest.raises(UsageError, match="average_fps"):
        step_seconds(np.arange(3.0), np.arange(3), fps)


def test_too_few_stamps_are_refused() -> None:
    with pytest.raises(UsageError, match="2 time stamps for 3 frames"):
        step_seconds(np.arange(2.0), np.arange(3), 25.0)
