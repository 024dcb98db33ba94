"""The view: window and picture agree, and each stage does what it says."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from tests.clips import panned_luma
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import draw, resized_size
from v2v_server.simulation.view import Window, apply_view, contrast_table, source_window

RECIPE = Recipe(crop_height_px=24, crop_width_px=32)
PICTURE = panned_luma(3, 60, 80)


def params(scale: float = 1.0, top: int = 0, left: int = 0, flip: bool = False, contrast: float = 0.0) -> SampleParams:
    return SampleParams(0.2, 0.2, 0.0, 0, 0.0, (), scale, top, left, flip, contrast, (0, 0, 0, 0))


def seen(view: SampleParams, picture_top_px: int = 0) -> np.ndarray:
    window = source_window(view, RECIPE, Window(picture_top_px, 0, 60 - picture_top_px, 80))
    bottom, right = window.top_px + window.height_px, window.left_px + window.width_px
    return apply_view(PICTURE[:, window.top_px : bottom, window.left_px : right], view, RECIPE)


def test_scale_one_decodes_the_crop_alone() -> None:
    view = params(top=5, left=7)
    assert source_window(view, RECIPE, Window(10, 0, 50, 80)) == Window(15, 7, 24, 32)
    np.testing.assert_array_equal(seen(view, 10), PICTURE[:, 15:39, 7:39])


def test_other_scales_decode_the_whole_usable_picture() -> None:
    assert source_window(params(scale=1.5), RECIPE, Window(10, 0, 50, 80)) == Window(10, 0, 50, 80)


@pytest.mark.parametrize(("scale", "method"), [(0.5, cv2.INTER_AREA), (1.3, cv2.INTER_LINEAR)])
def test_the_whole_picture_is_resized_before_the_crop(scale: Any, method: Any) -> None:
    height, width = resized_size(60, 80, scale)
    got = seen(params(scale=scale, top=height - 24, left=width - 32))
    for frame, source in zip(got, PICTURE, strict=True):
        np.testing.assert_array_equal(frame, cv2.resize(source, (width, height), interpolation=method)[-24:, -32:])


@pytest.mark.parametrize("scale", [1.0, 0.7, 1.2])
def test_flip_mirrors_left_and_right(scale: Any) -> None:
    np.testing.assert_array_equal(seen(params(scale=scale, flip=True)), seen(params(scale=scale))[:, :, ::-1])


def test_result_is_contiguous_and_a_copy_of_the_right_size() -> None:
    for view in (params(), params(flip=True), params(scale=0.8), params(contrast=2.0)):
        got = seen(view)
        assert got.shape == (3, 24, 32)
        assert got.dtype == np.uint8
        assert got.flags.c_contiguous


def test_contrast_is_the_stated_formula_rounded_half_up() -> None:
    level = np.arange(256)
    np.testing.assert_array_equal(contrast_table(1.0), level)
    np.testing.assert_array_equal(contrast_table(2.0), np.clip(np.floor((level - 127.5) * 2 + 128), 0, 255))
    assert set(contrast_table(2.0**-60)) == {127, 128} or set(contrast_table(2.0**-60)) == {128}
    np.testing.assert_array_equal(seen(params(contrast=3.0)), contrast_table(3.0)[seen(params())])


def test_every_drawn_view_fits_its_own_window() -> None:
    recipe = RECIPE.replace(resize_scale=(0.3, 2.0))
    for index in range(60):
        view = draw(
            recipe, seed=0, epoch=0, index=index, picture_height_px=45, picture_width_px=80, video_id="v"
        )  # fmt: skip
        window = source_window(view, recipe, Window(10, 0, 45, 80))
        bottom, right = window.top_px + window.height_px, window.left_px + window.width_px
        assert apply_view(PICTURE[:, window.top_px : bottom, window.left_px : right], view, recipe).shape == (3, 24, 32)


@pytest.mark.parametrize(("shape", "view"), [((3, 23, 32), params()), ((3, 60, 80), params(scale=0.5, top=7))])
def test_frames_that_do_not_hold_the_crop_are_refused(shape: Any, view: Any) -> None:
    with pytest.raises(UsageError, match="32x24"):
        apply_view(np.zeros(shape, np.uint8), view, RECIPE)


def test_other_types_are_refused() -> None:
    with pytest.raises(UsageError, match="uint8"):
        apply_view(np.zeros((3, 24, 32)), params(), RECIPE)  # type: ignore[arg-type]
