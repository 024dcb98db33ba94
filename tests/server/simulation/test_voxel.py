"""Durations of steps, from good and bad time stamps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from v2v_protocol.errors import UsageError
from v2v_server.simulation.voxel import step_seconds


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
