"""The soak: when it says that a process grows."""

from __future__ import annotations

import pytest

from bench.chaos import soak
from bench.processes import fit


@pytest.mark.parametrize(("slope", "verdict"), [(0.0, False), (0.2, False), (0.3, True), (-1.0, False)])
def test_growth_is_a_slope_above_the_limit(slope: float, verdict: bool) -> None:
    line = fit([(at, 100.0 + slope * at / 60.0 + 0.01 * (at % 2)) for at in range(600)])
    assert soak.grows(line, most_mib_per_hour=16.0) is verdict


def test_a_slope_that_may_be_noise_is_none() -> None:
    line = fit([(at, 100.0 + (50.0 if at > 450 else 0.0)) for at in range(600)])
    assert line.slope > 1.0
    assert not soak.grows(line, most_mib_per_hour=16.0)


def test_the_warm_up_of_each_process_is_left_out() -> None:
    warming = [(at, 100.0 + at / 60.0 + max(0.0, 30.0 - at)) for at in range(300)]
    later = [(1000.0 + at, mib) for at, mib in warming]
    memory = {"broker": warming, "worker 0": later}
    assert fit(warming).slope < 0.9
    for points in soak.after(memory, 30.0).values():
        assert fit(points).slope == pytest.approx(1.0)
