"""Panels and which steps are drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.evaluation.pictures import Video, chosen_steps, draw_events, grey_levels


def test_colours_of_events() -> None:
    voxels = np.zeros((5, 1, 4), np.float32)
    voxels[0, 0, :3] = (1, -1, 1)
    voxels[4, 0, 2] = -1  # cancels
    assert draw_events(voxels)[0].tolist() == [[40, 40, 214], [200, 96, 30], [255, 255, 255], [255, 255, 255]]
    assert (draw_events(np.zeros((5, 2, 2), np.float32)) == 255).all()


def test_grey_levels_round_and_clamp() -> None:
    assert grey_levels(np.array([[-1.0, 0.0, 0.499, 1.0, 7.0]], np.float32)).tolist() == [[0, 0, 127, 255, 255]]


@given(st.integers(1, 500), st.integers(1, 20))
def test_steps_are_evenly_spaced_and_end_with_the_last(count: int, rows: int) -> None:
    steps = sorted(chosen_steps(count, rows))
    assert len(steps) == min(count, rows)
    assert steps[0] >= 0
    assert steps[-1] == count - 1
    if len(steps) > 1:
        assert np.ptp(np.diff(steps)) <= 1


@pytest.mark.parametrize(("count", "rows", "steps"), [(12, 2, {5, 11}), (2, 6, {0, 1}), (10, 1, {9})])
def test_some_of_them(count: int, rows: int, steps: set[int]) -> None:
    assert chosen_steps(count, rows) == steps


@pytest.mark.parametrize("fps", [1.0, 65.5354, 149.993, 655.357, 1000.123, 65_534.7, 200_000.5])
def test_a_video_of_any_rate_is_written(tmp_path: Path, fps: float) -> None:
    """EVAID has 150 pictures a second, and time stamps of microseconds make an odd number of them."""
    with Video(tmp_path / "a.mp4", fps) as video:
        video.add(np.zeros((18, 24, 3), np.uint8))
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(min(fps, 65_535), rel=1e-3)
