"""The rendered scenes and their truth."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracles.rendered import NAMES, SMALL, counts_of, errors, log_levels, rendered_scene

EDGES = np.arange(4) / 30


@pytest.mark.parametrize("name", [*NAMES, *SMALL, "discs", "astronaut"])
def test_frames_of_a_high_rate_come_near_to_the_truth(name: str) -> None:
    """And every bin conserves: what fires is the change of the levels, up to a threshold."""
    scene = rendered_scene(name, 24, 32, 60.0)
    true = scene.counts(EDGES, 0.2, 960.0)
    assert true.positive.sum() + true.negative.sum() > 0
    levels = np.stack([log_levels(scene.light(seconds)).ravel() for seconds in EDGES])
    net = np.cumsum(true.positive - true.negative, axis=0) * 0.2
    assert np.abs(net - (levels[1:] - levels[0])).max() < 0.2 + 0.06
    frames = scene.frames(480, 49).reshape(49, -1) / 255.0
    fine = errors(counts_of(log_levels(frames), np.arange(49) / 480, EDGES, 0.2), true)
    coarse = errors(counts_of(log_levels(frames[::16]), EDGES, EDGES, 0.2), true)
    assert abs(fine.count) < 0.12
    assert fine.split <= coarse.split + 0.05


def test_a_photograph_moves_at_the_speed_that_is_asked_for() -> None:
    """Two videos of different rates show the same place at the same time, and nothing at no speed."""
    scene = rendered_scene("coins", 32, 32, 90.0)
    np.testing.assert_array_equal(scene.frames(30, 3)[2], scene.frames(60, 5)[4])
    still = rendered_scene("camera", 32, 32, 0.0).frames(30, 4)
    assert (still == still[0]).all()
