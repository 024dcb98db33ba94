"""Motion between two pictures, and the pictures between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.rendered import rendered_scene
from v2v_server.motion import Cells, MotionOfCuts, motions
from v2v_server.motion.matching import UNITS_PER_PX, Vectors, motion
from v2v_server.motion.pyramid import Pyramid, padded
from v2v_server.motion.warping import between
from v2v_server.video.decode import Cut

HALF_PX = UNITS_PER_PX // 2


def without_slow(vectors: Vectors, shortest: int) -> Vectors:
    """Return vectors [2, rows, columns] with those below a length, 1/UNITS_PER_PX px, set to zero."""
    return vectors * (np.square(vectors, dtype=np.int64).sum(axis=0) >= shortest * shortest)


@pytest.mark.parametrize("px", [1.3, 4.0, 12.0])
def test_a_pan_is_found(px: float) -> None:
    first, second = rendered_scene("gravel", 128, 128, 30 * px).frames(30, 2)
    found = without_slow(motion(Pyramid.of(first), Pyramid.of(second)), HALF_PX)[:, 6:-6, 6:-6] / UNITS_PER_PX
    lengths = np.hypot(*found)
    assert abs(np.median(lengths) - px) < 0.25
    assert np.quantile(np.hypot(*(found - np.median(found, axis=(1, 2), keepdims=True))), 0.9) < 0.5


def test_what_rests_has_no_motion() -> None:
    """Neither in a still picture, nor under a lamp that flickers, nor where an edge moves by a third of a pixel."""
    still = rendered_scene("coffee", 128, 128, 0.0).frames(30, 2)
    assert not without_slow(motion(Pyramid.of(still[0]), Pyramid.of(still[1])), HALF_PX).any()
    noisy = still[1] + np.random.default_rng(0).integers(-1, 2, still[1].shape).astype(np.uint8)
    assert not without_slow(
        motion(Pyramid.of(still[0]), Pyramid.of(np.where(still[1] % 255, noisy, still[1]))), HALF_PX
    ).any()
    lit = rendered_scene("flicker", 128, 128, 0.0).frames(30, 2)
    assert (without_slow(motion(Pyramid.of(lit[0]), Pyramid.of(lit[1])), HALF_PX) == 0).all(axis=0).mean() > 0.99
    slow = rendered_scene("coffee", 128, 128, 9.0).frames(30, 2)
    assert (without_slow(motion(Pyramid.of(slow[0]), Pyramid.of(slow[1])), HALF_PX) == 0).all(axis=0).mean() > 0.98


@settings(deadline=None, max_examples=40)
@given(
    st.integers(4, 70), st.integers(4, 70), st.sampled_from(("noise", "black", "checked", "bright", "cut")),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_any_pictures_have_bounded_motion(height: int, width: int, kind: str, seed: int) -> None:
    generator = np.random.default_rng(seed)
    first = generator.integers(0, 256, (height, width)).astype(np.uint8)
    second = {
        "noise": generator.integers(0, 256, (height, width)).astype(np.uint8),
        "black": np.zeros_like(first),
        "checked": (np.indices(first.shape).sum(axis=0) % 2 * 255).astype(np.uint8),
        "bright": np.full_like(first, 255),
        "cut": np.roll(first, 40, 1),
    }[kind]
    for one, other in ((first, second), (second, first)):
        found = without_slow(motion(Pyramid.of(one), Pyramid.of(other)), HALF_PX)
        assert found.shape == (2, -(-height // 4), -(-width // 4))
        assert np.abs(found.astype(int)).max() <= 2 * (max(height, width) + 32) * UNITS_PER_PX
        squares = (found.astype(int) ** 2).sum(axis=0)
        assert squares[squares > 0].min(initial=HALF_PX**2) >= HALF_PX**2


# --- motion of some cells, as of all ----------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(
    st.sampled_from(("gravel", "parallax", "thin", "flicker")), st.sampled_from((0.0, 1.5, 9.0)),
    st.integers(9, 230), st.integers(9, 230), st.data(),
)  # fmt: skip
def test_the_motion_of_cuts_is_that_of_the_whole_pictures(
    name: str, px: float, height: int, width: int, data: st.DataObject
) -> None:
    pictures = rendered_scene(name, 230, 230, 30 * px).frames(30, 3)[:, :height, :width]
    whole = motions(pictures)
    rows, columns = whole.shape[2:]
    cuts = []
    for _ in range(data.draw(st.integers(1, 3))):
        top, left = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
        size = data.draw(st.integers(1, rows - top)), data.draw(st.integers(1, columns - left))
        cuts.append(Cut(data.draw(st.integers(1, 3)), cells=Cells(top, left, *size)))
    found = MotionOfCuts([Cut(3), *cuts])
    for picture in pictures[: max(cut.count for cut in cuts)]:
        found.add(Pyramid.of(picture))
    for cut, vectors in zip(cuts, found.vectors, strict=True):
        assert cut.cells is not None
        top, left, down, across = cut.cells
        np.testing.assert_array_equal(vectors, whole[: cut.count, :, top : top + down, left : left + across])


# --- pictures between two pictures, against float64 -------------------------------------------------------------------

Reals = npt.NDArray[np.float64]
PARTS = 16
"""Of a grey level."""


def warped(first: Reals, second: Reals, vector: tuple[float, float], share: float, row: int, column: int) -> float:
    """Return the grey level of a pixel that moves with a cell whose middle is at the same place."""
    height, width = first.shape
    seen, inside = [], []
    for picture, ahead in ((first, -share), (second, 1.0 - share)):
        y, x = row + np.rint(ahead * vector[1] * 32) / 32, column + np.rint(ahead * vector[0] * 32) / 32
        total = 0.0
        for near_y in range(-1, 3):
            for near_x in range(-1, 3):
                at_y, at_x = int(np.floor(y)) + near_y, int(np.floor(x)) + near_x
                grey = picture[min(max(at_y, 0), height - 1), min(max(at_x, 0), width - 1)]
                total += cubic(y - at_y) * cubic(x - at_x) * grey
        seen.append(total)
        inside.append(0 <= np.floor(y) < height and 0 <= np.floor(x) < width)
    if inside[0] != inside[1]:
        return float(seen[0] if inside[0] else seen[1])
    return float((1 - share) * seen[0] + share * seen[1])


def cubic(distance: float) -> float:
    d = abs(distance)
    if d <= 1:
        return 1.25 * d**3 - 2.25 * d**2 + 1
    return -0.75 * d**3 + 3.75 * d**2 - 6 * d + 3 if d < 2 else 0.0


def made(
    first: npt.NDArray[np.uint8],
    second: npt.NDArray[np.uint8],
    vector: tuple[int, int],
    count: int,
    *,
    mirrored: bool = False,
) -> Reals:
    height, width = first.shape
    vectors = np.empty((2, -(-height // 4), -(-width // 4)), np.int16)
    vectors[0], vectors[1] = vector
    out = np.empty((count, height, width), np.uint16)
    one, other = padded(np.ascontiguousarray(first)), padded(np.ascontiguousarray(second))
    between(one, other, vectors, 0, 0, 0, out, mirrored=mirrored)
    return out / PARTS


@settings(deadline=None, max_examples=30)
@given(st.integers(-100, 100), st.integers(-100, 100), st.integers(1, 15), st.integers(0, 2**32 - 1))
def test_each_pixel_is_what_both_pictures_show_along_the_motion(x: int, y: int, count: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    first, second = generator.integers(0, 256, (2, 40, 44)).astype(np.uint8)
    pictures = made(first, second, (x, y), count)
    vector = x / UNITS_PER_PX, y / UNITS_PER_PX
    for row, column in generator.integers(10, 28, (6, 2)):
        number = int(generator.integers(count))
        expected = warped(first * 1.0, second * 1.0, vector, (number + 1) / (count + 1), int(row), int(column))
        # Shares are rounded to 1/256 and weights to 1/64: a place may be 1/32 px and a level 1/60 of the contrast off.
        slack = 255 * (1 / 32 + 1 / 60 + 1 / 256) * 1.4
        assert abs(pictures[number, row, column] - np.clip(expected, 0, 255)) < slack


def test_without_motion_the_light_changes_evenly() -> None:
    first, second = np.random.default_rng(1).integers(0, 256, (2, 21, 33)).astype(np.uint8)
    for number, picture in enumerate(made(first, second, (0, 0), 3), 1):
        np.testing.assert_allclose(picture, first + (second * 1.0 - first) * number / 4, atol=0.6 / PARTS)


def test_whole_pixels_are_moved_as_they_are() -> None:
    whole = np.random.default_rng(2).integers(0, 256, (48, 56)).astype(np.uint8)
    pictures = made(whole[4:-4, 4:-4], whole[4:-4, :-8], (4 * UNITS_PER_PX, 0), 3)
    for ahead, picture in enumerate(pictures, 1):
        np.testing.assert_array_equal(picture[:, 8:-8], whole[4:-4, 12 - ahead : -12 - ahead])


def test_what_enters_the_picture_is_taken_from_the_frame_that_shows_it() -> None:
    whole = np.random.default_rng(3).integers(0, 256, (40, 64)).astype(np.uint8)
    first, second = whole[:, 16:], whole[:, 8:-8]
    pictures = made(first, second, (8 * UNITS_PER_PX, 0), 1)
    np.testing.assert_array_equal(pictures[0, :, :4], whole[:, 12:16])


def test_mirrored_pictures_are_the_others_turned_round() -> None:
    first, second = np.random.default_rng(4).integers(0, 256, (2, 22, 31)).astype(np.uint8)
    for vector in ((0, 0), (23, -9)):
        upright, mirrored = (made(first, second, vector, 2, mirrored=mirrored) for mirrored in (False, True))
        np.testing.assert_array_equal(mirrored, upright[:, :, ::-1])
