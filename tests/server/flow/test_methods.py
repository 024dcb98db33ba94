"""Every method of the registry: direction and sign against exact shifts, and pictures that methods choke on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.server.flow.fields import panned
from v2v_protocol.errors import UsageError
from v2v_server.flow import (
    METHODS,
    MOVING_METHOD,
    SLOW_METHOD,
    STILL_METHOD,
    choose,
    estimator,
    guarded,
    one_thread,
)

ESTIMATING = sorted(set(METHODS) - {"zero"})
INSIDE = np.s_[24:-24, 24:-24]


@pytest.mark.parametrize("name", ESTIMATING)
@pytest.mark.parametrize(("right", "down"), [(3, 0), (0, -2), (-4, 3)])
def test_sign_and_order_of_axes(name: str, right: int, down: int) -> None:
    first, second = panned(2, 128, 160, right, down)
    field = estimator(name)(first, second)
    assert field.shape == (128, 160, 2)
    assert field.dtype == np.float32
    error = np.linalg.norm(field[INSIDE] - np.float32([right, down]), axis=-1)
    assert np.median(error) < 0.25
    back = estimator(name)(second, first)
    assert np.median(np.linalg.norm(back[INSIDE] + np.float32([right, down]), axis=-1)) < 0.25


@pytest.mark.parametrize("name", sorted(METHODS))
def test_equal_pictures_have_exactly_zero_flow(name: str) -> None:
    picture = panned(1, 90, 120, 0, 0)[0]
    assert not estimator(name)(picture, picture.copy()).any()


@pytest.mark.parametrize("name", sorted(METHODS))
@pytest.mark.parametrize(
    "size", [(1, 1), (2, 300), (11, 12), (13, 40), (16, 300), (24, 600), (40, 40), (48, 48), (600, 20), (23, 64)]
)
def test_small_and_thin_pictures_are_survived(name: str, size: tuple[int, int]) -> None:
    """OpenCV refuses some of these sizes and dies of others; a fault here ends the whole test run."""
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 256, (2, *size), np.uint8)
    for one, other in ((first, second), (first, np.zeros_like(first)), (np.zeros_like(first), first)):
        field = estimator(name)(one, other)
        assert field.shape == (*size, 2)
        assert np.isfinite(field).all()


@pytest.mark.parametrize("name", sorted(METHODS))
def test_pictures_without_texture_do_not_move(name: str) -> None:
    """Nor does a change of brightness break anything: there is nothing to track."""
    flat = np.full((96, 130), 80, np.uint8)
    assert np.abs(estimator(name)(flat, flat + np.uint8(9))).max() < 1e-3


@pytest.mark.parametrize("name", sorted(METHODS))
def test_a_result_does_not_depend_on_what_came_before(name: str) -> None:
    frames = panned(4, 100, 140, 2, 1)
    fresh = estimator(name)(frames[0], frames[1])
    used = estimator(name)
    used(frames[2], frames[3])
    used(np.ascontiguousarray(frames[3, :70, :90]), np.ascontiguousarray(frames[2, :70, :90]))
    np.testing.assert_array_equal(used(frames[0], frames[1]), fresh)


@settings(max_examples=40)
@given(height=st.integers(1, 70), width=st.integers(1, 70))
def test_the_guard_enlarges_for_the_method_alone(height: int, width: int) -> None:
    seen = []

    def estimate(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        seen.append(first.shape)
        y, x = np.mgrid[: first.shape[0], : first.shape[1]]
        return np.stack([x, y], axis=-1).astype(np.float32)

    picture = np.zeros((height, width), np.uint8)
    field = guarded(estimate, 48)(picture, picture + np.uint8(1))
    assert seen == [(max(48, height), max(48, width))]
    y, x = np.mgrid[:height, :width]
    np.testing.assert_array_equal(field, np.stack([x, y], axis=-1))


def test_the_number_of_threads_is_put_back() -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with one_thread():
            assert cv2.getNumThreads() == 1
        with pytest.raises(ZeroDivisionError), one_thread():
            raise ZeroDivisionError
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


def test_an_unknown_method_is_named_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match=r"'dis-slow'.*dis-fast.*dis-fast-1"):
        estimator("dis-slow")


def test_auto_looks_at_the_motion() -> None:
    still = panned(1, 128, 160, 0, 0)[0]
    noise = np.random.default_rng(0).integers(-2, 3, still.shape)
    assert choose(still, np.clip(still.astype(int) + noise, 0, 255).astype(np.uint8)) == STILL_METHOD
    moved = panned(2, 128, 160, 4, 1)
    assert choose(moved[0], moved[1]) == MOVING_METHOD
    # A quarter of a pixel: the photograph enlarged four times, moved by one pixel and made small again.
    large = cv2.resize(panned(1, 130, 170, 0, 0)[0], None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    slow = [cv2.resize(large[:512, start : start + 640], (160, 128), interpolation=cv2.INTER_AREA) for start in (0, 1)]
    assert choose(slow[0], slow[1]) == SLOW_METHOD


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (9, 9), (20, 700)])
def test_auto_looks_at_any_size(size: tuple[int, int]) -> None:
    first, second = np.random.default_rng(2).integers(0, 256, (2, *size), np.uint8)
    assert choose(first, second) in METHODS
