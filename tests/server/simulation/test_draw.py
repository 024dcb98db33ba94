"""Draws: in range, keyed by identity, independent of each other, stable; and where the residual of a pixel starts."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles import noise
from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import PRESETS, STARTS, Recipe, preset
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.clip import simulate
from v2v_server.simulation.draw import admits, draw, noise_key_of_seed, resized_size, smallest_scale
from v2v_server.simulation.intensity import log_table_float64

PAPER = Recipe()


def drawn(recipe: Recipe = PAPER, count: int = 1, *, video_id: str = "a.mp4", **place: int) -> list[SampleParams]:
    fixed: Any = {"seed": 1, "epoch": 0, "picture_height_px": 180, "picture_width_px": 596} | place
    return [draw(recipe, index=index, video_id=video_id, **fixed) for index in range(count)]


@pytest.fixture(scope="module")
def many() -> list[SampleParams]:
    return drawn(count=1500)


def test_ranges_and_float32_thresholds(many: list[SampleParams]) -> None:
    for params in many:
        small, large = sorted((params.threshold_pos, params.threshold_neg))
        assert np.float32(0.05) <= small <= 2
        assert 1 - 1e-6 <= large / small <= 1.5 + 1e-6
        assert params.threshold_pos == float(np.float32(params.threshold_pos))
        assert 0 <= params.noise_sigma <= 0.1
        assert 0 <= params.hot_pixel_count <= 16
        assert 0 <= params.hot_pixel_sigma <= 10
        assert (params.scale, params.contrast) == (1.0, 0.0)
        assert 0 <= params.crop_top_px <= 52
        assert 0 <= params.crop_left_px <= 468
        assert all(0 <= word < 2**32 for word in params.noise_key)


def test_uniform_moments_and_coins(many: list[SampleParams]) -> None:
    n = len(many)
    small = np.array([min(p.threshold_pos, p.threshold_neg) for p in many])
    assert abs(small.mean() - 1.025) < 4 * 1.95 / math.sqrt(12 * n)
    for chance in ([p.flip for p in many], [p.threshold_pos > p.threshold_neg for p in many]):
        assert abs(np.mean(chance) - 0.5) < 4 * 0.5 / math.sqrt(n)
    assert {p.crop_top_px for p in many} == set(range(53))
    assert abs(np.mean([p.crop_left_px for p in many]) - 234) < 4 * 469 / math.sqrt(12 * n)


def test_draws_of_a_sample_are_uncorrelated(many: list[SampleParams]) -> None:
    columns = np.array(
        [
            (min(p.threshold_pos, p.threshold_neg), p.noise_sigma, p.hot_pixel_count, p.hot_pixel_sigma, p.crop_top_px,
             p.crop_left_px, p.flip, sum(length for _, length in p.pauses), p.noise_key[0])
            for p in many
        ]
    )  # fmt: skip
    matrix = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(matrix).max() < 4.5 / math.sqrt(len(many))
    successive = [np.corrcoef(column[1:], column[:-1])[0, 1] for column in columns.T]
    assert np.abs(successive).max() < 4.5 / math.sqrt(len(many))


def test_pauses_are_the_stated_markov_chain(many: list[SampleParams]) -> None:
    starts, stays, running, paused = np.zeros(4, int)
    for params in many:
        state = np.zeros(PAPER.steps + 1, bool)
        for first, length in params.pauses:
            assert first >= 1
            state[first : first + length] = True
        before, after = state[:-1], state[1:]
        starts += np.count_nonzero(~before & after)
        stays += np.count_nonzero(before & after)
        running += np.count_nonzero(~before)
        paused += np.count_nonzero(before)
    for hits, tries, p in ((starts, running, 0.0102), (stays, paused, 0.9791)):
        assert abs(hits - tries * p) < 4 * math.sqrt(tries * p * (1 - p))


@pytest.mark.parametrize(("start", "stay", "expected"), [(1.0, 1.0, ((1, 200),)), (0.0, 1.0, ()), (1.0, 0.0, None)])
def test_extreme_pauses(start: Any, stay: Any, expected: Any) -> None:
    [params] = drawn(Recipe(pause_probability=start, pause_stay_probability=stay))
    assert params.pauses == (expected if expected is not None else tuple((k, 1) for k in range(1, 201, 2)))


@settings(max_examples=150, deadline=None)
@given(
    height=st.integers(1, 3000),
    width=st.integers(1, 3000),
    crop=st.tuples(st.integers(1, 400), st.integers(1, 400)),
    scale=st.tuples(st.floats(0.05, 4), st.floats(0.05, 4)).map(sorted),
    index=st.integers(0, 2**48 - 1),
    seed=st.integers(0, 2**64 - 1),
    epoch=st.integers(0, 2**32 - 1),
)
def test_the_crop_lies_in_the_resized_picture_or_is_refused(
    height: Any, width: Any, crop: Any, scale: Any, index: Any, seed: Any, epoch: Any
) -> None:
    recipe = Recipe(crop_height_px=crop[0], crop_width_px=crop[1], resize_scale=tuple(scale), voxels_per_clip=1, bins=1)
    place = {"picture_height_px": height, "picture_width_px": width}
    if not admits(recipe, height, width):
        with pytest.raises(UsageError, match=rf"{width}x{height}.*resize_scale"):
            draw(recipe, seed=seed, epoch=epoch, index=index, video_id="v", **place)
        return
    params = draw(recipe, seed=seed, epoch=epoch, index=index, video_id="v", **place)
    resized_height, resized_width = resized_size(height, width, params.scale)
    assert max(scale[0], smallest_scale(recipe, height, width)) <= params.scale <= scale[1]
    assert 0 <= params.crop_top_px <= resized_height - crop[0]
    assert 0 <= params.crop_left_px <= resized_width - crop[1]
    assert params == draw(recipe, seed=seed, epoch=epoch, index=index, video_id="v", **place)


def test_seed_epoch_and_index_each_change_the_draw() -> None:
    base: Any = {"seed": 5, "epoch": 6, "index": 7, "picture_height_px": 180, "picture_width_px": 596, "video_id": "v"}
    keys = {draw(PAPER, **(base | change)).noise_key for change in ({}, {"seed": 6}, {"epoch": 7}, {"index": 8})}
    assert len(keys) == 4


def test_a_setting_of_one_purpose_leaves_the_others_alone() -> None:
    [paper] = drawn()
    [other] = drawn(Recipe(pause_probability=0.0, noise_sigma=(0.0, 0.0), contrast_probability=1.0))
    assert other.contrast > 0
    for name in (
        "threshold_pos",
        "threshold_neg",
        "hot_pixel_count",
        "crop_top_px",
        "crop_left_px",
        "flip",
        "noise_key",
    ):
        assert getattr(paper, name) == getattr(other, name)


def test_thresholds_of_a_video_are_the_same_in_every_epoch() -> None:
    recipe = Recipe(threshold_source="video")
    pairs = {(p.threshold_pos, p.threshold_neg) for p in drawn(recipe, 20) + drawn(recipe, 20, seed=9, epoch=3)}
    assert len(pairs) == 1
    [other] = drawn(recipe, video_id="b.mp4")
    assert (other.threshold_pos, other.threshold_neg) not in pairs
    listed = draw(
        recipe, seed=0, epoch=0, index=0, picture_height_px=180, picture_width_px=596, video_id="a.mp4",
        video_thresholds=(0.1, 0.3),
    )  # fmt: skip
    assert (listed.threshold_pos, listed.threshold_neg) == (float(np.float32(0.1)), float(np.float32(0.3)))


def test_noise_in_units_of_the_threshold() -> None:
    [plain], [scaled] = drawn(), drawn(Recipe(noise_scales_with_threshold=True))
    assert scaled.noise_sigma == plain.noise_sigma * plain.threshold_pos


def test_hot_pixel_share_rounds_half_up() -> None:
    for share, count in ((0.5 / 16384, 1), (0.49 / 16384, 0), (1.0, 16384), (0.0, 0)):
        assert drawn(Recipe(hot_pixel_share=(share, share)))[0].hot_pixel_count == count


EFFECTS: dict[str, Any] = {
    "threshold_mismatch_sigma": (0.1, 0.2), "shot_noise_hz": (1.0, 5.0), "leak_hz": (0.05, 0.2),
    "refractory_seconds": (1e-4, 1e-3), "photoreceptor_hz": (30.0, 300.0), "dead_pixel_share": (0.0, 0.01),
}  # fmt: skip


def test_effects_change_no_other_draw() -> None:
    plain, other = drawn(count=20), drawn(Recipe(**EFFECTS), 20)
    assert all(params.effects == {} for params in plain)
    assert all(params.effects for params in other)
    assert [dataclasses.replace(params, effects={}) for params in other] == plain


@pytest.mark.parametrize("name", EFFECTS)
def test_one_effect_changes_no_other_effect(name: str) -> None:
    [base], [changed] = drawn(Recipe(**EFFECTS)), drawn(Recipe(**EFFECTS).replace(**{name: (0.0, 0.0)}))
    assert {key: value for key, value in base.effects.items() if key != name} == changed.effects


def test_effects_are_uniform_in_their_ranges_and_independent() -> None:
    many = [[params.effects[name] for name in EFFECTS] for params in drawn(Recipe(**EFFECTS), 600)]
    columns = np.array(many).T
    for column, (low, high) in zip(columns, EFFECTS.values(), strict=True):
        assert low <= column.min() <= column.max() <= high
        assert abs(column.mean() - (low + high) / 2) < 4 * (high - low) / math.sqrt(12 * len(many))
    assert np.abs(np.corrcoef(columns) - np.eye(len(columns))).max() < 4.5 / math.sqrt(len(many))


def test_a_range_of_log_eps_changes_no_other_draw() -> None:
    plain, other = drawn(count=200), drawn(Recipe(log_eps=(0.01, 0.2)), 200)
    assert [dataclasses.replace(params, log_eps=None) for params in other] == plain
    values = [params.log_eps or 0.0 for params in other]
    assert (min(values), max(values)) == (pytest.approx(0.01), pytest.approx(0.2))
    assert len(set(values)) == 33  # each needs a table
    assert abs(np.mean(values) - 0.105) < 4 * 0.19 / math.sqrt(12 * 200)
    assert "log_eps" not in plain[0].to_dict()
    assert other[0].to_dict()["log_eps"] == values[0]


def test_golden_effects() -> None:
    [params] = drawn(PRESETS["davis346"], seed=2**64 - 1)
    assert params.effects == GOLDEN_EFFECTS


GOLDEN_EFFECTS = {
    "threshold_mismatch_sigma": 0.1831126706935205,
    "shot_noise_hz": 0.18366444970891183,
    "leak_hz": 0.14871067332232515,
    "refractory_seconds": 0.0005565123425010149,
    "photoreceptor_hz": 201.38932850677057,
    "dead_pixel_share": 2.1938840681034988e-05,
}


def test_golden_draw() -> None:
    assert drawn(Recipe(contrast_probability=1.0, resize_scale=(1.0, 1.3)), seed=2**64 - 1)[0] == GOLDEN


GOLDEN = SampleParams(
    threshold_pos=1.925635576248169,
    threshold_neg=1.7480026483535767,
    noise_sigma=0.01592524406129514,
    hot_pixel_count=16,
    hot_pixel_sigma=1.3925211487045008,
    pauses=((4, 14), (47, 61)),
    scale=1.140676810939945,
    crop_top_px=21,
    crop_left_px=171,
    flip=True,
    contrast=2.032568600900057,
    noise_key=(149919779, 3166137466, 252835541, 2296307179),
)


def test_draw_needs_no_compiler() -> None:
    code = "import sys, v2v_server.simulation.draw; print(sorted({'numba', 'cv2', 'av', 'torch'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# --- where the residual of a pixel starts -----------------------------------------------------------------------------

POSITIVE, NEGATIVE = 0.3, 0.2
ROUNDING = 2e-5
Reals = npt.NDArray[np.float64]


def residuals(law: str, uniform: Reals) -> Reals:
    """Where a law puts the residuals of these uniform draws, by the inverse of its distribution function."""
    span = POSITIVE + NEGATIVE
    if law == "zero":
        return np.zeros_like(uniform)
    if law == "uniform":
        return uniform * span - NEGATIVE
    rising, falling = np.sqrt(uniform * span * NEGATIVE), np.sqrt((1.0 - uniform) * span * POSITIVE)
    return np.where(uniform * span < NEGATIVE, rising - NEGATIVE, POSITIVE - falling)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("law", STARTS)
def test_both_kernels_start_where_the_law_says(law: str, precision: str) -> None:
    """All grey levels, one by one: the first event puts the start between two levels below the threshold."""
    pixels = 700  # more than a block
    ramp = np.arange(256, dtype=np.uint8)[:, None, None] * np.ones((1, 1, pixels), np.uint8)
    made = simulate(
        ramp, threshold_pos=POSITIVE, threshold_neg=NEGATIVE, bins=1, seed=5, precision=precision, start=law,
        dtype="float32", gamma=1.0, log_eps=1.0,
    )  # fmt: skip
    expected = residuals(law, noise.start_uniforms(noise_key_of_seed(5), pixels).astype(np.float64))
    risen = log_table_float64(1.0, 1.0) - log_table_float64(1.0, 1.0)[0]
    # The general kernel computes the law by the same functions in float64, in one more compiled form.
    general = [made.array("event_counts")[:, 1, 0, 0]] if precision == "float32" else []
    for rising in (made.voxels[:, 0, 0], *general):
        assert (rising > 0).any(axis=0).all()
        first = np.argmax(rising > 0, axis=0)
        assert (expected < POSITIVE - risen[first] + ROUNDING).all()
        assert (expected >= POSITIVE - risen[first + 1] - ROUNDING).all()


@pytest.mark.parametrize("law", STARTS)
def test_each_pixel_starts_between_its_own_thresholds(law: str) -> None:
    still = np.full((6, 40, 40), 90, np.uint8)
    made = simulate(still, threshold_pos=0.2, threshold_mismatch_sigma=0.25, bins=1, start=law)
    assert not made.voxels.any()


def test_a_set_residual_wins() -> None:
    frames = np.array([100, 101, 99], np.uint8)[:, None, None] * np.ones((1, 8, 8), np.uint8)
    given: dict[str, Any] = {"threshold_pos": 0.2, "bins": 1, "start_residual": 0.19}
    assert (simulate(frames, start="triangular", **given).voxels == simulate(frames, **given).voxels).all()


def test_an_unknown_law_is_refused() -> None:
    with pytest.raises(UsageError, match=r"start = 'soft': choose one of uniform, triangular, zero"):
        simulate(np.zeros((2, 4, 4), np.uint8), threshold_pos=0.2, bins=1, start="soft")
    with pytest.raises(RecipeError, match="recipe start = "):
        Recipe(start="soft")


def test_rates_drawn_in_their_logarithm_spread_evenly_over_decades_and_change_no_other_draw() -> None:
    recipe = preset("davis346").replace(shot_noise_hz=(0.01, 10.0), leak_hz=0.1, photoreceptor_hz=0)
    log = recipe.replace(rate_draw="log")
    rates = [params.effects for params in drawn(log, 300)]
    shares = np.log10([each["shot_noise_hz"] for each in rates]) / 3 + 2 / 3
    assert shares.min() >= 0.0
    assert shares.max() <= 1.0
    assert np.abs(np.histogram(shares, 5, (0.0, 1.0))[0] - 60).max() < 25
    assert {each["leak_hz"] for each in rates} == {0.1}
    others = ("refractory_seconds", "threshold_mismatch_sigma")
    assert [[each[name] for name in others] for each in rates] == [
        [params.effects[name] for name in others] for params in drawn(recipe, 300)
    ]
