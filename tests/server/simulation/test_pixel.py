"""The kernel against its numpy definition (bit for bit) and against the slow oracle."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.noise import standard_normals, start_uniforms
from tests.server.simulation import oracle, reference
from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import pixel, simulate, simulate_clip, simulate_log
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.voxel import rounding_tolerance

LOG_RANGE = 6.9


def moving_frames(count: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    """Drifting texture: smooth, with steps at some pixels; the same bytes under every numpy."""
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    return np.stack(
        [((row * 3 + column * 5 + t * 7 + seed + (row * column * (t // 4)) % 17) % 256).astype(np.uint8)
         for t in range(count)]
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    voxels=st.integers(1, 3),
    bins=st.integers(1, 3),
    frames_per_bin=st.integers(1, 3),
    thresholds=st.tuples(st.floats(1e-3, 3.0), st.floats(1e-3, 3.0)),
    noise_sigma=st.sampled_from([0.0, 0.01, 0.1, 1.0]),
    hot_share=st.sampled_from([0.0, 0.05, 1.0]),
    dtype=st.sampled_from(["int8", "int16", "float32"]),
    seconds=st.booleans(),
    pause=st.booleans(),
    key=st.tuples(*[st.integers(0, 2**32 - 1)] * 4),
)
def test_kernel_equals_its_numpy_definition(
    height: Any,
    width: Any,
    voxels: Any,
    bins: Any,
    frames_per_bin: Any,
    thresholds: Any,
    noise_sigma: Any,
    hot_share: Any,
    dtype: Any,
    seconds: Any,
    pause: Any,
    key: Any,
) -> None:
    recipe = Recipe(
        voxels_per_clip=voxels, bins=bins, frames_per_bin=frames_per_bin, crop_height_px=height, crop_width_px=width,
        noise_unit="second" if seconds else "frame",
    )  # fmt: skip
    threshold_pos, threshold_neg = (float(np.float32(c)) for c in thresholds)
    hot_count = int(hot_share * height * width)
    pauses = ((1, max(1, recipe.steps // 2)),) if pause else ()
    params = SampleParams(threshold_pos, threshold_neg, noise_sigma, hot_count, 3.0, pauses, 1.0, 0, 0, False, 0.0, key)
    frames = moving_frames(recipe.frames_needed, height, width)
    step_seconds = np.linspace(0.01, 0.5, recipe.steps) if seconds else None
    got = simulate_clip(frames, params, recipe, dtype, step_seconds)

    shown = frames[params.source_index(recipe.steps)].reshape(recipe.steps + 1, -1)
    durations = np.ones(recipe.steps) if step_seconds is None else step_seconds
    expected, saturated = reference.simulate(
        log_table(2.2, 1e-3)[shown],
        key,
        threshold_pos=threshold_pos,
        threshold_neg=threshold_neg,
        noise_scale=noise_sigma * np.sqrt(durations) if noise_sigma else None,
        hot_count=hot_count,
        hot_sigma=3.0,
        hot_scale=durations,
        frames_per_bin=frames_per_bin,
        dtype=dtype,
    )
    assert got.voxels.shape == (voxels, bins, height, width)
    assert got.voxels.dtype == dtype
    np.testing.assert_array_equal(got.voxels.reshape(expected.shape), expected)
    assert got.saturated_bins == saturated


@numba.njit
def look_up(table: Any, row: Any, coming: Any, levels: Any) -> None:
    pixel.look_up(table, row, coming, levels)


@pytest.mark.parametrize("real", [np.float32, np.float64], ids=["permuted", "portable"])
def test_look_up_is_indexing_and_writes_nothing_else(real: Any) -> None:
    """float32 takes the way of the processor's permutations where there are any, float64 never."""
    table = np.random.default_rng(0).permutation(256).astype(real) - real(0.5)
    row = np.random.default_rng(1).permutation(np.arange(1024) % 256).astype(np.uint8)
    for width in (*range(70), 256, 511, 512):
        shown = row[width % 7 :][:width]  # at any address, not only at that of a vector
        levels = np.full(600, np.nan, real)
        look_up(table, shown, shown[::-1].copy(), levels)
        np.testing.assert_array_equal(levels[:width], table[shown])
        assert np.isnan(levels[width:]).all()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(("height", "width"), [(16, 32), (31, 33), (1, 1), (1, 513), (1, 1025), (32, 48)])
def test_log_frames_of_any_size_and_precision_equal_the_definition(precision: Any, height: Any, width: Any) -> None:
    steps = 15
    level = np.sin(np.arange((steps + 1) * height * width) * 0.37).reshape(steps + 1, height, width) * 2
    got = simulate_log(
        level, threshold_pos=0.1, threshold_neg=0.15, noise_sigma=0.2, hot_pixel_count=1, hot_pixel_sigma=2.0,
        bins=3, seed=5, dtype="float32", precision=precision,
    )  # fmt: skip
    expected, _ = reference.simulate(
        level.reshape(steps + 1, -1).astype(precision), noise_key_of_seed(5), threshold_pos=0.1, threshold_neg=0.15,
        noise_scale=np.full(steps, 0.2), hot_count=1, hot_sigma=2.0, hot_scale=np.ones(steps), frames_per_bin=1,
        dtype="float32",
    )  # fmt: skip
    np.testing.assert_array_equal(got.voxels.reshape(steps, -1), expected)


@pytest.mark.parametrize(
    ("threshold", "thresholds_crossed", "steps"),
    [
        (threshold, crossed, steps)
        for threshold in (0.05, 0.1, 0.2, 1 / 3, 0.7, 1.0, 2.0)
        for crossed, steps in ((20, 10), (20, 40), (3, 30), (2, 200), (1, 50), (100, 50))
        if threshold * crossed < LOG_RANGE
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_ramp_of_k_thresholds_gives_k_events(
    threshold: float, thresholds_crossed: int, steps: int, sign: int
) -> None:
    threshold = float(np.float32(threshold))
    height = threshold * thresholds_crossed
    ramp = height * np.arange(steps + 1) / steps
    offsets = np.linspace(-LOG_RANGE, -height, 400) if sign > 0 else np.linspace(height - LOG_RANGE, 0.0, 400)
    frames = (offsets + sign * ramp[:, None])[:, None, :]
    got = simulate_log(frames, threshold_pos=threshold, bins=5, start_residual=0.0, dtype="int16")
    np.testing.assert_array_equal(got.voxels.sum((0, 1, 2)), np.full(400, sign * thresholds_crossed))


def test_a_ramp_of_two_log_units_at_a_tenth_gives_twenty_events() -> None:
    ramp = np.broadcast_to(np.linspace(-5, -3, 11)[:, None, None], (11, 64, 65))
    voxels = simulate_log(ramp, threshold_pos=0.1, bins=5, start_residual=0.0).voxels
    np.testing.assert_array_equal(voxels, np.full((2, 5, 64, 65), 2))
    # With the paper's random start, a pixel that starts below zero has to climb back first.
    total = simulate_log(ramp, threshold_pos=0.1, bins=5, seed=4).voxels.sum((0, 1)).ravel()
    start = start_uniforms(noise_key_of_seed(4), 64 * 65)
    np.testing.assert_array_equal(total, np.where(start >= 0.5, 20, 19))


def test_a_static_scene_is_silent_after_the_first_bin() -> None:
    frames = np.broadcast_to(moving_frames(1, 64, 64), (21, 64, 64))
    voxels = simulate(frames, threshold_pos=0.1, threshold_neg=0.13, bins=5).voxels.reshape(20, 64, 64)
    assert not voxels[1:].any()
    assert np.count_nonzero(voxels[0]) <= 1


def test_equal_thresholds_swap_polarity_with_inverted_intensity() -> None:
    level = np.cumsum(np.cos(np.arange(51 * 200) * 1.7).reshape(51, 10, 20), axis=0)
    up = simulate_log(level, threshold_pos=0.1, threshold_neg=0.2, bins=1, dtype="float32").voxels
    down = simulate_log(-level, threshold_pos=0.2, threshold_neg=0.1, bins=1, dtype="float32").voxels
    # The start of the residual is mirrored too, so only totals are comparable, to one event.
    assert np.abs(up.sum((0, 1)) + down.sum((0, 1))).max() <= 10
    key = noise_key_of_seed(0)
    start = start_uniforms(key, 200).astype(np.float64)
    forward = oracle.simulate(
        level.reshape(51, -1), np.zeros((50, 200)), start, threshold_pos=0.1, threshold_neg=0.2, tolerance=0.0
    )
    mirrored = oracle.simulate(
        -level.reshape(51, -1), np.zeros((50, 200)), 1 - start, threshold_pos=0.2, threshold_neg=0.1, tolerance=0.0
    )
    np.testing.assert_array_equal(forward.voxels, -mirrored.voxels)
    np.testing.assert_array_equal(forward.voxels, up.reshape(50, 200))


def test_events_account_for_every_change() -> None:
    steps, pixels = 60, 150
    level = oracle.log_intensity(moving_frames(steps + 1, 10, 15).reshape(steps + 1, -1), 2.2, 1e-3)
    key = noise_key_of_seed(3)
    normals = standard_normals(key, steps, pixels).astype(np.float64) * 0.1
    start = start_uniforms(key, pixels).astype(np.float64)
    trace = oracle.simulate(
        level, normals, start, threshold_pos=0.2, threshold_neg=0.3, tolerance=rounding_tolerance(0.2, 0.3)
    )
    change = level[-1] - level[0] + normals.sum(0)
    np.testing.assert_allclose(trace.signed_change, change + trace.residual_start - trace.residual_end, atol=1e-12)
    assert -0.3 < trace.residual_low < trace.residual_high < 0.2
    # The kernel's voxels leave a residual in the same range: conservation seen from outside.
    got = simulate(
        moving_frames(steps + 1, 10, 15), threshold_pos=0.2, threshold_neg=0.2, noise_sigma=0.1, bins=1, seed=3,
        dtype="float32",
    )  # fmt: skip
    equal = oracle.simulate(
        level, normals, start, threshold_pos=0.2, threshold_neg=0.2, tolerance=rounding_tolerance(0.2, 0.2)
    )
    left = equal.residual_start + change - 0.2 * got.voxels.reshape(steps, -1).sum(0)
    assert np.abs(left).max() < 0.2 + 1e-5


def test_a_paused_camera_sees_noise_but_no_change() -> None:
    recipe = Recipe(voxels_per_clip=4, crop_height_px=32, crop_width_px=32)
    frames = moving_frames(2, 32, 32)
    paused = ((2, recipe.steps - 1),)
    still = SampleParams(0.1, 0.1, 0.0, 0, 0.0, paused, 1.0, 0, 0, False, 0.0, (9, 8, 7, 6))
    voxels = simulate_clip(frames, still, recipe, "int8").voxels.reshape(recipe.steps, 32, 32)
    assert voxels[0].any()
    assert not voxels[1:].any()
    noisy = SampleParams(0.1, 0.1, 0.1, 0, 0.0, paused, 1.0, 0, 0, False, 0.0, (9, 8, 7, 6))
    voxels = simulate_clip(frames, noisy, recipe, "int8").voxels.reshape(recipe.steps, 32, 32)
    assert all(step.any() for step in voxels)


@pytest.mark.parametrize(("dtype", "limit"), [("int8", 127), ("int16", 32767)])
def test_saturation_is_clipped_and_counted_never_wrapped(dtype: Any, limit: Any) -> None:
    step = limit * 1.5 * 0.05
    level = np.stack([np.zeros((1, 3)), [[step, -step, 0.01]], np.zeros((1, 3))])
    got = simulate_log(level, threshold_pos=0.05, bins=1, dtype=dtype)
    assert got.voxels[:, 0, 0, :2].tolist() == [[limit, -limit], [-limit, limit]]
    assert got.saturated_bins == 4
    exact = simulate_log(level, threshold_pos=0.05, bins=1, dtype="float32")
    assert exact.saturated_bins == 0
    assert abs(exact.voxels[0, 0, 0, 0] - limit * 1.5) <= 1


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("frames_per_bin", [1, 3])
@pytest.mark.parametrize(("dtype", "limit"), [("int8", 127), ("int16", 32767)])
def test_saturation_in_some_blocks_equals_the_definition(
    dtype: Any, limit: Any, frames_per_bin: Any, precision: Any
) -> None:
    """Counts just below, at and beyond the limit; in the second of three blocks and in the narrow last one only."""
    width, steps, threshold = 2 * pixel.PIXELS_A_BLOCK + 21, 4 * frames_per_bin, 2.0**-4
    level = np.zeros((steps + 1, width))
    for place, beyond in ((pixel.PIXELS_A_BLOCK, 0), (pixel.PIXELS_A_BLOCK + 17, 1), (width - 6, 2), (width - 1, -1)):
        jump = (limit + beyond) * threshold
        level[frames_per_bin : 2 * frames_per_bin, place] = jump
        level[3 * frames_per_bin :, place] = -jump
    got = simulate_log(
        level[:, None, :], threshold_pos=threshold, threshold_neg=2 * threshold, start_residual=None, bins=2,
        frames_per_bin=frames_per_bin, seed=1, dtype=dtype, precision=precision,
    )  # fmt: skip
    expected, saturated = reference.simulate(
        level.astype(precision), noise_key_of_seed(1), threshold_pos=threshold, threshold_neg=2 * threshold,
        noise_scale=None, hot_count=0, hot_sigma=0.0, hot_scale=np.ones(steps), frames_per_bin=frames_per_bin,
        dtype=dtype,
    )  # fmt: skip
    np.testing.assert_array_equal(got.voxels.reshape(expected.shape), expected)
    assert got.saturated_bins == saturated > 0
    assert np.abs(expected[:, : pixel.PIXELS_A_BLOCK]).max() < limit


def test_hot_pixels_fire_and_no_other_pixel_does() -> None:
    frames = np.full((11, 50, 50), 80, np.uint8)
    got = simulate(frames, threshold_pos=0.5, hot_pixel_count=25, hot_pixel_sigma=50.0, seed=2, dtype="float32").voxels
    position, normal = hot_pixels(noise_key_of_seed(2), 25, 2500)
    total = got.sum((0, 1)).ravel()
    # One threshold either way for where the residual starts, one for where it ends.
    np.testing.assert_allclose(total[position], normal * 50.0 / 0.5 * 10, atol=2)
    total[position] = 0
    assert np.count_nonzero(total) <= 1


GOLDEN = {
    "int8": "0531ffcd2b89f671c0b418e0b11865d09ba1ddc1c2c9b53e42a2e79cd50932f9",
    "int16": "59eb5b9ab91e11864cffa9dafe53345b0a3dc2b99cd9f99db0e7be8a7d88ac27",
    "float32": "b345133d41b778fcede9908d375dea828f4e3225b122fb1a0e7d023f7c02859a",
}


def digest(dtype: str) -> str:
    """Digest of the voxels and saturated bins of one fixed clip with every effect on."""
    recipe = Recipe(voxels_per_clip=6, frames_per_bin=2, crop_height_px=37, crop_width_px=45)
    params = SampleParams(
        0.05000000074505806, 0.06499999761581421, 0.07, 9, 5.0, ((11, 7), (40, 3)), 1.0, 0, 0, False, 0.0,
        (0x01234567, 0x89ABCDEF, 0xDEADBEEF, 0x00C0FFEE),
    )  # fmt: skip
    voxels, saturated = simulate_clip(moving_frames(61, 37, 45), params, recipe, dtype)
    return hashlib.sha256(voxels.astype(voxels.dtype.newbyteorder("<")).tobytes() + str(saturated).encode()).hexdigest()


@pytest.mark.parametrize("dtype", sorted(GOLDEN))
def test_golden_voxels(dtype: Any) -> None:
    assert digest(dtype) == GOLDEN[dtype]


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS)
def test_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    code = "from tests.server.simulation.test_pixel import digest; print(digest('int8')); print(digest('float32'))"
    assert printed_on_a_generic_processor(code, tmp_path) == [GOLDEN["int8"], GOLDEN["float32"]]
