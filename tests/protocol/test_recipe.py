"""Recipe: presets, validation, and the frame arithmetic of the paper's configurations."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import RecipeError
from v2v_protocol.recipe import DEPRECATED, PRESETS, Recipe, preset
from v2v_protocol.settings import settings_of
from v2v_protocol.spec import StreamSpec

FIELDS = {field.name: field.default for field in dataclasses.fields(Recipe)}
WHOLE = [name for name, default in FIELDS.items() if type(default) is int]
NUMBERS = [name for name, default in FIELDS.items() if isinstance(default, float)]
RANGES = [name for name, default in FIELDS.items() if isinstance(default, tuple)]
FLAGS = [name for name, default in FIELDS.items() if isinstance(default, bool)]
WORDS = [name for name, default in FIELDS.items() if isinstance(default, str)]

EFFECTS = (
    "threshold_mismatch_sigma", "shot_noise_hz", "leak_hz", "refractory_seconds", "photoreceptor_hz",
    "dead_pixel_share",
)  # fmt: skip


def test_every_field_is_of_a_kind_that_these_tests_cover() -> None:
    assert sorted(WHOLE + NUMBERS + RANGES + FLAGS + WORDS) == sorted(FIELDS)


# --- frames -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "needed", "voxels", "targets"),
    [
        ("paper", 201, 40, range(5, 201, 5)),
        ("paper-fixed-thresholds", 201, 40, range(5, 201, 5)),
        ("paper-contrast", 201, 40, range(5, 201, 5)),
        ("paper-flow", 201, 40, range(0, 201, 5)),
        ("paper-eraft", 206, 41, range(5, 206, 5)),
        ("noise-free", 201, 40, range(5, 201, 5)),
        ("clean", 201, 40, range(5, 201, 5)),
        ("davis346", 201, 40, range(5, 201, 5)),
    ],
)
def test_frames_of_the_presets(name: str, needed: int, voxels: int, targets: range) -> None:
    recipe = preset(name)
    assert recipe.frames_needed == needed
    assert recipe.frames_per_sequence == recipe.steps == needed - 1
    assert recipe.voxels_per_clip + recipe.lead_voxels == voxels
    assert recipe.target_steps == tuple(targets)


@given(st.integers(1, 60), st.integers(1, 8), st.integers(1, 5), st.integers(0, 1), st.integers(0, 1))
def test_targets_close_the_voxels_they_are_paired_with(
    voxels: int, bins: int, per_bin: int, lead_frames: int, lead_voxels: int
) -> None:
    recipe = Recipe(
        voxels_per_clip=voxels,
        bins=bins,
        frames_per_bin=per_bin,
        lead_frames=lead_frames,
        lead_voxels=lead_voxels,
    )
    targets, span = recipe.target_steps, bins * per_bin
    assert len(targets) == voxels + lead_frames
    assert targets[-1] == recipe.steps == (voxels + lead_voxels) * span
    assert targets[0] >= 0
    # Counted from the back, frame i ends voxel i; with a lead frame the first voxel of the clip begins at targets[0].
    assert targets[-voxels:] == tuple((lead_voxels + 1 + voxel) * span for voxel in range(voxels))
    if lead_frames:
        assert targets[0] == lead_voxels * span


# --- presets ----------------------------------------------------------------------------------------------------------


def test_the_paper_preset_holds_the_released_values() -> None:
    paper = preset("paper")
    assert paper == Recipe()
    assert paper.threshold == (0.05, 2.0)
    assert paper.threshold_ratio == (1.0, 1.5)
    assert paper.noise_sigma == (0.0, 0.1)
    assert paper.hot_pixel_share == (0.0, 0.001)
    assert paper.hot_pixel_sigma == (0.0, 10.0)
    assert (paper.gamma, paper.log_eps) == (2.2, (0.001, 0.001))
    assert (paper.pause_probability, paper.pause_stay_probability) == (0.0102, 0.9791)
    # Share of frames in which the camera stands still, from the chain's stationary distribution: about a third.
    share = paper.pause_probability / (paper.pause_probability + 1 - paper.pause_stay_probability)
    assert share == pytest.approx(1 / 3, abs=0.01)


@pytest.mark.parametrize("name", ["papers", "", None, 7, ["paper"]])
def test_unknown_preset_lists_the_known_ones(name: object) -> None:
    with pytest.raises(RecipeError, match="known: paper, ") as caught:
        preset(name)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize("name", [name for name in PRESETS if name.startswith("paper")] + ["noise-free"])
def test_what_the_paper_does_not_model_is_off(name: str) -> None:
    recipe = preset(name)
    assert not recipe.has_effects
    assert not recipe.needs_seconds


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_is_on_where_a_draw_may_be_above_zero(name: str) -> None:
    recipe = Recipe().replace(**{name: (0.5, 0.5)})
    assert recipe.has_effects
    assert recipe.timed_effects == recipe.needs_seconds == name.endswith(("_hz", "_seconds"))


def test_a_low_pass_of_almost_zero_hertz_is_refused() -> None:
    """Zero means none: a range that begins there would jump from no light at all to all of it."""
    for value in ([0.0, 30.0], [1e-9, 30.0], 1e-9):
        assert "from 0.01 to 1e+06 Hz, or 0 for off" in refuse("photoreceptor_hz", value)
    assert Recipe(photoreceptor_hz=(0.01, 0.01)).has_effects


def test_the_events_of_a_recipe_count_its_effects() -> None:
    """The smallest threshold of any pixel, and a leak at one frame a second."""
    plain = Recipe(noise_sigma=(0.0, 0.0), hot_pixel_share=(0.0, 0.0), threshold=(0.2, 0.2), threshold_ratio=(1.0, 1.0))
    spread = plain.replace(threshold_mismatch_sigma=0.05)
    assert spread.most_events > plain.most_events / (1 - 6.56 * 0.05)
    assert plain.replace(threshold_mismatch_sigma=1.0).most_events > plain.most_events / 0.25
    assert plain.replace(leak_hz=3.0).most_events - plain.most_events >= 3.0 * plain.steps
    with pytest.raises(RecipeError, match="events in a clip"):
        Recipe(threshold=(1e-6, 1e6), leak_hz=1e4)


# --- plain values -----------------------------------------------------------------------------------------------------


def test_from_dict_starts_at_the_named_preset() -> None:
    recipe = Recipe.from_dict({"preset": "paper-eraft", "bins": 3})
    assert recipe == preset("paper-eraft").replace(bins=3)
    assert Recipe.from_dict({}) == preset("paper")


def test_one_number_fixes_a_range() -> None:
    assert Recipe(threshold=0.3).threshold == (0.3, 0.3)  # type: ignore[arg-type]
    assert Recipe.from_dict({"threshold": [1, 2]}).threshold == (1.0, 2.0)


@pytest.mark.parametrize("make", [Recipe.from_dict, lambda values: Recipe().replace(**values)])
def test_unknown_key_is_refused_with_the_nearest_known_one(make: Any) -> None:
    with pytest.raises(RecipeError, match=r"unknown recipe key 'noise_sigm' \(did you mean 'noise_sigma'\?\)"):
        make({"noise_sigm": 0.1})


@pytest.mark.parametrize("key", ["self", "cls", "changes", "__class__", "", "\0", 1])
def test_no_key_escapes_as_another_error(key: Any) -> None:
    """A key named like a parameter, or that is none, must not become a TypeError: recipes come from the wire."""
    with pytest.raises(RecipeError, match="unknown recipe key"):
        Recipe.from_dict({key: 1})


# --- refusals ---------------------------------------------------------------------------------------------------------


def refuse(name: str, value: Any) -> str:
    with pytest.raises(RecipeError, match=rf"^recipe {name} = ") as caught:
        Recipe().replace(**{name: value})
    return str(caught.value)


NO_NUMBER = (math.nan, math.inf, -math.inf, True, "a tenth", "nan", None, 10**400, 1j, b"1")
NO_PAIR = ([], [1.0], [1.0, 1.0, 1.0], [math.nan, 1.0], [0.5, True], [[1.0], 1.0], {1.0: 2.0})


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (NUMBERS + RANGES, NO_NUMBER),
        (RANGES, NO_PAIR),
        (WHOLE, (1.0, True, "1", None, [1], np.float64(1))),
        (FLAGS, (0, 1, "true", None)),
        (WORDS, ("", "samples", None, 1, True)),
    ],
)
def test_a_value_of_another_kind_is_refused(names: list[str], values: tuple[Any, ...]) -> None:
    for name, value in itertools.product(names, values):
        refuse(name, value)


def test_every_number_has_a_limit_on_both_sides() -> None:
    for name, extreme in itertools.product(WHOLE + NUMBERS + RANGES, (-(10**12), 10**12)):
        assert settings_of(Recipe)[name].expected in refuse(name, extreme if name in WHOLE else float(extreme))


def test_a_range_is_given_lowest_first_and_both_ends_are_limited() -> None:
    for name in RANGES:
        setting = settings_of(Recipe)[name]
        assert "lowest value comes first" in refuse(name, [setting.high, max(setting.low, setting.high / 2)])
        assert "[1.0, 1000000000000.0]: give one number, or a pair" in refuse(name, [1.0, 10.0**12])
        assert "[-1000000000000.0, 1.0]: give one number, or a pair" in refuse(name, [-(10.0**12), 1.0])


def test_the_frames_of_a_sample_are_limited() -> None:
    assert Recipe(voxels_per_clip=1_000_000, bins=1).frames_needed == 1_000_001
    with pytest.raises(RecipeError, match=re.escape("needs 1000002 frames")):
        Recipe(voxels_per_clip=1_000_000, bins=1, lead_voxels=1)
    with pytest.raises(RecipeError, match="the limit is 1000001"):
        Recipe(voxels_per_clip=1_000_000, bins=1024, frames_per_bin=1024)


MISTAKEN = [
    ({"threshold": 20}, "e^20 times as high. Divide percent"),
    ({"threshold": (0.2, 15)}, "threshold = 15"),
    ({"threshold": 1e-3}, "threshold = 0.001: real cameras have 0.01 to 5 log units. Every change of a level would"),
    ({"threshold_ratio": 120}, "Divide percent".lower()),
    ({"threshold_ratio": 0.01}, "a multiple of the smaller threshold"),
    ({"log_eps": 1e-9}, "fire at the least change"),
    ({"voxel_seconds": 1e-5}, "1e-05 s of events. It is in seconds"),
    ({"refractory_seconds": 1}, "blind for 1 s after each event. Divide milliseconds by 1000"),
    ({"refractory_seconds": 0.5}, "real cameras have 0 to 0.02 s"),
    ({"photoreceptor_hz": 0.05}, "no change faster than 0.05 Hz. A time constant"),
    ({"noise_sigma": 5}, "Divide percent by 100"),
    ({"leak_hz": 1000}, "fire 1000 events a second"),
    ({"shot_noise_hz": 5000}, "5000 times a second"),
    ({"hot_pixel_share": 0.5}, "divide percent by 100"),
    ({"dead_pixel_share": 0.2}, "divide percent by 100"),
    ({"threshold_mismatch_sigma": 0.9}, "Divide percent by 100"),
    ({"voxel_seconds": 50, "bins": 1}, "a grid would hold 50 s of events".capitalize()),
    ({"gamma": 0.2}, "about 2.2"),
    ({"log_eps": 1.0}, "divide by 255"),
]


@pytest.mark.parametrize(("fields", "words"), MISTAKEN, ids=repr)
def test_a_value_of_another_unit_is_warned_of_once(fields: dict[str, Any], words: str) -> None:
    said: list[str] = []
    for _ in range(2):
        Recipe(**fields).warn(said.append)
    assert len(said) == 1
    assert said[0].startswith(f"warning: recipe {next(iter(fields))} = ")
    assert words in said[0]


@pytest.mark.parametrize("name", PRESETS)
def test_the_recipes_by_name_are_real_cameras(name: str) -> None:
    said: list[str] = []
    PRESETS[name].warn(said.append)
    assert not said


def test_a_deprecated_recipe_is_read_with_one_warning_and_not_listed(caplog: pytest.LogCaptureFixture) -> None:
    for name, successor in DEPRECATED.items():
        read = [Recipe.from_dict({"preset": name, "bins": 3}), StreamSpec.from_dict({"recipe": name}).recipe]
        assert read == [PRESETS[name].replace(bins=3), PRESETS[name]]
        [line] = caplog.messages
        assert line == (f"warning: recipe {name} is deprecated: give {successor}. Samples of {name} stay as they are.")
        caplog.clear()
        preset(successor)
        assert not caplog.messages
    with pytest.raises(RecipeError) as refused:
        preset("unknown")
    assert re.findall("sensor|davis346(?!-)", str(refused.value)) == []


@pytest.fixture(autouse=True)
def nothing_warned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v2v_protocol.recipe._WARNED", set())
