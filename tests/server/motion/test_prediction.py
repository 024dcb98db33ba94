"""Predicted losses against scenes with exact events, and the clips that sub-steps do not help."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.oracles.kinds import disc_over_still, frames_of, pan, shake
from tests.oracles.rendered import rendered_scene
from tests.server.motion.test_clip import HERTZ, compared, sub_steps
from v2v_server.motion.prediction import Prediction, predict


@pytest.mark.parametrize(("name", "px"), [("gravel", 6.0), ("rotation", 6.0), ("plain", 6.0)])
def test_the_prediction_is_close_to_exact_events(name: str, px: float) -> None:
    found = predict(rendered_scene(name, 96, 96, px * HERTZ).frames(HERTZ, 5))
    assert found.can_be_followed
    for divided, true in zip((False, True), compared(name, px, 96, 1 / HERTZ), strict=True):
        made = found.loss(divided=divided)
        assert made.likely == pytest.approx(-true.count, abs=0.12)
        assert made.low <= max(-true.count, 0.0) <= made.high


def test_the_median_motion_is_right() -> None:
    found = predict(rendered_scene("coffee", 96, 96, 5 * HERTZ).frames(HERTZ, 4))
    assert found.px_per_frame == pytest.approx(5.0, abs=0.5)
    assert not found.is_slow


def test_the_loss_grows_with_motion() -> None:
    losses = [
        predict(rendered_scene("camera", 96, 96, px * HERTZ).frames(HERTZ, 4)).loss().likely for px in (1, 2, 4, 8)
    ]
    assert losses == sorted(losses)


@pytest.mark.parametrize("count", [2, 5])
def test_a_still_clip_is_slow(count: int) -> None:
    still = np.repeat(rendered_scene("coffee", 48, 48, HERTZ).frames(HERTZ, 1), count, axis=0)
    found = predict(still)
    assert found.is_slow
    assert found.px_per_frame == 0.0


def test_flicker_and_vibration_cannot_be_followed() -> None:
    rng = np.random.default_rng(1)
    light = rendered_scene("coffee", 96, 96, 10 * HERTZ).light
    lamps = np.stack([np.rint(255 * light(0.0) * (1 - 0.5 * rng.random())) for _ in range(6)]).astype(np.uint8)
    assert not predict(lamps).can_be_followed
    shaken = np.stack([np.rint(255 * light(0.05 * rng.random())) for _ in range(6)]).astype(np.uint8)
    found = predict(shaken)
    assert not found.is_slow
    assert not found.can_be_followed


def test_a_shake_of_two_pixels_at_nine_hertz_is_not_slow() -> None:
    found = predict(frames_of(shake, "leaves1", 4 * 2 * 9 / HERTZ))
    assert found.features.unsteady > 0.2
    assert not found.is_slow
    assert not found.can_be_followed


def test_uncovered_background_is_named_and_may_lose_nothing() -> None:
    found = predict(frames_of(disc_over_still, "coffee", 6.0))
    assert found.uncovers
    assert found.loss().low == 0.0
    assert not predict(frames_of(pan, "coffee", 6.0)).uncovers


def test_blur_along_the_motion_hides_losses() -> None:
    sharp, blurred = (predict(frames_of(pan, "leaves1", 6.0, exposure)) for exposure in (0.0, 0.5))
    assert sharp.features.smear == 0.0
    assert blurred.features.smear > 0.5
    assert blurred.loss(divided=True).likely > sharp.loss(divided=True).likely + 0.1


SHARES = st.floats(0.0, 1.0)


@given(
    divided=st.floats(0.0, 1e9), linear=st.floats(0.0, 1.2), moving=SHARES, beside=SHARES, px=st.floats(0.5, 100.0),
    unsteady=SHARES, flicker=SHARES, sharp=st.lists(st.floats(0.0, 1e12), min_size=4, max_size=4),
)  # fmt: skip
def test_a_loss_lies_in_its_interval(
    divided: float, linear: float, moving: float, beside: float, px: float, unsteady: float, flicker: float,
    sharp: list[float],
) -> None:  # fmt: skip
    moves = divided * moving
    found = Prediction(
        divided * linear, divided, moves, moves * beside, moves * math.log(px), moves, moves * unsteady,
        divided * linear * flicker, *sharp,
    )  # fmt: skip
    for each in (found.loss(), found.loss(divided=True)):
        assert 0.0 <= each.low <= each.likely <= each.high <= 1.0
    assert found.linear > found.divided or found.loss().likely >= found.loss(divided=True).likely


def test_repeated_frames_do_not_hide_the_motion() -> None:
    moving = rendered_scene("coffee", 96, 96, 4 * HERTZ).frames(HERTZ, 6)
    found = predict(moving[[0, 1, 2, 3, 3, 4, 5]])
    assert found.can_be_followed
    assert found.loss().likely == pytest.approx(predict(moving).loss().likely, abs=0.01)


def test_predictions_add_up() -> None:
    slow, fast = (predict(rendered_scene("coffee", 64, 64, px * HERTZ).frames(HERTZ, 3)) for px in (1, 8))
    both = slow + fast
    assert slow.loss().likely < both.loss().likely < fast.loss().likely
    assert Prediction() + fast == fast


def test_the_memory_is_that_of_the_docstring() -> None:
    frames = rendered_scene("coffee", 96, 96, 12 * HERTZ).frames(HERTZ, 9)
    levels = sub_steps(frames)
    assert levels is not None
    pictures = len(frames) + len(levels.grey)
    del levels
    tracemalloc.start()
    try:
        predict(frames)
        assert tracemalloc.get_traced_memory()[1] < 8 * pictures * 96 * 96
    finally:
        tracemalloc.stop()
