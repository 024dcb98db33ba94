"""What is rendered of a clip: it moves as the clip moves, and its errors are those of the clip."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.tradeoff import Case, measured
from tests.oracles.rendered import path, rendered_scene
from v2v_tools.motion import MOST_LOST
from v2v_tools.tradeoff.rendered import STEPS, moving_photograph

SIDES_PX, HZ = (96, 128), 30


@pytest.mark.parametrize("px", [0.7, 3.0, 8.0])
@pytest.mark.parametrize("name", ["coins", "zoom", "rotation", "discs"])
def test_a_frame_moves_as_the_clip_moves(name: str, px: float) -> None:
    """The camera to a tenth of a pixel at the corner, or 2 % of its motion; of discs, a patch within one, as fast."""
    _, world = moving_photograph(rendered_scene(name, *SIDES_PX, px * HZ).frames(HZ, 2))
    places, reach = world.places(np.array([0.0, 1.0]) + STEPS / 2)[:, 0], max(SIDES_PX) / 2
    corner = np.array([0.0, 0.0, 1.0])
    moved = (places[1] @ corner - places[0] @ corner)[:2] * world.scale
    back, angle = -path(1 / HZ)[::-1] * px * HZ, px / reach
    middle = np.array(SIDES_PX[::-1]) / 2
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    wanted = {
        "coins": back, "zoom": (1 - np.exp(-angle)) * middle, "rotation": middle - turned @ middle,
        "discs": np.zeros(2),
    }[name]  # fmt: skip
    np.testing.assert_allclose(moved, wanted, atol=max(0.1, 0.02 * px))
    if name == "discs" and px == 3.0:
        assert any(abs(np.hypot(*layer.speed_px) - px) < 0.35 * px + 0.5 for layer in world.layers[1:])
        assert all(layer.outline[2] * world.scale < 0.34 * reach for layer in world.layers[1:])


def test_what_rests_is_rendered_at_rest() -> None:
    pyramid, world = moving_photograph(rendered_scene("coffee", *SIDES_PX, 0.0).frames(HZ, 2))
    assert len(world.layers) == 1
    np.testing.assert_array_equal(*world.places(np.array([0.0, float(STEPS)])))
    assert pyramid.grey.size == 16 * SIDES_PX[0] * SIDES_PX[1]


@pytest.mark.slow
@pytest.mark.parametrize("case", [Case("coins", 4.0), Case("discs", 5.0)])
def test_the_error_that_is_told_is_near_and_the_better_one_is_named(case: Case) -> None:
    without, divided = measured(case)
    for each in (without, divided):
        assert abs(each["told"] - each["true"]) <= max(0.01, each["true"] / 3)
    assert (without["told"] < divided["told"]) == (without["true"] < divided["true"])


@pytest.mark.slow
def test_of_insects_nothing_is_told() -> None:
    for each in measured(Case("insects", 6.0)):
        assert each["told"] is None
        assert each["lost_share"] > MOST_LOST
