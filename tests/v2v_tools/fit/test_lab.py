"""The test bench measures what the camera was told to be."""

from __future__ import annotations

import math

import pytest

from v2v_protocol.recipe import preset
from v2v_tools.fit.lab import camera_of, measure, table

PLAIN = {"threshold_pos": 0.2, "threshold_neg": 0.25, "log_eps": 0.01, "gamma": 2.2}


@pytest.mark.slow
def test_thresholds_spread_noise_and_refractory_period_are_measured() -> None:
    effects = {"threshold_mismatch_sigma": 0.1, "shot_noise_hz": 4.0, "leak_hz": 0.5, "refractory_seconds": 2e-3}
    found = measure({**PLAIN, **effects})
    assert found["threshold_on"] == pytest.approx(0.2, rel=0.04)
    assert found["threshold_off"] == pytest.approx(0.25, rel=0.04)
    assert found["threshold_spread"] == pytest.approx(0.1, rel=0.2)
    assert found["refractory_us"] == pytest.approx(2000, rel=0.15)
    assert found["background_dark_hz"] > 3.0 > found["background_bright_hz"] > 1.0


@pytest.mark.slow
def test_a_low_pass_delays_the_dark_more_and_limits_the_bandwidth() -> None:
    slow = measure({**PLAIN, "photoreceptor_hz": 30.0})
    quick = measure({**PLAIN, "photoreceptor_hz": 300.0})
    assert slow["latency_dark_us"] > slow["latency_bright_us"] > 2 * quick["latency_bright_us"]
    assert quick["bandwidth_bright_hz"] == pytest.approx(10 * slow["bandwidth_bright_hz"], rel=0.3)
    assert quick["refractory_us"] < 100


def test_the_camera_of_a_recipe_is_the_middle_of_its_ranges() -> None:
    camera = camera_of(preset("davis346"))
    assert camera["threshold_pos"] == pytest.approx((0.134 + 0.405) / 2)
    assert camera["leak_hz"] == pytest.approx(0.125)


def test_the_table_has_a_column_for_each_camera_and_a_dash_for_what_is_missing() -> None:
    text = table({"recipe": {"threshold_on": 0.2, "latency_dark_us": math.nan}, "sheet": {"threshold_on": 0.25}})
    lines = text.splitlines()
    assert lines[0].split() == ["recipe", "sheet"]
    assert lines[1].split() == ["threshold_on", "0.2", "0.25"]
    assert lines[2].split() == ["latency_dark_us", "-", "-"]
