"""Simulated cameras have the rates and the counts of their equations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.oracles.cameras import Film, TrueCamera, record
from tests.oracles.other_cameras import OTHERS, record_other


@pytest.mark.slow  # compiles
def test_a_still_scene_has_the_rates_of_the_equations() -> None:
    grey, side, seconds = 0.5, 40, 3
    film = Film(np.full((480 * seconds + 1, side, side), grey, np.float32), 480)
    for name, factor in (
        ("v2e noisy", 1 - 0.75 * grey),
        ("IEBCS bright", math.exp(0.5)),
        ("IEBCS dark", math.exp(0.5)),
    ):
        camera = dataclasses.replace(OTHERS[name], spread=0.0, leak_hz=0.0)
        made = record_other(film, camera, 1)
        for is_on, hz in ((True, camera.on_hz), (False, camera.off_hz)):
            expected = hz * factor * side**2 * seconds
            # Rates of pixels are lognormal in IEBCS: a mean of exp(N) over n pixels spreads by 1.31 / sqrt(n).
            spread = math.sqrt(expected) + expected * (1.31 / side if camera.model == "IEBCS" else 0.0)
            assert abs(np.count_nonzero(made["p"] == is_on) - expected) < 4 * spread, (name, is_on)


@pytest.mark.parametrize("ignores", [False, True], ids=["obeys", "ignores"])
def test_a_steady_ramp_fires_by_threshold_and_refractory_period(ignores: bool) -> None:
    side, threshold, period, hz = 16, 0.05, 2e-3, 6.0
    light = np.exp(np.linspace(-3.0, -0.5, 241))
    film = Film(np.broadcast_to(light[:, None, None] ** (1 / 2.2), (241, side, side)), 240)
    quiet = TrueCamera(threshold, 0.2, refractory_seconds=period, log_eps=1e-9)
    made = record(film, quiet, 1)
    assert made["p"].all()
    # Between two events pass the threshold over the slope, and the blind time.
    assert np.median(gaps_of(made, side)) == pytest.approx(1e6 * (threshold / 2.5 + period), rel=0.01)
    noisy = dataclasses.replace(quiet, shot_noise_hz=hz, noise_ignores=ignores)
    made = record(film, noisy, 1)
    dark = np.count_nonzero(~made["p"])
    expected = side**2 * hz / 2 * float(np.mean(1 - 0.75 * light)) * (1 if ignores else 1 - period / 0.022)
    assert abs(dark - expected) < 4 * math.sqrt(expected)
    assert (gaps_of(made, side) < 0.9e6 * period).any() == ignores


def gaps_of(made: Mapping[str, Any], width: int) -> npt.NDArray[np.int64]:
    """Return the intervals between events of a pixel, us."""
    place = made["y"] * width + made["x"]
    order = np.lexsort((made["t"], place))
    return np.asarray(np.diff(made["t"][order])[np.diff(place[order]) == 0])
