"""The oracles of the physics bench against results worked out by hand, and its error measures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.accuracy import physics
from tests.clips import panned_luma, write_clip
from tests.oracles.analytic_scenes import PIXELS, START_SHARE, analytic_scenes, moved_photograph
from tests.oracles.dense import bin_events, dense_events
from tests.oracles.rendered import log_levels
from tests.server.simulation import oracle
from v2v_protocol.errors import UsageError


def test_a_ramp_fires_at_known_times() -> None:
    events = dense_events(np.array([[0.0], [2.05]]), np.array([10.0, 20.0]), np.zeros(1), 0.1, 0.1)
    assert len(events.seconds) == 20
    np.testing.assert_allclose(events.seconds, 10 + 10 * np.arange(1, 21) * 0.1 / 2.05)
    assert (events.polarity == 1).all()
    # A residual brings every event forward by as much; falling events count from -c.
    early = dense_events(np.array([[0.0], [2.05]]), np.array([10.0, 20.0]), np.full(1, 0.06), 0.1, 0.1)
    np.testing.assert_allclose(early.seconds, 10 + 10 * (np.arange(1, 22) * 0.1 - 0.06) / 2.05)
    falling = dense_events(np.array([[0.0], [-1.0]]), np.array([0.0, 1.0]), np.zeros(1), 0.1, 0.3)
    np.testing.assert_allclose(falling.seconds, [0.3, 0.6, 0.9])
    assert falling.polarity.tolist() == [-1, -1, -1]


def test_dense_events_are_those_of_the_oracle() -> None:
    level = np.cumsum(np.random.default_rng(0).normal(0, 0.4, (41, 30)), axis=0)
    start = np.random.default_rng(1).random(30)
    expected = oracle.simulate(level, np.zeros((40, 30)), start, threshold_pos=0.2, threshold_neg=0.3, tolerance=0.0)
    events = dense_events(level, np.arange(41.0), expected.residual_start, 0.2, 0.3)
    np.testing.assert_array_equal(bin_events(events, np.arange(41.0), 30), expected.voxels)
    assert len(events.seconds) == np.abs(expected.voxels).sum()
    for p in range(30):
        assert (np.diff(events.seconds[events.pixel == p]) >= 0).all()


def test_an_event_at_an_edge_belongs_to_the_bin_that_ends_there() -> None:
    events = dense_events(np.array([[0.0], [1.0], [2.0]]), np.arange(3.0), np.zeros(1), 1.0, 1.0)
    assert bin_events(events, np.array([0.0, 1.0, 2.0]), 1).ravel().tolist() == [1, 1]
    assert bin_events(events, np.array([1.0, 2.0]), 1).ravel().tolist() == [1]


@pytest.mark.slow
@pytest.mark.parametrize("scene", analytic_scenes(), ids=lambda scene: scene.name)
def test_scenes_hold_the_events_of_a_very_fine_simulation(scene: Any) -> None:
    edges = np.linspace(0.0, 1.0, 26)
    true, count = scene.events(edges, 0.23)
    times = np.linspace(0.0, 1.0, 20_001)
    fine = dense_events(scene.level(times[:, None]), times, np.full(PIXELS, START_SHARE * 0.23), 0.23, 0.23)
    binned = bin_events(fine, edges, PIXELS)
    # The fine simulation misses a turn by 2.5e-5 s at most: a crossing there is lost in a pixel here and there.
    assert np.abs(binned - true).max() <= 1
    assert np.count_nonzero(binned != true) <= 1e-3 * true.size
    assert abs(len(fine.seconds) - count) <= 1e-3 * count


def test_ramps_jumps_and_sinusoids_have_the_counts_of_their_formulas() -> None:
    edges, by_name = np.linspace(0.0, 1.0, 11), {scene.name: scene for scene in analytic_scenes()}
    each = np.linspace(0.0, 1.0, PIXELS)
    up, _ = by_name["ramp up, 0.5 to 6 log units"].events(edges, 0.23)
    np.testing.assert_array_equal(up.sum(0), np.floor((0.5 + 5.5 * each) / 0.23 + START_SHARE))
    jump, _ = by_name["jump of -5 to 5 log units"].events(edges, 0.23)
    height = 10.0 * each - 5.0
    np.testing.assert_array_equal(jump[4], np.trunc(height / 0.23 + START_SHARE))
    assert not np.delete(jump, 4, axis=0).any()
    # In thresholds, a lamp rises from 0 to ``top``, goes 199 times between that and ``bottom``, and rises to 0 again.
    _, events = by_name["lamp at 100 Hz, contrast 0.9"].events(edges, 0.23)
    top = math.floor(math.log(1.9) / 0.23 + START_SHARE)
    bottom = math.ceil(math.log(0.1) / 0.23 + START_SHARE)
    assert events == PIXELS * (top + 199 * (top - bottom) - bottom)


def test_errors_by_hand() -> None:
    fine = np.array([[2, 0], [-1, 0], [0, 3], [0, 0]])
    found = physics.errors(fine, np.array([[1, 1], [0, 3]]), 8, 2)
    assert found["events_v2v"] == 6
    assert found["count_error"] == -0.25
    assert found["voxel_error"] == 0.2
    assert found["differing_bins_ppm"] == 250_000


@pytest.mark.slow
def test_all_frames_of_a_film_give_the_events_of_all_frames() -> None:
    frames = np.rint(moved_photograph("coffee", 49, 40, 50, 0.3) * 255).astype(np.uint8)
    for threshold in (0.1, 0.5):
        level = log_levels(frames / 255.0).reshape(49, -1)
        true, events = physics.true_bins(level, 24, threshold)
        every = physics.errors(physics.v2v_steps(frames, threshold), true, events, 2)
        assert every["differing_bins_ppm"] <= physics.LARGEST_DIFFERENCE_PPM
        fewer = physics.errors(physics.v2v_steps(frames[::8], threshold), true, events, 2)
        assert fewer["count_error"] < 0
        assert 0 < fewer["voxel_error"] < 0.5


@pytest.mark.slow
def test_signed_sums_of_few_frames_are_off_by_one_at_most() -> None:
    # Both sides have a residual below one threshold and have seen the same change: no frame rate can lose more.
    frames = np.rint(moved_photograph("camera", 97, 40, 50, 2.0) * 255).astype(np.uint8)
    true, _ = physics.true_bins(log_levels(frames / 255.0).reshape(97, -1), 24, 0.1)
    few = physics.v2v_steps(frames[::24], 0.1)
    assert np.abs(np.cumsum(few, axis=0, dtype=np.int64) - np.cumsum(true, axis=0)).max() == 1


@pytest.mark.slow
def test_analytic_records_hold_their_bar() -> None:
    records = list(physics.analytic())
    assert physics.missed(records) == []
    lamp = [r for r in records if r["scene"].startswith("lamp") and r["frame_rate_hz"] <= 200]
    assert all(r["count_error"] == -1.0 for r in lamp)
    # Not every scene is easy: 25 frames a second of 12 Hz lose a third of the events.
    assert min(r["count_error"] for r in records if "12 Hz" in r["scene"]) < -0.3


def test_bars_can_be_missed() -> None:
    monotone = {"measure": "analytic", "monotone": True, "scene": "ramp", "frame_rate_hz": 25, "count_error": 0.0}
    assert len(physics.missed([monotone | {"voxel_error": 0.1}])) == 1
    film = {"measure": "film", "every": 1, "threshold": 0.1}
    assert len(physics.missed([film | {"differing_bins_ppm": 61.0}])) == 1
    assert physics.missed([film | {"differing_bins_ppm": 60.0}, monotone | {"voxel_error": 0.0}]) == []


def test_a_film_that_is_too_short_or_small_is_refused(tmp_path: Path) -> None:
    short = write_clip(tmp_path / "short.mp4", panned_luma(10))
    with pytest.raises(UsageError, match="10 frames; give more than 16"):
        list(physics.filmed(short))
    small = write_clip(tmp_path / "small.mp4", panned_luma(20))
    with pytest.raises(UsageError, match="64x48 pixels; give at least 320x320"):
        list(physics.filmed(small))


def test_first_grids_are_nearest_after_frames_then_with_the_triangular_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(physics, "VIDEO_SIDE_PX", 48)
    luma = np.rint(255.0 * moved_photograph("coffee", 2 * physics.LONG_RUN_IN, 48, 48, 0.25)).astype(np.uint8)
    records = list(physics.started(write_clip(tmp_path / "a.mkv", luma, codec="ffv1", pixel_format="gray")))
    assert [(each["threshold"], each["run_in"]) for each in records] == [(0.2, 5), (0.5, 5)]
    assert physics.missed(records) == []
    swapped = [each | {"frames": each["triangular"], "triangular": each["frames"]} for each in records]
    assert len(physics.missed(swapped)) == 2
