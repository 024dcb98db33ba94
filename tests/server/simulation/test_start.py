"""How the residual of a pixel starts: the laws, in both kernels, and what they make of a clip."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.oracles import noise
from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import STARTS, Recipe, preset
from v2v_server.simulation.clip import simulate, simulate_log
from v2v_server.simulation.draw import draw, noise_key_of_seed

POSITIVE, NEGATIVE = 0.3, 0.2
STEP = 1e-3
Reals = npt.NDArray[np.float64]


def drawn(law: str, uniform: Reals) -> Reals:
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
    pixels = 700  # more than a block
    ramp = np.arange(501.0)[:, None, None] * STEP * np.ones((1, 1, pixels))
    made = simulate_log(
        ramp, threshold_pos=POSITIVE, threshold_neg=NEGATIVE, bins=1, seed=5, precision=precision, start=law,
        dtype="float32",
    )  # fmt: skip
    expected = drawn(law, noise.start_uniforms(noise_key_of_seed(5), pixels).astype(np.float64))
    # The general kernel computes the law by the same functions in float64, in one more compiled form.
    general = [made.array("event_counts")[:, 1, 0, 0]] if precision == "float32" else []
    for rising in (made.voxels[:, 0, 0], *general):
        assert (rising > 0).any(axis=0).all()
        found = POSITIVE - STEP * (np.argmax(rising > 0, axis=0) + 1)
        assert np.abs(found - expected + STEP / 2).max() < 0.52 * STEP


def test_the_triangular_law_is_where_a_camera_stands_that_has_run_for_long() -> None:
    """A residual in Brownian motion that returns to 0 at each event."""
    rng, pixels = np.random.default_rng(0), 40_000
    residual = drawn("uniform", rng.random(pixels))
    for _ in range(4000):
        residual += rng.normal(0.0, 0.01, pixels)
        residual[(residual >= POSITIVE) | (residual <= -NEGATIVE)] = 0.0
    law = drawn("triangular", (np.arange(pixels) + 0.5) / pixels)
    shares = np.linspace(0.05, 0.95, 19)
    assert np.abs(np.quantile(residual, shares) - np.quantile(law, shares)).max() < 0.006
    assert np.abs(np.quantile(residual, shares) - drawn("uniform", shares)).max() > 0.04  # which the test can tell


@pytest.mark.parametrize("law", STARTS)
def test_each_pixel_starts_between_its_own_thresholds(law: str) -> None:
    still = np.full((6, 40, 40), 90, np.uint8)
    made = simulate(still, threshold_pos=0.2, threshold_mismatch_sigma=0.25, bins=1, start=law)
    assert not made.voxels.any()


def test_a_set_residual_wins() -> None:
    frames = np.array([100, 101, 99], np.uint8)[:, None, None] * np.ones((1, 8, 8), np.uint8)
    given: dict[str, Any] = {"threshold_pos": 0.2, "bins": 1, "start_residual": 0.19}
    assert (simulate(frames, start="triangular", **given).voxels == simulate(frames, **given).voxels).all()


def test_a_small_change_fires_less_from_a_triangular_start_and_not_at_all_from_zero() -> None:
    frames = np.full((2, 200, 200), 100, np.uint8)
    frames[1] = 104  # 0.086 log units, 0.43 thresholds
    counts = {law: int(simulate(frames, threshold_pos=0.2, bins=1, start=law).voxels.sum()) for law in STARTS}
    share = 2.2 * np.log(104 / 100) / 0.2
    assert counts["uniform"] == pytest.approx(40_000 * share / 2, rel=0.03)
    assert counts["triangular"] == pytest.approx(40_000 * share**2 / 2, rel=0.04)
    assert counts["zero"] == 0


def test_an_unknown_law_is_refused() -> None:
    with pytest.raises(UsageError, match=r"start = 'soft': choose one of uniform, triangular, zero"):
        simulate(np.zeros((2, 4, 4), np.uint8), threshold_pos=0.2, bins=1, start="soft")
    with pytest.raises(RecipeError, match="recipe start = "):
        Recipe(start="soft")


def camera(recipe: Recipe, index: int) -> dict[str, float]:
    drawn = draw(
        recipe, seed=1, epoch=0, index=index, picture_height_px=200, picture_width_px=200, video_id="a"
    )  # fmt: skip
    return dict(drawn.effects)


def test_rates_drawn_in_their_logarithm_spread_evenly_over_decades_and_change_no_other_draw() -> None:
    recipe = preset("davis346").replace(shot_noise_hz=(0.01, 10.0), leak_hz=0.1, photoreceptor_hz=0)
    log = recipe.replace(rate_draw="log")
    rates = [camera(log, index) for index in range(300)]
    shares = np.log10([each["shot_noise_hz"] for each in rates]) / 3 + 2 / 3
    assert shares.min() >= 0.0
    assert shares.max() <= 1.0
    assert np.abs(np.histogram(shares, 5, (0.0, 1.0))[0] - 60).max() < 25
    assert {each["leak_hz"] for each in rates} == {0.1}
    others = ("refractory_seconds", "threshold_mismatch_sigma")
    assert [[each[name] for name in others] for each in rates] == [
        [camera(recipe, index)[name] for name in others] for index in range(300)
    ]


def test_a_logarithm_of_nothing_is_refused_by_name() -> None:
    with pytest.raises(RecipeError, match=r"recipe shot_noise_hz = .*: a range that is drawn in its logarithm"):
        preset("davis346").replace(rate_draw="log")


def test_the_new_fields_are_left_out_of_the_plain_form_at_their_defaults() -> None:
    assert not {"start", "rate_draw"} & Recipe().to_dict().keys()
    changed = Recipe(start="triangular", rate_draw="log")
    assert Recipe.from_dict(changed.to_dict()) == changed
