"""Drawing a label and then viewing the picture equals viewing the picture and then drawing the transformed label."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.labels import LEAST_SHARE, LEAST_SIDE_PX, kept_boxes, read_mask, view_boxes, view_mask
from v2v_server.simulation.draw import draw
from v2v_server.simulation.view import Window, apply_view, source_window

HEIGHT_PX, WIDTH_PX = 60, 83


@st.composite
def views(draws: st.DrawFn) -> tuple[Recipe, SampleParams, Window]:
    """Any view that a recipe can draw of a picture, of which some rows are left out."""
    top, bottom = draws(st.integers(0, 9)), draws(st.integers(0, 9))
    low = draws(st.floats(0.4, 2.0))
    recipe = Recipe(
        crop_height_px=draws(st.integers(8, 24)),
        crop_width_px=draws(st.integers(8, 32)),
        resize_scale=draws(st.sampled_from([(1.0, 1.0), (low, low + 0.5)])),
        contrast_probability=0.0,
    )
    usable = Window(top, 0, HEIGHT_PX - top - bottom, WIDTH_PX)
    params = draw(
        recipe, seed=draws(st.integers(0, 2**32)), epoch=0, index=0, picture_height_px=usable.height_px,
        picture_width_px=usable.width_px, video_id="a",
    )  # fmt: skip
    return recipe, params, usable


@st.composite
def rectangles(draws: st.DrawFn) -> tuple[int, int, int, int]:
    """Corners of whole pixels, at least 8 px apart: no resize makes the rectangle smaller than 3 px."""
    x0, y0 = draws(st.integers(0, WIDTH_PX - 8)), draws(st.integers(0, HEIGHT_PX - 8))
    return x0, y0, draws(st.integers(x0 + 8, WIDTH_PX)), draws(st.integers(y0 + 8, HEIGHT_PX))


def drawn(box: tuple[int, int, int, int], value: int) -> npt.NDArray[np.uint8]:
    picture = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    picture[box[1] : box[3], box[0] : box[2]] = value
    return picture


def viewed(picture: npt.NDArray[np.uint8], recipe: Recipe, params: SampleParams, usable: Window) -> Any:
    window = source_window(params, recipe, usable)
    rows = slice(window.top_px, window.top_px + window.height_px)
    return apply_view(picture[None, rows, window.left_px : window.left_px + window.width_px], params, recipe)[0]


def bounds(there: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1


@settings(max_examples=300)
@given(view=views(), box=rectangles())
def test_boxes_agree_to_half_a_pixel_and_masks_to_the_pixel(
    view: tuple[Recipe, SampleParams, Window], box: tuple[int, int, int, int]
) -> None:
    recipe, params, usable = view
    picture = viewed(drawn(box, 255), recipe, params, usable)
    mask = view_mask(drawn(box, 3), usable, params, recipe)
    # More than 3/4 covered: the centre is inside; less than 1/4: it is outside, also at a corner.
    assert np.all(mask[picture > 0.76 * 255] == 3)
    assert np.all(mask[picture < 0.24 * 255] == 0)
    (corners,), (share,) = view_boxes(np.array([box], float), usable, params, recipe)
    sides = corners[2:] - corners[:2]
    if min(sides) >= 1.5:
        np.testing.assert_allclose(bounds(mask == 3), corners, atol=0.5)
        # Half of the darkest inner row and column: a narrow strip at the border is darker than the middle.
        lit = (picture >= 0.5 * picture.max(axis=1, keepdims=True)) & (picture >= 0.5 * picture.max(axis=0))
        np.testing.assert_allclose(bounds(lit & (picture > 64)), corners, atol=0.51)
    if share == 0:
        assert min(sides) <= 0
    else:
        assert 0 < share <= 1


@given(view=views(), seed=st.integers(0, 99))
def test_a_mask_without_a_resize_is_the_pictures_own_view(view: tuple[Recipe, SampleParams, Window], seed: int) -> None:
    recipe, params, usable = view
    mask = np.random.default_rng(seed).integers(0, 256, (HEIGHT_PX, WIDTH_PX), np.uint8)
    got = view_mask(mask, usable, params, recipe)
    assert got.shape == recipe.crop_px
    if params.scale == 1.0:
        np.testing.assert_array_equal(got, viewed(mask, recipe, params, usable))


def test_the_share_counts_what_lies_in_the_crop() -> None:
    recipe = Recipe(crop_height_px=10, crop_width_px=10)
    params = SampleParams(0.2, 0.2, 0.0, 0, 0.0, (), 1.0, 20, 30, True, 0.0, (0, 0, 0, 0))
    boxes = np.array([[25.0, 20, 35, 30], [0, 0, 5, 5], [31, 21, 31, 25], [28, 18, 42, 32]])
    corners, share = view_boxes(boxes, Window(0, 0, 60, 80), params, recipe)
    assert corners[0].tolist() == [5.0, 0.0, 10.0, 10.0]
    np.testing.assert_allclose(share, [0.5, 0.0, 0.0, 100 / 196])
    assert kept_boxes(corners, share).tolist() == [3, 0], "the largest first; the empty ones are left out"
    thin = np.array([[0.0, 0, LEAST_SIDE_PX, 9], [0, 0, LEAST_SIDE_PX - 0.01, 9], [0, 0, 9, 9]])
    assert kept_boxes(thin, np.array([LEAST_SHARE, 1.0, LEAST_SHARE - 0.01])).tolist() == [0]


def png(path: Path, picture: Image.Image) -> Path:
    picture.save(path)
    return path


def test_classes_are_grey_levels_or_palette_indices(tmp_path: Path) -> None:
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4)
    grey = Image.fromarray(classes)
    palette = Image.fromarray(classes, "P")
    palette.putpalette([number % 256 for number in range(768)])
    for name, picture in (("grey", grey), ("palette", palette)):
        np.testing.assert_array_equal(read_mask(png(tmp_path / f"{name}.png", picture), (3, 4)), classes)
    few = png(tmp_path / "few.png", Image.fromarray(classes % 2 == 1))
    np.testing.assert_array_equal(read_mask(few, (3, 4)), classes % 2)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (Image.new("RGB", (4, 3)), "is neither 8-bit grey nor a palette"),
        (Image.new("I;16", (4, 3)), "is neither 8-bit grey nor a palette"),
        (Image.new("L", (3, 4)), "has 3x4 px: the video has 4x3 px"),
        (None, "cannot identify"),
    ],
)
def test_other_pictures_are_refused(tmp_path: Path, picture: Image.Image | None, message: str) -> None:
    path = tmp_path / "12.png"
    if picture is None:
        path.write_bytes(b"no picture")
    else:
        png(path, picture)
    with pytest.raises(ValueError, match=rf"^12\.png {message}"):
        read_mask(path, (3, 4))


def test_a_truncated_picture_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 9, (64, 64), np.uint8)).save(stream, "PNG")
    (tmp_path / "3.png").write_bytes(stream.getvalue()[:-200])
    with pytest.raises(ValueError, match=r"^3\.png .*truncated"):
        read_mask(tmp_path / "3.png", (64, 64))
