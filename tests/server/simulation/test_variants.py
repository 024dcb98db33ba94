"""Which compiled kernels a stream needs is known before its first sample."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from v2v_protocol.recipe import Recipe, preset
from v2v_server.simulation.clip import _log_ends, _most_events
from v2v_server.simulation.draw import draw
from v2v_server.simulation.intensity import Intensity
from v2v_server.simulation.kernels import KernelInput
from v2v_server.simulation.precision import AUTO, USUAL, Variant, choose, variants
from v2v_server.simulation.voxel import bin_edges
from v2v_server.video.picture import MOST_BITS, SDR, Signal

LOAD_AND_COUNT = """
import json
from dataclasses import replace
from tests.server.simulation.test_clip import EFFECTS, FRAMES, PARAMS, RECIPE
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import simulate_general, simulate_pixels
from v2v_server.simulation.precision import warm_up
from v2v_server.simulation.precision import USUAL, Variant, load

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
