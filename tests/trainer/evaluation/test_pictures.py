"""Which steps are drawn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.evaluation.pictures import choose_steps


@given(st.integers(1, 500), st.integers(1, 20))
def test_steps_are_evenly_spaced_and_end_with_the_last(count: int, rows: int) -> None:
    steps = sorted(choose_steps(count, rows))
    assert len(steps) == min(count, rows)
    assert steps[0] >= 0
    assert steps[-1] == count - 1
    if len(steps) > 1:
        assert np.ptp(np.diff(steps)) <= 1


@pytest.mark.parametrize(("count", "rows", "steps"), [(12, 2, {5, 11}), (2, 6, {0, 1}), (10, 1, {9})])
def test_some_of_them(count: int, rows: int, steps: set[int]) -> None:
    assert choose_steps(count, rows) == steps
