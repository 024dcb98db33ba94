"""Which steps are drawn, and what is written beside them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.pictures.cameras import record_texts
from trainer.evaluation.pictures import choose_steps, draw_recording


@given(st.integers(1, 500), st.integers(1, 20))
def test_steps_are_evenly_spaced_and_end_with_the_last(count: int, rows: int) -> None:
    steps = sorted(choose_steps(count, rows))
    assert len(steps) == min(count, rows)
    assert steps[0] >= 0
    assert steps[-1] == count - 1
    if len(steps) > 1:
        assert np.ptp(np.diff(steps)) <= 1


@pytest.mark.parametrize(("count", "rows", "steps"), [(12, 2, {5, 11}), (2, 6, {0, 1}), (10, 1, {9})])
def test_chosen_steps_of_known_cases(count: int, rows: int, steps: set[int]) -> None:
    assert choose_steps(count, rows) == steps


@pytest.mark.parametrize(
    ("seconds", "lasts"), [([0.02, 0.02, 0.02], "lasts 20.0 ms"), ([0.02, 0.05, 0.03], "lasts 20.0 to 50.0 ms")]
)
def test_a_picture_says_what_its_greys_are_and_how_long_its_windows_last(
    seconds: list[float], lasts: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = record_texts(monkeypatch)
    rows = [np.full((50, 3 * 44, 3), 7, np.uint8)] * 2
    picture = draw_recording(rows, "desk", seconds, with_camera=True)
    assert (picture == 7).all(axis=-1).sum() == 2 * 50 * 3 * 44  # the panels as they were
    assert {"desk", "events", "reconstruction", "camera"} <= set(written)
    assert f"2 of 3 windows are shown; each {lasts}; times count from the first" in written
    assert "grey of reconstruction and camera: 0 is black, 1 is white" in written
