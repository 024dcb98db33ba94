"""Band-limited noise: beside the continuous process, and what holds whatever is drawn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.accuracy.noise import Setup, distance, scene_of, simulated, true
from v2v_protocol.errors import RecipeError, UsageError
from v2v_protocol.recipe import MOST_BAND_PARTS, Recipe, most_events
from v2v_server.simulation import simulate
from v2v_server.simulation.effects.noise_band import LONGEST_BRIDGE, LONGEST_BULK, laws_of, moments
from v2v_server.simulation.voxel import bin_edges, timeline

STILL = np.full((61, 32, 32), 128, np.uint8)
NOISE: dict[str, Any] = {"threshold_pos": 0.2, "noise_band_share": 0.3, "noise_band_hz": 35.0, "bins": 5}


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["still", "sine", "ramp"])
@pytest.mark.parametrize(
    ("share", "corner_hz", "step_ms"),
    [(0.22, 35.0, 1), (0.22, 35.0, 8), (0.22, 35.0, 33), (0.3, 35.0, 8), (0.3, 10.0, 33), (0.3, 100.0, 33)],
)
def test_events_are_those_of_the_continuous_process(scene: str, share: float, corner_hz: float, step_ms: int) -> None:
    setup = Setup(scene, share, corner_hz, step_ms)
    frames = scene_of(setup)
    found, expected = simulated(setup, frames), true(setup, frames)
    assert (found.on + found.off).sum() == pytest.approx((expected.on + expected.off).sum(), rel=0.1)
    assert found.opposite / found.pairs == pytest.approx(expected.opposite / expected.pairs, abs=0.03)
    assert distance(found.on - found.off, expected.on - expected.off) < 0.04


@pytest.mark.parametrize("step_ms", [1.0, 4.0, 8.0, 33.0])
def test_the_end_of_a_step_is_exact(step_ms: float) -> None:
    """Variance and autocorrelation of the process x' = rho x + scale N."""
    h = 2 * math.pi * 35.0 * step_ms * 1e-3
    _, rho, scale, *_ = laws_of(np.array([h]), 0.05)[0]
    assert rho == pytest.approx(math.exp(-h), rel=1e-12)
    assert scale**2 / (1 - rho**2) == pytest.approx(0.05**2, rel=1e-12)


@given(st.floats(1e-3, 64.0))
def test_a_step_is_divided_where_no_form_of_the_law_has_it(h: float) -> None:
    corner_hz = h / (2 * math.pi * 0.5)
    whole = timeline(bin_edges(2, 1), 1, np.ones(2))
    count = len(moments(whole, np.full(2, 0.5), corner_hz).step) // 2
    assert h / count <= LONGEST_BRIDGE * (1 + 1e-9) or 2 * LONGEST_BRIDGE < h / count <= LONGEST_BULK * (1 + 1e-9)
    assert count == 1 or not (h <= LONGEST_BRIDGE or 2 * LONGEST_BRIDGE * (1 + 1e-9) < h <= LONGEST_BULK)


@pytest.mark.parametrize(("h", "count"), [(1.8, 2), (12.0, 2), (20.7, 3), (30.0, 4)])
def test_parts_of_a_step_are_those_of_shorter_grids(h: float, count: int) -> None:
    """The events, in bins of all steps and in bins of their parts, and between levels that move."""
    frames = np.random.default_rng(3).integers(90, 130, (9, 12, 16)).astype(np.uint8)
    asked = NOISE | {"bins": 1, "noise_band_hz": 30.0 * h / (2 * math.pi), "frames_per_second": 30.0, "dtype": "int16"}
    whole, fine = (simulate(frames, **asked, grids_per_frame=grids) for grids in (0, count))
    counts = fine.array("event_counts")
    assert counts.sum() > 1000
    np.testing.assert_array_equal(whole.array("event_counts"), counts.reshape(8, count, *counts.shape[1:]).sum(axis=1))
    np.testing.assert_array_equal(whole.to_events(4e6 / 120).t, fine.to_events(4e6 / 120 / count).t)


def test_signs_alternate_in_the_list_of_events() -> None:
    """Equal thresholds and one level: a still pixel flips between two thresholds."""
    events = simulate(STILL, **NOISE, frames_per_second=30.0).to_events(1e6 / 30)
    pixel = events.y.astype(np.int64) * events.width_px + events.x
    order = np.argsort(pixel, kind="stable")
    follows, sign = np.diff(pixel[order]) == 0, events.p[order]
    assert follows.sum() > 5000
    assert (sign[1:] != sign[:-1])[follows].mean() > 0.97


def test_a_pixel_is_blind_after_each_event() -> None:
    made = simulate(STILL, **NOISE, frames_per_second=30.0, refractory_seconds=0.004)
    events = made.to_events(1e6 / 30)
    order = np.lexsort((events.t, events.y.astype(np.int64) * events.width_px + events.x))
    pixel = (events.y.astype(np.int64) * events.width_px + events.x)[order]
    gaps_us = np.diff(events.t[order])[np.diff(pixel) == 0]
    assert len(gaps_us) > 1000
    assert gaps_us.min() >= 4000 - 2  # two times are rounded down


def test_arrays_count_the_events_of_the_list() -> None:
    made = simulate(STILL, **NOISE, frames_per_second=30.0, shot_noise_hz=3.0, dead_pixel_share=0.1)
    events, counts = made.to_events(1e6 / 30), made.array("event_counts")
    assert [(~events.p).sum(), events.p.sum()] == counts.sum(axis=(0, 2, 3, 4)).tolist()
    np.testing.assert_array_equal(counts[:, 1] - counts[:, 0], made.voxels)
    assert made.array("voxels_bilinear").sum() == pytest.approx(made.voxels.sum(), abs=1.0)


def test_the_bound_of_events_holds_for_the_loudest_noise() -> None:
    made = simulate(STILL[:21], **NOISE | {"noise_band_share": 10.0, "noise_band_hz": 1e4}, frames_per_second=30.0)
    most = made.array("event_counts").sum(axis=(0, 1, 2)).max()
    quiet = most_events(made.given.segments, (0.0, 0.0), (0.2, 0.2), 0.0)
    assert quiet < most <= most_events(made.given.segments, (0.0, 0.0), (0.2, 0.2), 0.0, *made.given.worst)
    recipe = Recipe(noise_band_share=(0.0, 0.1), noise_band_hz=(10.0, 1e4))
    assert made.given.segments == 20 * MOST_BAND_PARTS == recipe.most_segments(20)


def test_noise_without_a_corner_is_refused() -> None:
    with pytest.raises(UsageError, match=r"noise_band_share = 0\.3: set noise_band_hz"):
        simulate(STILL, **NOISE | {"noise_band_hz": 0.0}, frames_per_second=30.0)
    with pytest.raises(RecipeError, match="set noise_band_hz"):
        Recipe(noise_band_share=(0.1, 0.2))
