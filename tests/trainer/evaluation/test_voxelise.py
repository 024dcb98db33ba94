"""Test voxel grids: a slow oracle in exact fractions, the two kinds of span, and edges."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from trainer.evaluation.voxelise import Events, VoxelSettings, voxel_grid
from v2v_protocol.errors import UsageError

SIZE = (3, 4)

recorded = st.lists(
    st.tuples(st.integers(0, 40_000), st.integers(0, 3), st.integers(0, 2), st.sampled_from((-1, 1))),
    min_size=1,
    max_size=60,
).map(sorted)


def events(rows: list[tuple[int, int, int, int]], start: float = 100.0) -> Events:
    t, x, y, p = (np.array(column) for column in zip(*rows, strict=True))
    return Events(start + t / 1e6, x, y, p.astype(np.float32))


def grid(rows: list[tuple[int, int, int, int]], kind: str, bins: int = 5, **options: object) -> np.ndarray:
    settings = VoxelSettings(kind=kind, bins=bins, **options)  # type: ignore[arg-type]
    return voxel_grid(events(rows), SIZE, settings, (100.0, 100.04))


def oracle(rows: list[tuple[int, int, int, int]], kind: str, bins: int, span: str) -> np.ndarray:
    """Compute the module's formulas event by event, in exact fractions. The end of the window is in its last bin."""
    result = [[[Fraction(0)] * SIZE[1] for _ in range(SIZE[0])] for _ in range(bins)]
    delta = Fraction(1, 1000 if kind == "discrete" else 10_000)
    begin, length = (0, Fraction(40_000)) if span == "window" else (rows[0][0], rows[-1][0] - rows[0][0] + delta)
    for t, x, y, p in rows:
        u = (t - begin) / length
        for b in range(bins):
            if kind == "discrete":
                result[b][y][x] += p * (min(floor(bins * u), bins - 1) == b)
            else:
                result[b][y][x] += p * max(Fraction(0), 1 - abs((bins - 1) * u - b))
    return np.array(result, np.float64)


@example([(0, 0, 0, 1), (32_000, 1, 0, 1), (40_000, 2, 0, -1)], "discrete", 5, "window")
@given(
    recorded, st.sampled_from(("discrete", "interpolated")), st.integers(1, 7), st.sampled_from(("events", "window"))
)
def test_voxel_grids_equal_the_oracle(rows: list[tuple[int, int, int, int]], kind: str, bins: int, span: str) -> None:
    tolerance = 0 if kind == "discrete" else 1e-5
    found = grid(rows, kind, bins, span=span)
    np.testing.assert_allclose(found, oracle(rows, kind, bins, span), rtol=0, atol=tolerance)


@pytest.mark.parametrize(("truncate", "expected"), [(False, 1), (True, 0)])
def test_truncation_moves_an_event_that_is_just_below_its_microsecond(truncate: bool, expected: int) -> None:
    """3 of 14 us are in the second fifth, 2 in the first; 3 us after 0.25 s are just below 3 us in binary."""
    t = 0.25 + np.array([0, 3, 14]) / 1e6
    assert 2.9 < (t[1] - t[0]) * 1e6 < 3
    numbers = np.arange(3)
    found = Events(t, numbers, np.zeros(3, int), np.ones(3, np.float32))
    result = voxel_grid(found, SIZE, VoxelSettings(truncate=truncate), (0, 0))
    assert np.argwhere(result[:, 0, 1]).tolist() == [[expected]]


@pytest.mark.parametrize("kind", ["discrete", "interpolated"])
@pytest.mark.parametrize("span", ["events", "window"])
def test_no_events_and_simultaneous_events_are_valid(kind: str, span: str) -> None:
    nothing = Events(np.zeros(0), np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32))
    settings = VoxelSettings(kind=kind, span=span)  # type: ignore[arg-type]
    assert not voxel_grid(nothing, SIZE, settings, (0, 1)).any()
    together = grid([(0, 1, 1, 1), (0, 1, 1, 1), (0, 2, 1, -1)], kind, span=span)
    assert (together[0, 1, 1], together[0, 1, 2]) == (2, -1)
    assert not together[1:].any()


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint64])
def test_coordinates_of_any_integer_type_give_the_same_grid(dtype: npt.DTypeLike) -> None:
    rows = [(0, 3, 2, 1), (7, 0, 1, -1), (9, 3, 0, 1)]
    found = events(rows)
    typed = Events(found.t, found.x.astype(dtype), found.y.astype(dtype), found.p)
    np.testing.assert_array_equal(voxel_grid(typed, SIZE, VoxelSettings(), (100.0, 100.04)), grid(rows, "discrete"))


@pytest.mark.parametrize(("x", "y"), [(4, 0), (-1, 0), (0, 3), (0, -1)])
def test_events_outside_are_refused(x: int, y: int) -> None:
    with pytest.raises(
        UsageError, match=f"1 of 2 events lie outside the sensor of 4 x 3, the first at x = {x}, y = {y}"
    ):
        grid([(0, 0, 0, 1), (1, x, y, 1)], "discrete")


@pytest.mark.parametrize("options", [{"kind": "square"}, {"span": "all"}, {"bins": 0}, {"bins": 2.5}])
def test_settings_are_checked(options: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="give"):
        VoxelSettings(**options)  # type: ignore[arg-type]
