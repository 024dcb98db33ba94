"""Events made of voxel grids: accumulated again they are the grids, exactly, and their times follow the stated rule."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from v2v_protocol.errors import UsageError
from v2v_protocol.events import to_events

GRIDS = st.one_of(
    arrays.arrays(np.int8, st.tuples(*[st.integers(1, 4)] * 4), elements=st.integers(-128, 127)),
    arrays.arrays(np.int16, st.tuples(*[st.integers(1, 3)] * 4), elements=st.integers(-2000, 2000)),
    arrays.arrays(np.float32, st.tuples(*[st.integers(1, 3)] * 4), elements=st.integers(-300, 300).map(float)),
)


@given(GRIDS, st.floats(1.0, 1e7))
def test_accumulated_again_they_are_the_voxel_grids(voxels: npt.NDArray[Any], bin_us: float) -> None:
    events = to_events(voxels, bin_us)
    again = events.voxels(*voxels.shape[:2], bin_us, dtype=voxels.dtype.name)
    assert again.dtype == voxels.dtype
    np.testing.assert_array_equal(again, voxels)
    assert len(events) == np.abs(voxels.astype(np.int64)).sum()
    assert (np.diff(events.t) >= 0).all()
    assert (events.width_px, events.height_px) == (voxels.shape[3], voxels.shape[2])


def test_times_are_spread_over_their_bin() -> None:
    voxels = np.zeros((1, 2, 2, 3), np.int8)
    voxels[0, 0, 1, 2], voxels[0, 1, 0, 0] = -2, 1
    events = to_events(voxels, 1000.5)
    assert events.t.tolist() == [250, 750, 1000 + 500]
    assert events.x.tolist() == [2, 2, 0]
    assert events.y.tolist() == [1, 1, 0]
    assert events.p.tolist() == [False, False, True]


def test_no_events_are_events_too() -> None:
    events = to_events(np.zeros((2, 5, 4, 4), np.int8), 100)
    assert len(events) == 0
    assert not events.voxels(2, 5, 100).any()


@pytest.mark.parametrize(
    ("voxels", "bin_us", "message"),
    [
        (np.zeros((2, 4, 4), np.int8), 100, "T, bins, H, W"),
        (np.zeros((1, 1, 4, 4), np.uint8), 100, "signed"),
        (np.full((1, 1, 4, 4), 0.5, np.float32), 100, "not whole"),
        (np.full((1, 1, 4, 4), np.nan, np.float32), 100, "not whole"),
        (np.zeros((1, 1, 4, 4), np.int8), 0.5, "bin_us"),
        (np.zeros((1, 1, 4, 4), np.int8), float("nan"), "bin_us"),
        (np.zeros((1, 1, 4, 4), np.int8), float("inf"), "bin_us"),
    ],
)
def test_what_no_events_are_made_of(voxels: npt.NDArray[Any], bin_us: float, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        to_events(voxels, bin_us)
