"""Recipes and specs for property tests: any that the limits admit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

from hypothesis import strategies as st

from v2v_protocol.errors import RecipeError
from v2v_protocol.recipe import LARGEST_EVENTS, Recipe
from v2v_protocol.spec import MOST_SAMPLES_PER_DECODE, MOST_SUBSTEPS, VOXEL_DTYPES, OnBadVideo, StreamSpec


def _range(low: float, high: float) -> st.SearchStrategy[tuple[float, float]]:
    ends = st.floats(low, high)
    return st.tuples(ends, ends).map(lambda pair: (min(pair), max(pair)))


_SHARE = st.floats(0.0, 1.0)


_COUNTED = ("threshold", "threshold_ratio", "noise_sigma", "hot_pixel_sigma", "leak_hz")


def _recipe(milder: Sequence[str], **values: object) -> Recipe:
    """Values that are fine each by itself may make more events together than can be counted: then the fields that count
    most take their defaults, one after another in the order ``milder``. Nothing is drawn in vain."""
    if values["voxel_seconds"] != (0.0, 0.0):
        values["grids_per_frame"] = 0
    if values["grids_per_frame"] or values["voxel_seconds"] != (0.0, 0.0):
        values["frames_per_bin"] = 1
    for name in milder:
        try:
            return Recipe(**values)  # type: ignore[arg-type]
        except RecipeError as error:
            if "events in a clip" not in str(error):
                raise
            del values[name]
    return Recipe(**values)  # type: ignore[arg-type]


recipes = st.builds(
    _recipe,
    milder=st.permutations(_COUNTED),
    voxels_per_clip=st.integers(1, 500),
    bins=st.integers(1, 20),
    frames_per_bin=st.integers(1, 20),
    grids_per_frame=st.just(0) | st.integers(1, 20),
    voxel_seconds=st.just((0.0, 0.0)) | _range(1e-6, 100.0),
    lead_frames=st.integers(0, 1),
    lead_voxels=st.integers(0, 1),
    frame_stride=st.integers(1, 3),
    max_boxes=st.integers(1, 4096),
    crop_height_px=st.integers(1, 16_384),
    crop_width_px=st.integers(1, 16_384),
    resize_scale=_range(0.01, 100.0),
    flip_probability=_SHARE,
    pause_probability=_SHARE,
    pause_stay_probability=_SHARE,
    contrast_probability=_SHARE,
    contrast_scale=_range(0.0, 100.0),
    gamma=st.floats(0.05, 20.0),
    log_eps=_range(1e-12, 1.0),
    light=st.sampled_from(["sdr", "declared"]),
    threshold=_range(1e-6, 1e6),
    threshold_ratio=_range(1e-6, 1e6),
    threshold_source=st.sampled_from(("sample", "video")),
    noise_sigma=_range(0.0, 1e6),
    noise_scales_with_threshold=st.booleans(),
    hot_pixel_share=_range(0.0, 1.0),
    hot_pixel_sigma=_range(0.0, 1e9),
    noise_unit=st.sampled_from(("frame", "second")),
    threshold_mismatch_sigma=_range(0.0, 1.0),
    shot_noise_hz=_range(0.0, 1e4),
    leak_hz=_range(0.0, 1e4),
    refractory_seconds=_range(0.0, 1e3),
    photoreceptor_hz=st.just((0.0, 0.0)) | _range(0.01, 1e6),
    dead_pixel_share=_range(0.0, 1.0),
)


def _spec(recipe: Recipe, substep_px: float, **values: Any) -> StreamSpec:
    if recipe.worst_events(1.0, levels_per_step=MOST_SUBSTEPS) > LARGEST_EVENTS:
        substep_px = 0.0
    return StreamSpec(recipe, substep_px=substep_px, **values)


specs = st.builds(
    _spec,
    recipe=recipes,
    substep_px=st.just(0.0) | st.floats(0.01, 64.0),
    voxel_dtype=st.sampled_from(VOXEL_DTYPES),
    shuffle=st.booleans(),
    max_sequences_per_video=st.integers(1, 1_000_000),
    on_bad_video=st.sampled_from(get_args(OnBadVideo)),
    samples_per_decode=st.integers(1, MOST_SAMPLES_PER_DECODE),
)
