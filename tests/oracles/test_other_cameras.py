"""The noise of cameras outside the fitted family has the rates of the papers' equations."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from tests.oracles.cameras import Film
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
