"""Effects that change little of a clip are left out of it, and the rest of the clip stays as it is."""

from __future__ import annotations

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.server.simulation.test_times import real_frames
from v2v_protocol.recipe import Recipe
from v2v_server.simulation.clip import COSTS, changed_shares, left_out, simulate_clip
from v2v_server.simulation.draw import draw
from v2v_server.simulation.kernels import Voxels

CAMERA = Recipe(
    crop_height_px=64, crop_width_px=64, pause_probability=0.0102, noise_sigma=0.0,
    hot_pixel_share=(0.0, 5e-4), noise_unit="second", threshold=(0.1, 0.4), threshold_mismatch_sigma=(0.02, 0.1),
    photoreceptor_hz=(2e3, 2e4), refractory_seconds=(1e-7, 1e-5), shot_noise_hz=(0.0, 0.002), leak_hz=(0.0, 0.002),
    dead_pixel_share=(0.0, 1e-4),
)  # fmt: skip
"""A fast camera in bright light."""
VIDEOS = (
    "gopro_hero7_walk.mp4", "gopro_karma_drone.mp4", "intel_asl_walk.mkv", "mei_phone_geese_vfr.mp4",
    "lerobot_chess_av1.mp4", "mdn_stream-of-water.mp4", "osp_diabolo_240fps.mp4", "mdn_flower.mp4",
)  # fmt: skip


def moving(count: int, side: int, seed: int) -> np.ndarray:
    """Return a bright texture that moves by a pixel and more a frame, [count, side, side]."""
    random = np.random.default_rng(seed)
    x = np.arange(side)
    y = x[:, None]
    speed, waves = random.uniform(0.5, 3.0, 2), random.uniform(0.1, 0.5, (6, 2))
    grey = [
        160 + sum(15 * np.sin(u * (x - speed[0] * t) + v * (y - speed[1] * t)) for u, v in waves) for t in range(count)
    ]
    return np.clip(grey, 0, 255).astype(np.uint8)


def simulated(frames: np.ndarray, index: int, tolerance: float, camera: Recipe = CAMERA) -> Voxels:
    side, camera = frames.shape[1], camera.replace(voxels_per_clip=len(frames) // 5)
    params = draw(camera, seed=1, epoch=0, index=index, picture_height_px=side, picture_width_px=side, video_id="")
    return simulate_clip(frames, params, camera, "int8", np.full(len(frames) - 1, 0.04), tolerance=tolerance)


def error(index: int, frames: np.ndarray) -> tuple[float, int]:
    """Return the share of voxel content that a tolerance of 1 % changes, and the number of effects left out."""
    full, part = simulated(frames, index, 0.0), simulated(frames, index, 0.01)
    of = full.voxels.astype(int)
    gone = full.given.params.effects.keys() - part.given.params.effects.keys()
    assert not gone & {"threshold_mismatch_sigma", "dead_pixel_share"}
    if not gone:
        np.testing.assert_array_equal(part.voxels, full.voxels)
    return float(np.abs(of - part.voxels).sum() / np.abs(of).sum()), len(gone)


def test_the_changed_share_is_within_the_tolerance() -> None:
    errors, gone = zip(*(error(index, moving(101, 64, index)) for index in range(8)), strict=True)
    assert max(errors) <= 0.01
    assert sum(gone) >= 8


@pytest.mark.slow
def test_forty_sequences_of_real_footage() -> None:
    errors, gone = [], 0
    for video in VIDEOS:
        frames = real_frames(video, 81, (64, 64))
        for index in range(5):
            changed, without = error(index, frames)
            errors.append(changed)
            gone += without
    assert sum(changed <= 0.01 for changed in errors) >= 38
    assert max(errors) <= 0.02
    assert gone >= 40


def test_without_tolerance_every_effect_runs() -> None:
    frames = moving(101, 64, 3)
    effects = simulated(frames, 0, 0.0).given.params.effects
    slow = CAMERA.replace(photoreceptor_hz=30.0, refractory_seconds=1e-3, shot_noise_hz=5.0, leak_hz=0.2)
    assert set(COSTS) < set(effects)
    assert set(COSTS) < set(simulated(frames, 0, 0.01, slow).given.params.effects)


def test_a_still_clip_keeps_its_effects() -> None:
    frames = np.full((101, 64, 64), 90, np.uint8)
    assert changed_shares(simulated(frames, 0, 0.0).given) == {}
    assert set(COSTS) < set(simulated(frames, 0, 0.5).given.params.effects)


def test_the_choice_does_not_depend_on_the_dtype_or_the_arithmetic() -> None:
    given = simulated(moving(101, 64, 5), 2, 0.0).given
    shares = changed_shares(given)
    assert shares.keys() == COSTS.keys()
    assert changed_shares(dataclasses.replace(given, dtype="int16")) == shares


_shares = st.dictionaries(st.sampled_from(sorted(COSTS)), st.floats(0.0, 0.1))


@given(_shares, st.floats(1e-6, 0.2))
def test_the_most_expensive_set_that_fits_is_left_out(shares: dict[str, float], tolerance: float) -> None:
    chosen = left_out(shares, tolerance)
    assert sum(sorted(shares[name] for name in chosen)) <= tolerance * (1 + 1e-9)
    cost = sum(COSTS[name] for name in chosen)
    for count in range(1, len(shares) + 1):
        for names in combinations(shares, count):
            if sum(shares[name] for name in names) < tolerance * (1 - 1e-9):
                assert sum(COSTS[name] for name in names) <= cost
