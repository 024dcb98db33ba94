"""Effects beyond the paper's pixel: the kernel against the slow oracle, and what leaving each one out costs."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.noise import mismatch_normals, shot_words, standard_normals, start_uniforms
from tests.server.simulation import effect_oracle
from tests.server.simulation.effect_oracle import Camera, Chance
from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from tests.server.simulation.test_pixel import moving_frames
from tests.server.simulation.test_times import again
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LARGEST_NORMAL, Recipe, preset
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import simulate, simulate_clip
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.effects import dead_pixels, photoreceptor, shot_noise
from v2v_server.simulation.intensity import exponential, linear_light, log_table_float64
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.voxel import rounding_tolerance

GAMMA, LOG_EPS, FPS = 2.2, 1e-3, 25.0
Effects = dict[str, float]


def effects_of(
    mismatch: float = 0.0, shot: float = 0.0, leak: float = 0.0, blind: float = 0.0, corner: float = 0.0,
    dead: float = 0.0,
) -> Effects:  # fmt: skip
    """A draw: those that are on."""
    values = {
        "threshold_mismatch_sigma": mismatch, "shot_noise_hz": shot, "leak_hz": leak, "refractory_seconds": blind,
        "photoreceptor_hz": corner, "dead_pixel_share": dead,
    }  # fmt: skip
    return {name: value for name, value in values.items() if value > 0.0}


ALL = effects_of(0.15, 20.0, 3.0, 0.005, 20.0, 2 / (37 * 45))


def params_of(effects: Effects, seed: int = 0, **changes: Any) -> SampleParams:
    plain = SampleParams(0.2, 0.25, 0.0, 0, 0.0, (), 1.0, 0, 0, False, 0.0, noise_key_of_seed(seed), effects)
    return dataclasses.replace(plain, **changes)


def tolerance_of(effects: Effects) -> float:
    smallest = 0.2 * max(1 - LARGEST_NORMAL * effects.get("threshold_mismatch_sigma", 0.0), 0.25)
    return rounding_tolerance(smallest, smallest)


some_effects = st.builds(
    effects_of,
    mismatch=st.sampled_from((0.0, 0.1, 0.9)),
    shot=st.sampled_from((0.0, 3.0, 300.0)),
    leak=st.sampled_from((0.0, 0.1, 40.0)),
    blind=st.sampled_from((0.0, 1e-4, 0.01, 0.1)),
    corner=st.sampled_from((0.0, 1.0, 100.0)),
    dead=st.sampled_from((0.0, 0.02, 0.5)),
)


@pytest.mark.parametrize("precision", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])  # another kernel
@settings(max_examples=60, deadline=None)
@given(effects=some_effects, noise_sigma=st.sampled_from([0.0, 0.1]), seed=st.integers(0, 2**64 - 1))
def test_kernel_equals_the_oracle(precision: Any, effects: Effects, noise_sigma: float, seed: int) -> None:
    """Event by event in continuous time, with steps of three lengths."""
    recipe = Recipe(voxels_per_clip=3, crop_height_px=6, crop_width_px=8, noise_unit="second")
    steps, pixels, frames = recipe.steps, 48, moving_frames(recipe.steps + 1, 6, 8, seed % 256)
    durations = np.array([0.02, 0.04, 0.1])[np.arange(steps) % 3]
    params = params_of(effects or ALL, seed, noise_sigma=noise_sigma, hot_pixel_count=2, hot_pixel_sigma=3.0)
    effects, key = params.effects, params.noise_key
    change = standard_normals(key, steps, pixels).astype(np.float64) * noise_sigma * np.sqrt(durations)[:, None]
    position, normal = hot_pixels(key, 2, pixels)
    change[:, position] += 3.0 * normal.astype(np.float64) * durations[:, None]
    shot = np.stack(shot_words(key, steps, pixels)).astype(np.float64) * 2.0**-32
    chance = Chance(
        start_uniforms(key, pixels).astype(np.float64),
        change,
        np.stack(mismatch_normals(key, pixels)).astype(np.float64),
        shot,
        dead_pixels.positions(key, effects.get("dead_pixel_share", 0.0), pixels),
    )
    camera = Camera(
        0.2, 0.25, tolerance_of(effects), **{name: effects[name] for name in effects if name != "dead_pixel_share"}
    )
    expected = effect_oracle.simulate(frames.reshape(-1, pixels), durations, GAMMA, LOG_EPS, camera, chance)
    made = simulate_clip(frames, params, recipe, "float32", durations)
    voxels = again(made, "voxels", precision=precision)["voxels"]
    # float32 against float64: an event that is due at the end of a step may fall into the next.
    wrong = np.abs(voxels.reshape(steps, pixels) - expected)
    assert np.count_nonzero(wrong) <= 4
    assert wrong.max() <= 1


# --- what each equation says ------------------------------------------------------------------------------------------


def still(level: int, steps: int, height: int = 16, width: int = 16) -> np.ndarray:
    return np.broadcast_to(np.uint8(level), (steps + 1, height, width))


@pytest.mark.parametrize("mismatch", [0.0, 0.2])
@pytest.mark.parametrize("refractory", [0.0, 0.001])
def test_a_leak_of_one_hertz_fires_once_a_second_on_a_still_scene(mismatch: float, refractory: float) -> None:
    got = simulate(  # 200 s in as many steps as float32 counts exactly
        still(90, 1500), threshold_pos=0.2, bins=1500, dtype="float32", frames_per_second=7.5, leak_hz=1.0,
        threshold_mismatch_sigma=mismatch, refractory_seconds=refractory,
    ).voxels  # fmt: skip
    per_pixel = got.sum((0, 1))
    assert got.min() == 0
    assert per_pixel.min() >= 190
    assert per_pixel.max() <= 210
    # The residual starts around 0 and ends half a threshold above it; a refractory period lengthens every interval.
    assert per_pixel.mean() == pytest.approx(200 / (1 + refractory) - 0.5, abs=0.2)


@pytest.mark.parametrize("refractory", [1e-4, 1e-3, 0.01, 0.039])
def test_the_refractory_period_stretches_the_time_between_events(refractory: float) -> None:
    """Black to white in a step of 40 ms at constant speed: an event every c / slope + t."""
    frames = np.zeros((2, 1, 1), np.uint8)
    frames[1] = 255
    table = log_table_float64(GAMMA, LOG_EPS)
    slope = float(table[255] - table[0]) * FPS
    got = simulate(
        frames, threshold_pos=0.05, start_residual=0.0, bins=1, dtype="float32", frames_per_second=FPS,
        refractory_seconds=refractory,
    ).voxels  # fmt: skip
    assert got.item() == 1 + math.floor((1 / FPS - 0.05 / slope) / (0.05 / slope + refractory))


def test_dead_pixels_are_dead_and_no_others() -> None:
    frames = moving_frames(21, 40, 40)
    plain = simulate(frames, threshold_pos=0.2, noise_sigma=0.3, bins=20).voxels
    got = simulate(frames, threshold_pos=0.2, noise_sigma=0.3, bins=20, dead_pixel_share=100 / 1600).voxels
    position = dead_pixels.positions(noise_key_of_seed(0), 100 / 1600, 1600)
    assert len(set(position.tolist())) == 100
    expected = plain.reshape(20, -1).copy()
    expected[:, position] = 0
    np.testing.assert_array_equal(got.reshape(20, -1), expected)


def test_an_effect_that_can_do_nothing_leaves_every_bit_alone() -> None:
    """The other kernel, without hot pixels, is the same arithmetic in the same order."""
    frames = moving_frames(31, 33, 47)
    for dtype in ("int8", "float32"):
        plain = simulate(frames, threshold_pos=0.07, threshold_neg=0.1, noise_sigma=0.1, bins=3, dtype=dtype)
        other = simulate(
            frames, threshold_pos=0.07, threshold_neg=0.1, noise_sigma=0.1, bins=3, dtype=dtype,
            frames_per_second=1e6, shot_noise_hz=1e-9,
        )  # fmt: skip
        np.testing.assert_array_equal(plain.voxels, other.voxels)
        assert plain.saturated_bins == other.saturated_bins


def test_noise_per_frame_stays_per_frame_where_an_effect_needs_seconds() -> None:
    recipe = Recipe(voxels_per_clip=2, crop_height_px=16, crop_width_px=16, leak_hz=(1.0, 1.0))
    params = params_of(effects_of(dead=0.01), noise_sigma=0.1)
    frames = moving_frames(recipe.frames_needed, 16, 16)
    clips = [simulate_clip(frames, params, recipe, "int8", np.full(recipe.steps, dt)).voxels for dt in (0.01, 0.5)]
    np.testing.assert_array_equal(clips[0], clips[1])


# --- what leaving one out costs ---------------------------------------------------------------------------------------


def pan(steps: int, px_per_frame: float) -> np.ndarray:
    """A smooth texture that glides by."""
    row, column = np.mgrid[0:48, 0:48]
    place = [column + px_per_frame * t for t in range(steps + 1)]
    wave = [np.sin(x / 5.0) * np.cos(row / 7.0) + 0.4 * np.sin((x + row) / 3.0) for x in place]
    return np.clip(127 + 85 * np.array(wave), 0, 255).astype(np.uint8)


SCENES: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
    "threshold_mismatch_sigma": (pan(50, 1.0), {"threshold_mismatch_sigma": 0.15}),
    "shot_noise_hz": (still(20, 50, 48, 48), {"shot_noise_hz": 5.0}),
    "noise_band_share": (still(128, 50, 48, 48), {"noise_band_share": 0.25, "noise_band_hz": 30.0}),
    "leak_hz": (still(128, 50, 48, 48), {"leak_hz": 0.1}),
    "refractory_seconds": (pan(50, 4.0), {"refractory_seconds": 1e-3}),
    "photoreceptor_hz": (pan(50, 2.0), {"photoreceptor_hz": 30.0}),
    "dead_pixel_share": (pan(50, 1.0), {"dead_pixel_share": 231 / 48**2}),
}
TOLERANCE = 0.05


def voxel_error(name: str) -> float:
    """sum |without - with| / sum |with|, bins of 5 frames at 25 frames a second, c = 0.2."""
    frames, effect = SCENES[name]
    arguments: Any = {
        "threshold_pos": 0.2,
        "bins": 10,
        "frames_per_bin": 5,
        "dtype": "float32",
        "frames_per_second": FPS,
    }
    true = simulate(frames, **arguments, **effect).voxels.astype(int)
    return float(np.abs(simulate(frames, **arguments).voxels - true).sum() / np.abs(true).sum())


@pytest.mark.parametrize("name", SCENES)
def test_leaving_an_effect_out_is_seen_on_its_scene(name: str) -> None:
    """What docs/effects.md says of each: without it the voxels are wrong by more than 5 %."""
    assert voxel_error(name) > TOLERANCE


# --- tables, limits, refusals -----------------------------------------------------------------------------------------


def test_the_exponential() -> None:
    x = np.concatenate([-np.geomspace(1e-12, 699, 500), np.linspace(0, 7, 100)])
    np.testing.assert_allclose(exponential(x), np.exp(x), rtol=2e-15)


def test_tables_against_their_equations() -> None:
    light = linear_light(GAMMA, LOG_EPS)
    np.testing.assert_allclose(light, (np.arange(256) / 255) ** GAMMA, atol=1e-15)
    means = shot_noise.shot_means(1000.0, light, np.array([0.01, 0.1]))
    np.testing.assert_allclose(means[:, [0, 255]], [[5.0, 1.25], [50.0, 12.5]])
    table = shot_noise.shot_table(means) / 2.0**32
    for d, level in ((0, 0), (1, 255), (1, 0)):
        for k in (0, 3, 12, 60):
            below = sum(math.exp(-means[d, level]) * means[d, level] ** j / math.factorial(j) for j in range(k + 1))
            expected = 1 - below if k < table.shape[1] else 0.0
            assert table[d, min(k, table.shape[1] - 1), level] == pytest.approx(expected, abs=3e-10)
    slow, fast = photoreceptor.low_pass_tables(30.0, light, np.array([0.02]))[0]
    x = 2 * math.pi * 30.0 * 0.02
    assert slow[255] == pytest.approx(1 - math.exp(-x))
    assert fast[255] == pytest.approx(1 - (1 - math.exp(-x)) / x)
    assert (np.diff(slow) > 0).all()


FRAMES = moving_frames(11, 6, 7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leak_hz": 1.0, "frames_per_second": None}, "frames_per_second is missing"),
        ({"frames_per_second": 0.0}, "frames_per_second"),
        ({"frames_per_second": math.nan}, "frames_per_second"),
        ({"threshold_mismatch_sigma": 1.1}, "threshold_mismatch_sigma = 1.1: give a number from 0 to 1"),
        ({"shot_noise_hz": -1.0}, "shot_noise_hz"),
        ({"shot_noise_hz": 5e3}, r"100 events of a polarity in a step of 0.04 s; the limit is 64"),
        ({"leak_hz": math.nan}, "leak_hz"),
        ({"leak_hz": "much"}, "leak_hz"),
        ({"refractory_seconds": math.inf}, "refractory_seconds"),
        ({"photoreceptor_hz": 1e-3}, "photoreceptor_hz = 0.001: give a number from 0.01 to 1e.06 Hz, or 0 for off"),
        ({"dead_pixel_share": 1.1}, "dead_pixel_share = 1.1"),
        ({"dead_pixels": 1.0}, "unknown effect 'dead_pixels' .did you mean 'dead_pixel_share'"),
        ({"threshold_po": 0.3}, r"no argument 'threshold_po' \(did you mean 'threshold_pos'\?\)"),
    ],
)
def test_bad_effects_are_refused_by_name(change: Any, message: Any) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(FRAMES, threshold_pos=0.2, **({"frames_per_second": FPS} | change))


def test_a_clip_with_a_timed_effect_needs_its_durations() -> None:
    recipe = Recipe(voxels_per_clip=2, crop_height_px=6, crop_width_px=7, leak_hz=(1.0, 1.0))
    with pytest.raises(UsageError, match=r"missing: noise_unit is 'frame', .* there is an effect in Hz"):
        simulate_clip(FRAMES, params_of(ALL), recipe, "int8")
    # Another array of the sample may need them.
    np.testing.assert_array_equal(
        simulate_clip(FRAMES, params_of({}), recipe.replace(leak_hz=0.0), "int8", np.full(10, 0.3)).voxels,
        simulate_clip(FRAMES, params_of({}), recipe.replace(leak_hz=0.0), "int8").voxels,
    )


def test_a_dead_pixel_needs_no_clock() -> None:
    recipe = Recipe(voxels_per_clip=2, crop_height_px=6, crop_width_px=7, dead_pixel_share=(1.0, 1.0))
    params = params_of(effects_of(dead=1.0))
    assert not simulate_clip(FRAMES, params, recipe, "int8").voxels.any()


# --- the same bytes everywhere ----------------------------------------------------------------------------------------

GOLDEN = {
    "int8": "583de2e890b7da92ccc0262adf0f3b3f0f9190501a6ff6fae72a894314e346b8",
    "float32": "34835d3548cd23d03591aed18d5bd11e3ab06e1723f2d8bce3a69410ef2e1a1b",
}


def digest(dtype: str) -> str:
    """Digest of one fixed clip with every effect of ``davis346`` on."""
    recipe = preset("davis346").replace(voxels_per_clip=6, frames_per_bin=2, crop_height_px=37, crop_width_px=45)
    params = params_of(ALL, 9, noise_sigma=0.3, hot_pixel_count=9, hot_pixel_sigma=20.0, pauses=((11, 7), (40, 3)))
    durations = np.array([0.033, 0.033, 0.034])[np.arange(recipe.steps) % 3]
    voxels, saturated = simulate_clip(moving_frames(61, 37, 45), params, recipe, dtype, durations)
    return hashlib.sha256(voxels.astype(voxels.dtype.newbyteorder("<")).tobytes() + str(saturated).encode()).hexdigest()


@pytest.mark.parametrize("dtype", sorted(GOLDEN))
def test_golden_voxels(dtype: Any) -> None:
    assert digest(dtype) == GOLDEN[dtype]


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS)
def test_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    code = "from tests.server.simulation.test_effects import digest; print(digest('float32'))"
    assert printed_on_a_generic_processor(code, tmp_path) == [GOLDEN["float32"]]
