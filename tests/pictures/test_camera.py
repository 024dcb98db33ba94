"""A camera: its rates, pauses and moments, and what it says of noise and motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.pictures.cameras import camera, without_noise
from tests.protocol.test_sample import PARAMS, PROVENANCE
from v2v_pictures.camera import Camera, _with_unit
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe


def test_rates_are_events_a_pixel_of_each_sign() -> None:
    voxels = np.zeros((2, 3, 4, 5), np.int8)
    voxels[1, 2, 0, :] = 2
    voxels[0, 1, 0, 0] = -128
    rates = camera(voxels).rates
    assert rates.shape == (2, 6)
    assert rates[0].tolist() == [0, 0, 0, 0, 0, 0.5]
    assert rates[1].tolist() == [0, 6.4, 0, 0, 0, 0]


@given(st.data())
def test_a_bin_is_paused_where_all_its_frames_repeat(data: st.DataObject) -> None:
    """Against the definition, frame by frame: what the draw says of each position."""
    grids, bins, per_bin, lead = (data.draw(st.integers(low, 4)) for low in (1, 1, 1, 0))
    steps = (grids + lead) * bins * per_bin
    still = data.draw(st.lists(st.booleans(), min_size=steps, max_size=steps))
    edges = np.flatnonzero(np.diff([False, *still, False]))
    pauses = tuple((int(start) + 1, int(end - start)) for start, end in zip(edges[::2], edges[1::2], strict=True))
    shown = dataclasses.replace(
        camera(np.zeros((grids + lead, bins, 2, 2), np.int8), pauses=pauses, lead=lead), steps_per_frame=per_bin * bins
    )
    source = shown.provenance.params.source_index(steps)
    expected = [
        all(source[step + 1] == source[step] for step in range(first, first + per_bin))
        for first in range(lead * bins * per_bin, steps, per_bin)
    ]
    assert shown.paused.tolist() == expected


@pytest.mark.parametrize("name", ["event_counts", "voxels_bilinear"])
def test_events_of_either_form_are_signed_counts(name: str) -> None:
    """Two grids of three bins in each of two steps: the bins of a step are shown together."""
    counts = np.random.default_rng(1).integers(0, 5, (4, 2, 3, 8, 8)).astype(np.int8)
    signed = counts[:, 1] - counts[:, 0]
    arrays = {name: counts if name == "event_counts" else signed, "frames": np.zeros((2, 1, 8, 8), np.uint8)}
    paused = dataclasses.replace(PROVENANCE, params=dataclasses.replace(PARAMS, pauses=((2, 1),)))
    shown = Camera.of(arrays, paused, "", Recipe(voxels_per_clip=2, bins=3, grids_per_frame=2))
    np.testing.assert_array_equal(shown.voxels, signed.reshape(2, 6, 8, 8))
    assert shown.paused.tolist() == [False] * 6 + [True] * 6


def test_moments_are_active_and_not_paused() -> None:
    voxels = np.ones((20, 5, 4, 4), np.int8)
    voxels[0] = 100  # the beginning, when every pixel waits for its first event
    voxels[7], voxels[12] = 50, 40
    chosen = camera(voxels, pauses=((7 * 5 + 1, 5),)).moments(1)
    assert chosen == [12]
    assert camera(voxels).moments(2) == [7, 12]
    assert camera(voxels[:1]).moments(3) == [0]


def test_a_moment_that_is_half_paused_is_better_than_one_with_nothing_but_noise() -> None:
    voxels = np.zeros((20, 5, 4, 4), np.int8)
    voxels[:, :, 0, 0] = 1
    voxels[9] = 30
    assert camera(voxels, pauses=((9 * 5 + 1, 3), (15 * 5 + 1, 10))).moments(1) == [9]
    voxels[12] = 30
    assert camera(voxels, pauses=((9 * 5 + 1, 1),)).moments(1) == [12]


def test_a_cut_is_no_moment() -> None:
    voxels = np.zeros((20, 5, 4, 4), np.int8)
    voxels[7, 4], voxels[12] = 100, 3
    assert camera(voxels).moments(1) == [12]
    assert camera(voxels[:, 4:]).moments(1) == [7]  # of one bin each: nothing else is known


@given(st.integers(1, 30), st.integers(1, 8))
def test_moments_are_in_order_and_different(grids: int, count: int) -> None:
    chosen = camera(np.ones((grids, 2, 2, 2), np.int8)).moments(count)
    assert chosen == sorted(set(chosen))
    assert 1 <= len(chosen) <= count
    assert all(0 <= moment < grids for moment in chosen)


def test_lead_frames_and_voxels_stand_in_front() -> None:
    frames = (10 * np.arange(5, dtype=np.uint8))[:, None, None, None] * np.ones((1, 1, 4, 4), np.uint8)
    voxels = np.arange(5, dtype=np.int8)[:, None, None, None] * np.ones((1, 2, 4, 4), np.int8)
    for arrays in ({"frames": frames, "voxels": voxels[1:]}, {"frames": frames[1:], "voxels": voxels}):
        shown = Camera.of(arrays, PROVENANCE, "")
        assert shown.frames[:, 0, 0].tolist() == [10, 20, 30, 40]
        assert shown.voxels[:, 0, 0, 0].tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("name", ["voxels", "frames"])
def test_both_arrays_are_needed(name: str) -> None:
    with pytest.raises(UsageError, match="voxels,frames"):
        Camera.of({name: np.zeros((2, 1, 8, 8), np.uint8)}, PROVENANCE, "")


@pytest.mark.parametrize(("value", "shown"), [(1.26, "1.3"), (99.4, "99"), (257.6, "258")])
def test_effects_are_described_without_exponents(value: float, shown: str) -> None:
    assert _with_unit("photoreceptor_hz", value) == f"photoreceptor {shown} Hz"


def test_a_drawn_dark_floor_is_described() -> None:
    """It is all in which the preset `sensor` differs from `paper`."""
    shown = camera(np.zeros((2, 2, 16, 16), np.int8))
    params = dataclasses.replace(PARAMS, log_eps=0.125)
    floor = dataclasses.replace(shown, provenance=dataclasses.replace(PROVENANCE, params=params))
    assert "dark floor" not in shown.describe()
    assert "dark floor 0.125" in floor.describe()


def test_the_noise_share_is_that_of_the_voxel_grids_that_are_shown() -> None:
    loud = np.ones((4, 2, 16, 16), np.int8)
    quiet = loud.copy()
    quiet[1, :, :12] = 0
    quiet[2] = 0
    shown = without_noise(camera(loud), quiet)
    assert shown.noise_share([0]) == 0.0
    assert shown.noise_share([1]) == 0.75
    assert shown.noise_share([0, 1, 2]) == pytest.approx(1.75 / 3)
    assert shown.warning([0]) == ""
    assert shown.warning([1]) == "mostly noise: 75% of the events"
    assert shown.warning([0, 2]) == ""
    assert camera(loud).noise_share([1]) is None
    assert camera(loud).warning([1]) == ""


def test_a_camera_without_motion_says_why() -> None:
    loud, frames = np.ones((3, 2, 16, 16), np.int8), np.full((3, 16, 16), 90, np.uint8)
    shown = without_noise(dataclasses.replace(camera(loud), frames=frames), 0 * loud)
    assert shown.warning([2]) == "nothing moves here: all events are noise"
    frames = frames.copy()
    frames[2, 4:8] = 140
    moving = dataclasses.replace(shown, frames=frames)
    assert moving.warning([1]) == "nothing moves here: all events are noise"
    assert moving.warning([2]) == "no motion reaches the thresholds: all events are noise"
    assert without_noise(camera(0 * loud), 0 * loud).warning([0]) == "nothing moves here"


def test_moments_show_motion_instead_of_noise() -> None:
    loud, quiet = np.zeros((2, 20, 5, 4, 4), np.int8)
    loud[7], loud[12], quiet[12] = 5, 3, 3
    assert camera(loud).moments(1) == [7]
    assert without_noise(camera(loud), quiet).moments(1) == [12]
