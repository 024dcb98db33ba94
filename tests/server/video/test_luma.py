"""The range tables against their definition."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace

from v2v_server.video.picture import LumaFormat, luma_plane, range_table, stretch


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_limited_range_table_is_the_rounded_line(bits: int) -> None:
    scale = 2 ** (bits - 8)
    for value, grey in enumerate(range_table(bits, False)):
        exact = Fraction((value - 16 * scale) * 255, 219 * scale)
        assert grey == min(255, max(0, int(exact + Fraction(1, 2)) if exact > 0 else 0))


def test_full_range_tables() -> None:
    np.testing.assert_array_equal(range_table(8, True), np.arange(256))
    ten = range_table(10, True)
    assert (ten[0], ten[1023]) == (0, 255)
    assert np.all(np.diff(ten.astype(int)) >= 0)


def test_limited_range_equals_swscale_for_every_value() -> None:
    luma = np.repeat(np.arange(256, dtype=np.uint8)[None], 16, axis=0)
    frame = VideoFrame.from_ndarray(np.concatenate([luma, np.full((8, 256), 128, np.uint8)]), format="yuv420p")
    frame.color_range = ColorRange.MPEG
    grey = frame.reformat(format="gray").to_ndarray()
    np.testing.assert_array_equal(range_table(8, False)[luma], grey)


def test_the_colours_beside_it_and_the_matrix_that_a_file_states_change_nothing() -> None:
    """They would in a conversion by way of red, green and blue."""
    luma = np.tile(np.arange(16, 236, dtype=np.uint8), (16, 1))
    chroma = [np.full((4, 220), value, np.uint8) for value in (90, 200)]
    frame = VideoFrame.from_ndarray(np.concatenate([luma, *chroma]), format="yuv420p")
    frame.color_range, frame.colorspace = ColorRange.MPEG, Colorspace.ITU709
    np.testing.assert_array_equal(luma_plane(frame, LumaFormat.of(frame)), luma)
    assert np.any(frame.reformat(format="gray").to_ndarray() != range_table(8, False)[luma])


def test_stretching_is_the_table_for_every_value_in_every_layout() -> None:
    luma = np.arange(256, dtype=np.uint8)
    whole = np.stack([np.roll(luma, shift) for shift in range(256)]).reshape(4, 64, 256)  # every value at every column
    limited = LumaFormat("yuv420p", int(ColorRange.MPEG), 8, full_range=False, has_plane=True)
    for part in (np.s_[:], np.s_[1:3], np.s_[:, 5:60], np.s_[:, :, 3:200], np.s_[::2, ::3, 7:8], np.s_[:0]):
        frames = whole.copy()
        stretch(frames[part], limited)
        expected = whole.copy()
        expected[part] = range_table(8, False)[whole[part]]
        np.testing.assert_array_equal(frames, expected)


@pytest.mark.parametrize(("bits", "full_range"), [(8, True), (10, False), (10, True)])
def test_what_is_grey_already_is_not_stretched(bits: int, full_range: bool) -> None:
    frames = np.arange(256, dtype=np.uint8).reshape(1, 16, 16)
    stretch(frames, LumaFormat("any", 0, bits, full_range, has_plane=True))
    np.testing.assert_array_equal(frames.ravel(), np.arange(256))


@pytest.mark.parametrize(
    ("pixel_format", "stated", "full"),
    [
        ("yuv420p", ColorRange.UNSPECIFIED, False),
        ("yuv420p", ColorRange.JPEG, True),
        ("yuv420p", ColorRange.MPEG, False),
        ("yuvj420p", ColorRange.UNSPECIFIED, True),
        ("gray", ColorRange.UNSPECIFIED, True),
        ("gray", ColorRange.MPEG, False),
        ("yuv420p10le", ColorRange.UNSPECIFIED, False),
    ],
)
def test_range_rule(pixel_format: str, stated: ColorRange, full: bool) -> None:
    frame = VideoFrame(16, 16, pixel_format)
    frame.color_range = stated
    assert LumaFormat.of(frame).full_range == full


@pytest.mark.parametrize("pixel_format", ["rgb24", "pal8", "gbrp", "yuyv422", "ya8"])
def test_formats_without_a_luma_plane(pixel_format: str) -> None:
    assert not LumaFormat.of(VideoFrame(16, 16, pixel_format)).has_plane
