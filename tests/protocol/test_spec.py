"""StreamSpec: its digest names it, and its canonical form is the whole of it."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any, get_args, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.protocol.recipes import specs
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import PRESETS, Recipe, preset
from v2v_protocol.settings import settings_of
from v2v_protocol.spec import StreamSpec

OTHER_RECIPE_VALUES: dict[str, Any] = {
    "voxels_per_clip": 41,
    "bins": 6,
    "frames_per_bin": 2,
    "grids_per_frame": 4,
    "voxel_seconds": [0.02, 0.1],
    "lead_frames": 1,
    "lead_voxels": 1,
    "crop_height_px": 129,
    "crop_width_px": 127,
    "resize_scale": [1.0, 1.3],
    "flip_probability": 0.25,
    "pause_probability": 0.01,
    "pause_stay_probability": 0.5,
    "frame_stride": 2,
    "max_boxes": 9,
    "world_speed_px": [4.0, 40.0],
    "world_turn_deg": [0.0, 90.0],
    "world_zoom": [0.0, 0.1],
    "world_tilt": [0.0, 0.2],
    "world_shake_px": [0.0, 2.0],
    "world_patches": 1,
    "world_patch_px": [16.0, 32.0],
    "world_still_share": 0.1,
    "world_turn_only_share": 0.1,
    "world_plain_share": 0.1,
    "exposure_seconds": (0.001, 0.01),
    "world_bits": 16,
    "world_change_share": 0.5,
    "bin_span": "events",
    "added_sigma": [0.0, 0.1],
    "added_hot_share": [0.0, 0.001],
    "added_hot_sigma": [0.0, 0.1],
    "track_points": 32,
    "contrast_probability": 0.1,
    "contrast_scale": [1.0, 2.0],
    "gamma": 1.0,
    "log_eps": [0.002, 0.1],
    "light": "declared",
    "start": "triangular",
    "rate_draw": "log",
    "threshold": [0.05, 1.0],
    "threshold_ratio": [1.0, 1.6],
    "threshold_source": "video",
    "noise_sigma": [0.0, 0.2],
    "noise_scales_with_threshold": True,
    "hot_pixel_share": [0.0, 0.002],
    "hot_pixel_sigma": [1.0, 10.0],
    "noise_unit": "second",
    "threshold_mismatch_sigma": [0.0, 0.1],
    "shot_noise_hz": [0.0, 5.0],
    "leak_hz": [0.0, 0.1],
    "refractory_seconds": [0.0, 0.001],
    "photoreceptor_hz": [30.0, 300.0],
    "dead_pixel_share": [0.0, 0.001],
    "noise_band_share": [0.1, 0.2],
    "noise_band_hz": 30.0,
}
OTHER_SPEC_VALUES: dict[str, Any] = {
    "recipe": preset("paper-flow"),
    "voxel_dtype": "int16",
    "shuffle": False,
    "max_sequences_per_video": 11,
    "on_bad_video": "raise",
    "samples_per_decode": 2,
    "sibling_spacing": 24,
    "flow_method": "dis-fast-1",
    "flow_direction": "backward",
    "flow_from": 20,
    "flow_margin_px": -1,
    "substep_px": 1.0,
    "scene": "auto",
    "keep_defects": "bars,cuts",
    "still_share": 0.5,
    "quiet_share": 0.5,
    "moving_share": 0.5,
}


PRESET_DIGESTS = {
    "paper": "6d725a96e7160804493b3a2115ec52ec",
    "paper-fixed-thresholds": "b892ff2c82d2d701ce76de86768eb585",
    "paper-contrast": "a4cbede55f157503f07cee50beaed518",
    "paper-flow": "fbc255b14b44446bde5d716e1b46509d",
    "paper-eraft": "3b7249d33b7d2a0324db592549ef18ee",
    "noise-free": "38bcfc050063311ed5ffbbcc5165b7eb",
    "clean": "57535907175a695aa4614e9266b6ffda",
    "sensor": "977bcf963b48c05e7d8e251e735137db",
    "davis346": "c52d5b5342fc135b5676b3a5116ece57",
    "davis346-running": "1de5b42d34b14b580736c38330ca12b3",
    "davis346-measured": "4a6cb6039d26a7215cb2153ab99014ed",
    "worlds": "71b398f70f04d63139ff2eb79b61849d",
    "worlds-fine": "b426778d302c145883f2b6cdfb1f9d22",
    "recordings": "b3dee5cae311f3e3b51e111a51b9bbac",
}
"""No preset changes its meaning: new behaviour gets a new name."""


def test_digests_are_stable() -> None:
    """A saved position names this digest: if it changes, so must NUMERICS_VERSION or the digest's own version."""
    assert {name: StreamSpec(recipe=preset(name)).digest for name in PRESETS} == PRESET_DIGESTS
    assert StreamSpec() == StreamSpec(recipe=preset("paper"))
    assert StreamSpec(recipe=preset("paper-eraft"), voxel_dtype="float32").digest == "e6e6b36a65a66bf109874c82831fb500"


def test_a_complete_recipe_takes_nothing_from_the_server() -> None:
    """Also where a field is left out because it has its default."""
    server = StreamSpec(Recipe(grids_per_frame=4))
    assert StreamSpec.from_dict({"recipe": Recipe().to_dict()}, server).recipe == Recipe()
    assert StreamSpec.from_dict({"recipe": {"bins": 2}}, server).recipe == Recipe(grids_per_frame=4, bins=2)


def test_a_complete_spec_takes_nothing_from_the_server() -> None:
    """Also where a field is left out because it has its default."""
    assert StreamSpec.from_dict(StreamSpec().to_dict(), StreamSpec(substep_px=1.0)) == StreamSpec()
    assert StreamSpec.from_dict({"shuffle": False}, StreamSpec(substep_px=1.0)).substep_px == 1.0


def test_more_events_than_can_be_counted_are_refused() -> None:
    extreme = Recipe(threshold=(1e-6, 1e6))
    assert StreamSpec(extreme).substep_px == 0.0
    with pytest.raises(UsageError, match=r"substep_px = 1: a pixel may fire .* raise the recipe's smallest threshold"):
        StreamSpec(extreme, substep_px=1.0)
    with pytest.raises(UsageError, match=r"world_change_share = 0.5: .* or set world_change_share to 0"):
        StreamSpec(extreme.replace(world_change_share=0.5))


def test_every_field_is_covered() -> None:
    assert OTHER_RECIPE_VALUES.keys() == {field.name for field in dataclasses.fields(Recipe)}
    assert OTHER_SPEC_VALUES.keys() == {field.name for field in dataclasses.fields(StreamSpec)} - {"tolerance"}


def test_the_choices_of_a_field_are_those_of_its_type() -> None:
    fields = get_type_hints(StreamSpec)
    for name, setting in settings_of(StreamSpec).items():
        assert setting.words == get_args(fields[name])


def test_a_stream_preset_may_name_a_recipe_which_other_fields_change() -> None:
    stream = StreamSpec.from_dict({"preset": "natural-davis346"})
    assert stream.recipe == preset("davis346-running")
    assert stream == StreamSpec.from_dict({"preset": "natural", "recipe": "davis346-running"})
    changed = StreamSpec.from_dict({"preset": "natural-davis346", "recipe": {"bins": 3}})
    assert changed.recipe == preset("davis346-running").replace(bins=3)
    assert StreamSpec.from_dict({"preset": "natural-davis346", "recipe": "clean"}).recipe == preset("clean")


def test_every_field_changes_the_digest() -> None:
    digests = {StreamSpec().digest}
    for name, value in OTHER_RECIPE_VALUES.items():
        beside = {"noise_band_hz": 20.0} if name == "noise_band_share" else {}
        digests.add(StreamSpec.from_dict({"recipe": {name: value, **beside}}).digest)
    for name, value in OTHER_SPEC_VALUES.items():
        auto = {"scene": "auto"}
        needed = {"sibling_spacing": {"samples_per_decode": 3}, "moving_share": auto, "quiet_share": auto}.get(name, {})
        digests.add(StreamSpec.from_dict({name: value, **needed}).digest)
    # lead_frames alone is the preset paper-flow: one digest comes twice.
    assert len(digests) == 1 + len(OTHER_RECIPE_VALUES) + len(OTHER_SPEC_VALUES) - 1


@given(specs)
def test_canonical_form_reads_back_equal(spec: StreamSpec) -> None:
    again = StreamSpec.from_dict(json.loads(spec.canonical()))
    assert again == spec
    assert again.canonical() == spec.canonical()
    assert again.digest == spec.digest


@given(specs, specs | st.none())
def test_equal_specs_and_only_those_have_equal_digests(one: StreamSpec, other: StreamSpec | None) -> None:
    if other is None:
        other = StreamSpec.from_dict(one.to_dict())
    assert (one == other) == (one.digest == other.digest)


def test_minus_zero_is_zero() -> None:
    plain, minus = StreamSpec(Recipe(noise_sigma=(0.0, 0.0))), StreamSpec(Recipe(noise_sigma=(-0.0, 0.0)))
    assert plain == minus
    assert plain.digest == minus.digest


def test_whole_numbers_stand_for_floats() -> None:
    assert StreamSpec.from_dict({"recipe": {"gamma": 2, "threshold": 1}}).digest == (
        StreamSpec(Recipe(gamma=2.0, threshold=(1.0, 1.0))).digest
    )


@pytest.mark.parametrize("zero", [0, 0.0, -0.0, "0"])
def test_a_tolerance_of_0_has_the_digest_of_none(zero: object) -> None:
    assert StreamSpec.from_dict({"tolerance": zero}).canonical() == StreamSpec().canonical()


@pytest.mark.parametrize("value", [0.01, 5e-324, -1, 2, "all", math.nan])
def test_another_tolerance_is_refused_with_the_remedy(value: object) -> None:
    refused = rf"tolerance = {value!r}: give 0, or leave it out: .* saved hardly any time; all are simulated"
    for request in ({"tolerance": value}, {"recipe": {"tolerance": value}}):
        with pytest.raises(UsageError, match=refused):
            StreamSpec.from_dict(request)


# --- what a consumer may ask for --------------------------------------------------------------------------------------


def test_missing_fields_take_the_default_spec() -> None:
    default = StreamSpec(recipe=preset("paper-flow"), voxel_dtype="int16", shuffle=False)
    assert StreamSpec.from_dict({}, default) == default
    assert StreamSpec.from_dict({"shuffle": None, "recipe": None}, default) == default
    assert StreamSpec.from_dict({"voxel_dtype": "int8"}, default) == dataclasses.replace(default, voxel_dtype="int8")


def test_what_applies_to_scenes_stays_until_scene_is_off() -> None:
    assert StreamSpec.from_dict({"preset": "natural", "quiet_share": 0.5}).moving_share == 0.75
    off = StreamSpec.from_dict({"scene": "off"}, StreamSpec(scene="auto", moving_share=0.5, quiet_share=0.5))
    assert (off.moving_share, off.quiet_share) == (0.0, 1.0)


def test_recipe_fields_change_the_default_recipe_unless_a_preset_is_named() -> None:
    default = StreamSpec(recipe=preset("paper-eraft"))
    assert StreamSpec.from_dict({"recipe": {"bins": 3}}, default).recipe == preset("paper-eraft").replace(bins=3)
    assert StreamSpec.from_dict({"recipe": {"bins": 3, "preset": "paper"}}, default).recipe == Recipe(bins=3)


@pytest.mark.parametrize("name", PRESETS)
def test_a_recipe_may_be_a_presets_name(name: str) -> None:
    assert StreamSpec.from_dict({"recipe": name}).recipe == preset(name)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"voxels": 1}, "unknown spec key 'voxels'; known: preset, recipe, voxel_dtype"),
        ({b"shuffle": True}, "unknown spec key"),
        ({"voxel_dtype": "int32"}, "voxel_dtype = 'int32': choose one of int8, int16, float32"),
        ({"voxel_dtype": ["int8"]}, "voxel_dtype"),
        ({"scene": False}, "scene = False: choose one of off, auto .YAML reads off, on, no and yes as truth values"),
        ({"on_bad_video": "skip"}, "on_bad_video = 'skip': choose one of substitute, raise"),
        ({"shuffle": 1}, "shuffle = 1: give true or false"),
        ({"max_sequences_per_video": 0}, "max_sequences_per_video = 0"),
        ({"max_sequences_per_video": True}, "max_sequences_per_video = True"),
        ({"max_sequences_per_video": 1.0}, "max_sequences_per_video = 1.0"),
        ({"max_sequences_per_video": 1_000_001}, "from 1 to 1000000"),
        ({"recipe": 5}, "unknown recipe 5"),
        ({"recipe": ["paper"]}, "unknown recipe"),
    ],
)
def test_refusals(values: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        StreamSpec.from_dict(values)
