"""SampleId, SampleParams, Provenance, array layouts."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import Provenance, Refusal, SampleId, SampleParams, array_layout, layout_bytes

PARAMS = SampleParams(
    threshold_pos=0.25,
    threshold_neg=0.375,
    noise_sigma=0.05,
    hot_pixel_count=3,
    hot_pixel_sigma=1.5,
    pauses=((4, 2), (9, 1)),
    scale=1.0,
    crop_top_px=7,
    crop_left_px=11,
    flip=True,
    contrast=0.0,
    noise_key=(1, 2, 3, 2**32 - 1),
)
PROVENANCE = Provenance(
    id=SampleId("a" * 32, "b" * 32, 1, 2**64 - 1, 2**32 - 1, 2**48 - 1),
    video="tree/clip.mp4",
    fingerprint="123-abc",
    start_frame=200,
    candidate=2,
    refusals=(Refusal("bad.mp4", 17, "no frame"), Refusal("worse.mp4", None, "does not open")),
    params=PARAMS,
    saturated_bins=5,
    irregular_timestamps=0,
    decoder="h264",
)


# --- identity ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "limit"), [("seed", 2**64 - 1), ("epoch", 2**32 - 1), ("index", 2**48 - 1)])
def test_limits_of_an_identity(name: str, limit: int) -> None:
    good: dict[str, Any] = {"seed": 0, "epoch": 0, "index": 0}
    assert getattr(SampleId("s", "c", 1, **good | {name: limit}), name) == limit
    for bad in (-1, limit + 1, True, 1.0, "1", None):
        with pytest.raises(UsageError, match=f"{name} = .*: give a whole number from 0 to {limit}"):
            SampleId("s", "c", 1, **good | {name: bad})


# --- pauses -----------------------------------------------------------------------------------------------------------


@given(st.lists(st.booleans(), max_size=300))
def test_source_index_against_a_walk_over_the_positions(paused: list[bool]) -> None:
    """``paused[i]``: position i + 1 repeats the frame before."""
    runs, walk, shown = [], [0], 0
    for position, still in enumerate(paused, start=1):
        shown += not still
        walk.append(shown)
        if still and (position == 1 or not paused[position - 2]):
            runs.append([position, 0])
        if still:
            runs[-1][1] += 1
    params = dataclasses.replace(PARAMS, pauses=tuple((first, length) for first, length in runs))
    index = params.source_index(len(paused))
    assert index.dtype == np.int64
    assert index.tolist() == walk
    assert index[0] == 0
    assert set(np.diff(index).tolist()) <= {0, 1}


# --- provenance -------------------------------------------------------------------------------------------------------


def packed(provenance: Provenance) -> dict[str, Any]:
    values: dict[str, Any] = msgpack.unpackb(msgpack.packb(provenance.to_dict()))
    return values


@given(
    st.floats(allow_nan=False, allow_infinity=False), st.lists(st.tuples(st.integers(0, 2**40), st.integers(0, 2**40)))
)
def test_any_draw_travels_unchanged(number: float, pauses: list[tuple[int, int]]) -> None:
    params = SampleParams(number, number, number, 0, number, tuple(pauses), number, 0, 0, False, number, (0, 1, 2, 3))
    provenance = Provenance(PROVENANCE.id, "v", "f", 0, 0, (), params, 0, 0, "d")
    assert Provenance.from_dict(packed(provenance)) == provenance


def test_effects_travel_where_there_are_any() -> None:
    """Without effects the provenance has the bytes it had before there were any."""
    assert "effects" not in packed(PROVENANCE)["params"]
    assert "effects" not in PARAMS.to_dict()
    effects = {"leak_hz": 0.1, "shot_noise_hz": 5.0}
    provenance = dataclasses.replace(PROVENANCE, params=dataclasses.replace(PARAMS, effects=effects))
    assert packed(provenance)["params"]["effects"] == effects
    assert Provenance.from_dict(packed(provenance)) == provenance


def test_what_earlier_releases_left_out_stays_readable() -> None:
    assert "left_out" not in packed(PROVENANCE)
    record = packed(PROVENANCE) | {"left_out": ["leak_hz"]}
    provenance = Provenance.from_dict(record)
    assert provenance.left_out == ("leak_hz",)
    assert packed(provenance) == record


def test_refusals_read_as_one_line() -> None:
    assert str(Refusal("a.mp4", 17, "cut short")) == "a.mp4 at frame 17: cut short"
    assert str(Refusal("a.mp4", None, "does not open")) == "a.mp4: does not open"


# --- layouts ----------------------------------------------------------------------------------------------------------


def test_layout_of_the_paper() -> None:
    layout = array_layout(Recipe(), "int8", ("voxels", "frames"))
    assert layout == {"voxels": ("int8", (40, 5, 128, 128)), "frames": ("uint8", (40, 1, 128, 128))}
    # The paper's batch of 12 is 39.3 MB of int8 voxels and 7.9 MB of frames.
    assert 12 * layout_bytes({"voxels": layout["voxels"]}) == 39_321_600
    assert 12 * layout_bytes({"frames": layout["frames"]}) == 7_864_320


def test_layout_with_leads_in_the_order_asked() -> None:
    layout = array_layout(preset("paper-eraft"), "float32", ("frames", "voxels"))
    assert list(layout.items()) == [
        ("frames", ("uint8", (41, 1, 128, 128))),
        ("voxels", ("float32", (41, 5, 128, 128))),
    ]
    assert list(array_layout(preset("paper-flow"), "int16", ("voxels",)).values()) == [("int16", (40, 5, 128, 128))]


def test_the_largest_layout_does_not_overflow() -> None:
    recipe = Recipe(voxels_per_clip=976, bins=1024, crop_height_px=16_384, crop_width_px=16_384)
    assert layout_bytes(array_layout(recipe, "float32", ("voxels",))) == 976 * 1024 * 16_384**2 * 4


@pytest.mark.parametrize("arrays", [(), ("voxels", "voxels"), ("depth",), ("voxels", "")])
def test_unknown_arrays_are_refused(arrays: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="arrays"):
        array_layout(Recipe(), "int8", arrays)
