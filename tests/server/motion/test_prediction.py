"""Predicted losses against scenes with exact events, and the clips that sub-steps do not help."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from tests.oracles.rendered import rendered_scene
from tests.server.motion.test_clip import HERTZ, compared, sub_steps
from v2v_server.motion.prediction import Prediction, predict


@pytest.mark.parametrize(("name", "px"), [("gravel", 6.0), ("rotation", 6.0), ("plain", 6.0)])
def test_the_prediction_is_close_to_exact_events(name: str, px: float) -> None:
    found = predict(rendered_scene(name, 96, 96, px * HERTZ).frames(HERTZ, 5))
    assert found.can_be_followed
    for setting, true in zip(("linear", "divided"), compared(name, px, 96, 1 / HERTZ), strict=True):
        made = found.errors(setting)
        assert made.lost == pytest.approx(-true.count, abs=0.12)
        assert made.signed == pytest.approx(true.signed, abs=0.08)
        assert made.split == pytest.approx(true.split, abs=0.12)


def test_the_median_motion_is_right() -> None:
    found = predict(rendered_scene("coffee", 96, 96, 5 * HERTZ).frames(HERTZ, 4))
    assert found.px_per_frame == pytest.approx(5.0, abs=0.5)
    assert not found.is_slow


def test_the_loss_grows_with_motion() -> None:
    losses = [
        predict(rendered_scene("camera", 96, 96, px * HERTZ).frames(HERTZ, 4)).errors("linear").lost
        for px in (1, 2, 4, 8)
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


def test_repeated_frames_do_not_hide_the_motion() -> None:
    moving = rendered_scene("coffee", 96, 96, 4 * HERTZ).frames(HERTZ, 6)
    found = predict(moving[[0, 1, 2, 3, 3, 4, 5]])
    assert found.can_be_followed
    assert found.errors("linear").lost == pytest.approx(predict(moving).errors("linear").lost, abs=0.01)


def test_predictions_add_up() -> None:
    slow, fast = (predict(rendered_scene("coffee", 64, 64, px * HERTZ).frames(HERTZ, 3)) for px in (1, 8))
    both = slow + fast
    assert slow.apparent.lost < both.apparent.lost < fast.apparent.lost
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
