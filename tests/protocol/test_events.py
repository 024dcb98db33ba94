"""Events with times: their sums in bins, and the whole microseconds at which bins begin."""

from __future__ import annotations

import numpy as np
import pytest

from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList, check_duration, whole_edges


def _events(*columns: tuple[int, int, int, bool]) -> EventList:
    x, y, t, p = (np.array(column) for column in zip(*columns, strict=True))
    return EventList(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p, 3, 2)


def test_events_are_summed_in_the_bin_that_holds_their_time() -> None:
    """A bin of 1000.5 microseconds ends at 1000.5, so 1000 is in the first and 1001 in the second."""
    events = _events((2, 1, 0, False), (2, 1, 1000, False), (0, 0, 1001, True), (1, 0, 2000, True), (1, 1, 2001, True))
    voxels = events.voxels(1, 2, 1000.5, "int8")
    assert voxels.dtype == np.int8
    expected = np.zeros((1, 2, 2, 3), np.int8)
    expected[0, 0, 1, 2], expected[0, 1, 0, 0], expected[0, 1, 0, 1] = -2, 1, 1
    np.testing.assert_array_equal(voxels, expected)
    assert len(events) == 5


def test_an_edge_that_is_whole_but_for_a_rounding_is_whole() -> None:
    assert whole_edges(np.array([0.0, 3000.0000000004, 2999.9999999996, 0.1, 33333.33])).tolist() == [
        0, 3000, 3000, 1, 33334,
    ]  # fmt: skip


@pytest.mark.parametrize("total_us", [0.5, 0.0, -1.0, 2.0**62, float("nan"), float("inf")])
def test_a_duration_without_whole_microseconds_is_refused(total_us: float) -> None:
    with pytest.raises(UsageError, match="microseconds: give a clip of at least 1"):
        check_duration(total_us)
    with pytest.raises(UsageError, match="microseconds"):
        _events((0, 0, 0, True)).voxels(1, 1, total_us)
