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


@pytest.mark.parametrize(
    ("share", "hz", "rate", "opposite"),
    [
        (0.22, 35.0, 1.73, 0.968),
        pytest.param(0.26, 10.0, 1.98, None, marks=pytest.mark.slow),
        pytest.param(0.24, 20.0, 2.19, None, marks=pytest.mark.slow),
    ],
)
def test_noise_before_the_comparator_has_the_rate_and_the_signs_of_fine_steps(
    share: float, hz: float, rate: float, opposite: float | None
) -> None:
    """Rates are those of steps of 50 us with the chance of a crossing between them, from .3 s on, mismatch .14."""
    side, seconds = 32, 2
    film = Film(np.full((240 * seconds + 1, side, side), 0.5, np.float32), 240)
    made = record(film, TrueCamera(0.2, 0.2, 0.14, band_share=share, band_hz=hz), 3)
    late = made["t"] > 300_000
    # Counts of a pixel spread by six times their mean.
    expected = rate * side**2 * (seconds - 0.3)
    assert abs(late.sum() - expected) < 0.12 * expected + 2 * math.sqrt(6 * expected)
    place = (made["y"] * side + made["x"])[late]
    order = np.argsort(place, kind="stable")
    turns = np.diff(made["p"][late][order].astype(int))[np.diff(place[order]) == 0] != 0
    assert turns.mean() > (opposite or 0.94) - 0.02


def gaps_of(made: Mapping[str, Any], width: int) -> npt.NDArray[np.int64]:
    """Return the intervals between events of a pixel, us."""
    place = made["y"] * width + made["x"]
    order = np.lexsort((made["t"], place))
    return np.asarray(np.diff(made["t"][order])[np.diff(place[order]) == 0])
