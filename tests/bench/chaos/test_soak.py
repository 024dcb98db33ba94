"""The soak: when it says that a process grows."""

from __future__ import annotations

import pytest

from bench.chaos import soak
from bench.processes import fit


@pytest.mark.parametrize(("slope", "verdict"), [(0.0, False), (0.2, False), (0.3, True), (-1.0, False)])
def test_growth_is_a_slope_above_the_limit(slope: float, verdict: bool) -> None:
    line = fit([[(at, 100.0 + slope * at / 60.0 + 0.01 * (at % 2)) for at in range(600)]])
    assert soak.grows(line, most_mib_per_hour=16.0) is verdict


def test_a_slope_that_may_be_noise_is_none() -> None:
    line = fit([[(at, 100.0 + (50.0 if at > 450 else 0.0)) for at in range(600)]])
    assert line.slope > 1.0
    assert not soak.grows(line, most_mib_per_hour=16.0)
