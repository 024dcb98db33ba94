"""The edges of what a recipe may ask for, and what a stream needs for it: arithmetic, compiled kernels, effects."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.balance import Camera, arithmetic, balance
from tests.oracles.extremes import Row, record_of, rows, texture
from tests.oracles.noise import error_bound
from tests.server.simulation import reference
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import LARGEST_EVENTS, LARGEST_NORMAL, PRESETS, Recipe, most_events, preset
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import noise, simulate, simulate_clip
from v2v_server.simulation.clip import _log_ends, _most_events
from v2v_server.simulation.draw import draw
from v2v_server.simulation.intensity import Intensity, log_table_float64
from v2v_server.simulation.kernels import KernelInput
from v2v_server.simulation.precision import AUTO, LIMITS, USUAL, Variant, choose, variants
from v2v_server.simulation.voxel import bin_edges
from v2v_server.video.picture import MOST_BITS, SDR, Signal


@pytest.mark.parametrize("row", [pytest.param(row, marks=[pytest.mark.slow] * row.slow, id=row.name) for row in rows()])
def test_row(row: Row) -> None:
    record = record_of(row)
    assert record["passed"], record


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


cameras = st.builds(
    Camera,
    threshold_pos=powers(1e-6, 1e3),
    threshold_neg=powers(1e-6, 1e3),
    noise_sigma=st.one_of(st.just(0.0), powers(1e-6, 1e3)),
    hot_pixel_count=st.integers(0, 48),
    hot_pixel_sigma=st.one_of(st.just(0.0), powers(1e-3, 1e6)),
    gamma=st.floats(0.3, 4.0),
    log_eps=powers(1e-9, 1e-1),
    seed=st.integers(0, 2**64 - 1),
)


@settings(max_examples=60, deadline=None)
@given(cameras, st.integers(1, 60))
def test_events_account_for_every_change_of_any_camera(camera: Camera, steps: int) -> None:
    found = balance(camera, texture(steps))
    assert found.holds, found
    # The bound is the promise of precision.py: half a threshold, whatever the camera.
    assert found.bound <= min(camera.threshold_pos, camera.threshold_neg) / 2
    assert found.fired <= found.events * 48


def test_the_arithmetic_follows_the_limits() -> None:
    assert choose(AUTO, 2.0**20) is np.float32
    assert choose(AUTO, np.nextafter(2.0**20, math.inf)) is np.float64
    assert choose(AUTO, 2.0**49) is np.float64
    assert choose("float64", 1.0) is np.float64
    for asked, events in ((AUTO, 1e15), (AUTO, math.inf), (AUTO, math.nan), ("float64", 1e15), ("float32", 1.1e6)):
        with pytest.raises(UsageError, match="counts at most"):
            choose(asked, events)
    for name, (real, limit) in LIMITS.items():
        assert error_bound(real, limit, 0.3) == 0.15, name


def test_no_normal_is_larger_than_the_limits_assume() -> None:
    words = np.array([0, 1, 2**31, 2**31 + 1], np.uint32)
    largest = max(float(np.abs(part).max()) for part in noise.box_muller(words, np.zeros(4, np.uint32)))
    assert 6.55 < largest <= LARGEST_NORMAL


def test_most_events_by_hand() -> None:
    # 4 steps and the start, each the larger threshold and the range; noise of 6.56 deviations; and the level itself.
    assert most_events(4, (-6.0, 1.0), (0.5, 0.25), 2.0) == (5 * (0.5 + 7.0) + 6.56 * 2.0 + 6.0) / 0.25


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_stays_in_float32(name: str) -> None:
    assert choose(AUTO, PRESETS[name].most_events) is np.float32


def test_a_recipe_is_bounded_by_its_worst_draw() -> None:
    recipe = Recipe(hot_pixel_sigma=(0.0, 1e6), threshold=(0.1, 1.0), threshold_ratio=(0.5, 2.0))
    assert recipe.smallest_and_largest_threshold == (0.05, 2.0)
    ends = math.log(1e-3), math.log1p(1e-3)
    assert recipe.most_events == most_events(200, ends, (0.05, 2.0), 200 * (0.1 + 1e6))
    assert recipe.replace(hot_pixel_share=0.0).most_events == most_events(200, ends, (0.05, 2.0), 200 * 0.1)
    scaled = recipe.replace(hot_pixel_share=0.0, noise_scales_with_threshold=True)
    assert scaled.most_events == most_events(200, ends, (0.05, 2.0), 200 * 0.1 * 2.0)
    assert choose(AUTO, recipe.most_events) is np.float64
    assert recipe.most_events < LARGEST_EVENTS


@pytest.mark.parametrize(("hot_sigma", "seconds", "real"), [
    (3.0, None, "float32"), (1e6, None, "float64"), (3.0, 1e-3, "float32"), (3.0, 1e6, "float64"),
])  # fmt: skip
def test_a_clip_is_simulated_in_the_arithmetic_it_needs(hot_sigma: float, seconds: Any, real: Any) -> None:
    recipe = Recipe(voxels_per_clip=2, crop_height_px=6, crop_width_px=8, noise_unit="second" if seconds else "frame")
    key = (1, 2, 3, 4)
    params = SampleParams(0.1, 0.125, 0.1, 5, hot_sigma, (), 1.0, 0, 0, False, 0.0, key)
    frames, durations = texture(10), np.full(10, seconds or 1.0)
    got = simulate_clip(frames, params, recipe, "float32", durations if seconds else None).voxels.reshape(10, 48)
    level = log_table_float64(recipe.gamma, recipe.log_eps[0]).astype(real)[frames.reshape(11, 48)]
    expected, _ = reference.simulate(
        level, key, threshold_pos=0.1, threshold_neg=0.125, noise_scale=0.1 * np.sqrt(durations), hot_count=5,
        hot_sigma=hot_sigma, hot_scale=durations, frames_per_bin=1, dtype="float32",
    )  # fmt: skip
    np.testing.assert_array_equal(got, expected)


def test_a_drawn_clip_beyond_float64_is_refused() -> None:
    recipe = Recipe(voxels_per_clip=2, crop_height_px=6, crop_width_px=8, noise_unit="second")
    listed = SampleParams(1e-20, 1e-20, 0.1, 5, 1.0, (), 1.0, 0, 0, False, 0.0, (1, 2, 3, 4))
    with pytest.raises(UsageError, match=r"events; float64 counts at most 5\.629e\+14"):
        simulate_clip(texture(10), listed, recipe, "int8", np.ones(10))
    tiny = SampleParams(1e-40, 1e-40, 0.1, 5, 1.0, (), 1.0, 0, 0, False, 0.0, (1, 2, 3, 4))
    with pytest.raises(UsageError, match="threshold_pos = 1e-40"):
        simulate_clip(texture(10), tiny, recipe, "int8", np.ones(10))


def test_float32_asked_for_by_name_is_kept_to_its_limit() -> None:
    frames = texture(60)
    assert arithmetic(Camera(1e-3, 1e-3), frames)[0] is np.float32
    simulate(frames, threshold_pos=1e-3, bins=60, precision="float32")
    with pytest.raises(UsageError, match=r"float32 counts at most 1\.049e\+06 .* precision='auto'"):
        simulate(frames, threshold_pos=1e-4, bins=60, precision="float32")


# --- kernels and effects of a stream ----------------------------------------------------------------------------------

LOAD_AND_COUNT = """
import json
from dataclasses import replace
from tests.server.simulation.test_clip import EFFECTS, FRAMES, PARAMS, RECIPE
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import simulate_general, simulate_pixels
from v2v_server.simulation.forms import load, warm_up
from v2v_server.simulation.precision import USUAL, Variant

def count():
    return [len(kernel.signatures) for kernel in (simulate_pixels, simulate_general)]

warm_up()
seen = [count()]
for variant in USUAL:
    load(variant)
seen.append(count())
load(Variant("int16", True, "float32"))
load(Variant("int8", False, "float64"))
seen.append(count())
simulate_clip(FRAMES, replace(PARAMS, effects=EFFECTS[0]), RECIPE, "int16")
simulate_clip(FRAMES, replace(PARAMS, threshold_pos=1e-5, threshold_neg=1e-5), RECIPE, "int8")
seen.append(count())
print(json.dumps(seen))
"""


def test_usual_ones_suffice_for_the_presets() -> None:
    for name in ("paper", "clean", "davis346"):
        assert variants(preset(name), "int8", 0.1) <= USUAL


def test_effects_and_dtypes() -> None:
    assert variants(Recipe(), "float32") == {Variant("float32", False, "float32")}
    assert variants(preset("davis346"), "int16", 0.1) == {Variant("int16", True, "float32")}
    assert variants(Recipe(), "int8", levels_per_step=15) == {Variant("int8", True, "float32", True)}
    assert {each.bits for each in variants(Recipe(light="declared"), "int8", levels_per_step=15)} == {8}


@pytest.mark.parametrize("step_seconds", [1 / 240, 1.0, 60.0])
@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(threshold=(1e-3, 2e-2)),
        Recipe(threshold=(1e-3, 2e-2), grids_per_frame=3),
        Recipe(threshold=(1e-3, 2e-2), light="declared"),
        Recipe(threshold=(1e-3, 2e-2), threshold_source="video", threshold_mismatch_sigma=(0.0, 0.1)),
        Recipe(threshold=(1e-3, 2e-2), threshold_source="video", noise_scales_with_threshold=True),
        preset("davis346"),
        preset("davis346").replace(threshold_source="video"),
    ],
)
def test_every_draw_finds_its_kernel(recipe: Recipe, step_seconds: float) -> None:
    """Thresholds about those at which float32 no longer counts exactly."""
    seconds = np.full(recipe.steps, step_seconds)
    units = seconds if recipe.noise_unit == "second" else np.ones(recipe.steps)
    for stated in (None, (1e-4, 1.0), (1e-3, 2e-2), (0.3, 50.0), (1e-6, 1e-6)):
        known = variants(recipe, "int8", step_seconds, stated)
        for index in range(20):
            params = draw(
                recipe, seed=1, epoch=0, index=index, picture_height_px=128, picture_width_px=128, video_id="a.mp4",
                video_thresholds=stated,
            )  # fmt: skip
            signal = SDR if recipe.light == "sdr" else Signal(10, "pq")
            intensity = Intensity(recipe.gamma, params.log_eps or recipe.log_eps[0], signal)
            edges = bin_edges(recipe.steps, recipe.frames_per_bin, recipe.grids_per_frame * recipe.bins or 1)
            given = KernelInput(
                np.empty((1, 1, 1), np.uint8), intensity, np.zeros(recipe.steps + 1, np.int64), params, units, seconds,
                recipe.bins, edges, "int8",
            )  # fmt: skip
            real = choose(AUTO, _most_events(given, _log_ends(intensity)))
            kernel = Variant("int8", given.needs_general, real.__name__)
            assert kernel in known
            assert (signal == SDR) == (kernel._replace(bits=MOST_BITS) not in known)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # it compiles kernels
def test_what_is_loaded_is_what_is_used() -> None:
    command = [sys.executable, "-c", LOAD_AND_COUNT]
    run = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=True)
    assert json.loads(run.stdout) == [[3, 1], [3, 1], [4, 2], [4, 2]]
