"""The line through memory over time, against series whose slope is known."""

from __future__ import annotations

import os

import numpy as np
import pytest

from bench.processes import fit, rss_mib
from v2v_protocol.errors import UsageError


def series(slope: float, seconds: int = 300) -> list[tuple[float, float]]:
    """Memory growing by ``slope`` MiB a minute, one point a second."""
    return [(float(at), 100.0 + slope * at / 60.0) for at in range(seconds)]


@pytest.mark.parametrize("slope", [-3.0, 0.0, 0.25, 60.0])
def test_an_exact_line_is_found(slope: float) -> None:
    found = fit(series(slope))
    assert found.slope == pytest.approx(slope, abs=1e-9)
    assert found.standard_error == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("persistence", [0.0, 0.8], ids=["white noise", "points that say nearly the same"])
def test_the_stated_error_is_that_of_many_series(persistence: float) -> None:
    rng = np.random.default_rng(2)
    slopes, stated = [], []
    for _ in range(200):
        noise = rng.normal(size=600)
        for place in range(1, 600):
            noise[place] += persistence * noise[place - 1]
        found = fit([(float(at), 5.0 + error) for at, error in enumerate(noise)])
        slopes.append(found.slope)
        stated.append(found.standard_error)
    assert np.mean(stated) == pytest.approx(np.std(slopes), rel=0.2)


def test_too_little_is_refused() -> None:
    with pytest.raises(UsageError, match="run for longer"):
        fit(series(1.0, seconds=2))


def test_a_process_that_is_gone_has_no_memory() -> None:
    assert (rss_mib(os.getpid()) or 0.0) > 10.0
    assert rss_mib(2**22 + 1) is None
