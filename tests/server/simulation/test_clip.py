"""What the callers of a simulation may rely on: shapes, seeds, refusals, noise per second, the log table."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import simulate, simulate_clip, simulate_log
from v2v_server.simulation.clip import grey_levels
from v2v_server.simulation.intensity import log_table, log_table_float64
from v2v_server.simulation.voxel import new_array

FRAMES = (np.arange(11 * 6 * 7) * 37 % 256).astype(np.uint8).reshape(11, 6, 7)


def test_views_that_are_not_contiguous_are_simulated_as_they_look() -> None:
    wide = np.repeat(FRAMES, 2, axis=2)[:, :, ::2]
    np.testing.assert_array_equal(simulate(wide, threshold_pos=0.2).voxels, simulate(FRAMES, threshold_pos=0.2).voxels)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"threshold_pos": 0.0}, "threshold_pos"),
        ({"threshold_pos": math.nan}, "threshold_pos"),
        ({"threshold_neg": math.inf}, "threshold_neg"),
        ({"noise_sigma": -0.1}, "noise_sigma"),
        ({"noise_sigma": "much"}, "noise_sigma"),
        ({"hot_pixel_count": 43}, "hot_pixel_count = 43.*42"),
        ({"hot_pixel_sigma": math.nan}, "hot_pixel_sigma"),
        ({"start_residual": 0.3}, "start_residual"),
        ({"start_residual": math.nan}, "start_residual"),
        ({"bins": 0}, "bins"),
        ({"bins": 3}, r"11 frames.*k x 3 \+ 1"),
        ({"frames_per_bin": 4}, r"k x 20 \+ 1"),
        ({"gamma": 0.0}, "gamma"),
        ({"log_eps": -1.0}, "log_eps"),
        ({"seed": -1}, "seed"),
        ({"dtype": "uint8"}, "int8, int16, float32"),
        ({"precision": "float16"}, "float32, float64"),
        ({"frames": FRAMES[0]}, "frames"),
        ({"frames": FRAMES.astype(float)}, "0 .. 1"),
        ({"frames": FRAMES[:1]}, "1 frames"),
        ({"frames": FRAMES[:, :0]}, "0 pixels"),
    ],
)
def test_bad_arguments_are_refused_by_name(change: Any, message: Any) -> None:
    arguments = {"frames": FRAMES, "threshold_pos": 0.2} | change
    with pytest.raises(UsageError, match=message):
        simulate(arguments.pop("frames"), **arguments)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_log_frames_that_are_not_finite_are_refused(bad: Any) -> None:
    level = np.zeros((6, 2, 2))
    level[3, 1, 1] = bad
    with pytest.raises(UsageError, match="NaN or infinite"):
        simulate_log(level, threshold_pos=0.2)
    with pytest.raises(UsageError, match="floating point"):
        simulate_log(FRAMES, threshold_pos=0.2)  # type: ignore[arg-type]


RECIPE = Recipe(voxels_per_clip=2, crop_height_px=6, crop_width_px=7)
PARAMS = SampleParams(0.2, 0.2, 0.1, 1, 1.0, (), 1.0, 0, 0, False, 0.0, (1, 2, 3, 4))


def test_a_lead_voxel_is_one_more_in_front() -> None:
    recipe = RECIPE.replace(voxels_per_clip=1, lead_voxels=1)
    np.testing.assert_array_equal(
        simulate_clip(FRAMES, PARAMS, recipe, "int8").voxels, simulate_clip(FRAMES, PARAMS, RECIPE, "int8").voxels
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": FRAMES[:10]}, "shows 11 frames"),
        ({"frames": FRAMES.astype(np.int16)}, "uint8"),
        ({"recipe": RECIPE.replace(noise_unit="second")}, "missing"),
        ({"recipe": RECIPE.replace(noise_unit="second"), "step_seconds": np.ones(9)}, "10 positive"),
        ({"recipe": RECIPE.replace(noise_unit="second"), "step_seconds": np.zeros(10)}, "10 positive"),
        ({"voxel_dtype": "int64"}, "int64"),
    ],
)
def test_a_clip_that_does_not_fit_its_draw_is_refused(change: Any, message: Any) -> None:
    arguments = {"frames": FRAMES, "params": PARAMS, "recipe": RECIPE, "voxel_dtype": "int8"} | change
    with pytest.raises(UsageError, match=message):
        simulate_clip(**arguments)


def test_log_table() -> None:
    for gamma, eps in ((2.2, 1e-3), (1.0, 1e-6), (0.45, 1.0)):
        expected = np.log(eps + (np.arange(256) / 255) ** gamma)
        np.testing.assert_allclose(log_table_float64(gamma, eps), expected, rtol=1e-13, atol=1e-15)
        table = log_table(gamma, eps)
        np.testing.assert_array_equal(table, log_table_float64(gamma, eps).astype(np.float32))
        assert (np.diff(table) > 0).all()
        assert table is log_table(gamma, eps)
        assert not table.flags.writeable
    assert math.isclose(log_table(2.2, 1e-3)[255] - log_table(2.2, 1e-3)[0], 6.909, abs_tol=1e-3)


def test_an_array_of_another_form_is_refused() -> None:
    given = np.empty((2, 5), np.int16)
    assert new_array("int16", (2, 5), given) is given
    for dtype, shape in (("int8", (2, 5)), ("int16", (5, 2))):
        with pytest.raises(UsageError, match=r"out int16\[2, 5\]"):
            new_array(dtype, shape, given)


def test_a_drawn_log_eps_is_that_log_eps() -> None:
    ranged, fixed = RECIPE.replace(log_eps=(0.01, 0.2)), RECIPE.replace(log_eps=0.1)
    drawn = simulate_clip(FRAMES, dataclasses.replace(PARAMS, log_eps=0.1), ranged, "int8")
    np.testing.assert_array_equal(drawn.voxels, simulate_clip(FRAMES, PARAMS, fixed, "int8").voxels)
    assert (drawn.voxels != simulate_clip(FRAMES, PARAMS, RECIPE, "int8").voxels).any()


WARM_UP_AND_COUNT = """
import json, sys
from dataclasses import replace
import numpy as np
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import simulate_general, simulate_pixels
from v2v_server.simulation.pixel import words
from v2v_server.worker.warm_up import warm_up_in_turn

RECIPE, PARAMS, EFFECTS = eval(sys.argv[1])
FRAMES = np.arange(11 * 6 * 7).astype(np.uint8).reshape(11, 6, 7)

def count():
    return [len(kernel.signatures) for kernel in (simulate_pixels, simulate_general, words)]

warm_up_in_turn()
seen = [count()]
for dtype in ("int8", "int16", "float32"):
    simulate_clip(FRAMES, PARAMS, RECIPE, dtype)
    simulate_clip(FRAMES, replace(PARAMS, noise_sigma=0.0, hot_pixel_count=0), RECIPE, dtype)
seen.append(count())
for effects in EFFECTS:
    timed = any(name.endswith(("_hz", "_seconds")) for name in effects)
    recipe = RECIPE.replace(leak_hz=(1.0, 1.0) if timed else 0.0)
    seconds = np.linspace(0.01, 0.1, 10) if timed else None
    for noise_sigma in (0.0, 0.1):
        simulate_clip(FRAMES, replace(PARAMS, noise_sigma=noise_sigma, effects=effects), recipe, "int8", seconds)
seen.append(count())
print(json.dumps(seen))
"""

ALL = {
    "threshold_mismatch_sigma": 0.03, "shot_noise_hz": 2.0, "leak_hz": 0.1, "refractory_seconds": 1e-3,
    "photoreceptor_hz": 100.0, "dead_pixel_share": 0.1,
}  # fmt: skip
EFFECTS = [*({name: value} for name, value in ALL.items()), ALL]


@pytest.mark.timeout(1200)  # it compiles kernels
def test_after_warm_up_nothing_is_compiled() -> None:
    command = [sys.executable, "-c", WARM_UP_AND_COUNT, repr((RECIPE, PARAMS, EFFECTS))]
    run = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=True)
    assert json.loads(run.stdout) == [[3, 1, 1]] * 3


# --- frames of every usual kind ---------------------------------------------------------------------------------------

COLOUR = np.random.default_rng(3).integers(0, 256, (6, 8, 9, 3), np.uint8)
GREY = np.floor(COLOUR @ np.array([0.299, 0.587, 0.114]) + 0.5 + 1e-9).astype(np.uint8)


@pytest.mark.parametrize(
    "frames",
    [
        GREY[..., None],
        GREY[:, None],
        GREY / 255,
        (GREY / 255).astype(np.float32),
        COLOUR,
        COLOUR / 255,  # rounded once
        np.moveaxis(COLOUR, 3, 1),
        torch.from_numpy(GREY),
        torch.from_numpy(GREY).float()[:, None] / 255,
        torch.from_numpy(np.moveaxis(COLOUR, 3, 1).copy()),
    ],
    ids=lambda frames: f"{type(frames).__name__}-{frames.dtype}-{'x'.join(map(str, frames.shape))}",
)
def test_every_kind_gives_the_same_events(frames: Any) -> None:
    np.testing.assert_array_equal(grey_levels(frames), GREY)
    made = simulate(frames, threshold_pos=0.2).voxels
    assert made.any()
    np.testing.assert_array_equal(made, simulate(GREY, threshold_pos=0.2).voxels)


def test_grey_levels_are_not_copied() -> None:
    assert grey_levels(GREY) is GREY


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (GREY.astype(np.int16), "uint8 or floating"),
        (GREY[0], "uint8 or floating"),
        (np.zeros((6, 8, 9, 4), np.uint8), "uint8 or floating"),
        (np.full((6, 8, 9), 1.5), "outside 0 .. 1"),
        (np.full((6, 8, 9), np.nan, np.float32), "NaN"),
        (GREY * 1.0, "outside 0 .. 1"),
        (torch.zeros((6, 8, 9), requires_grad=True), "requires grad"),
    ],
)
def test_frames_that_say_nothing_definite_are_refused(frames: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(frames, threshold_pos=0.2)
