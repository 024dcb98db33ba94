"""Pictures: grey by the range tables, stored colour at the right pixels, red, green and blue of it, bands of rows."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace
from hypothesis import given
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError
from v2v_server.video.levels import add_colour, differences_of
from v2v_server.video.picture import (
    ChromaCut,
    ChromaStack,
    LumaFormat,
    Orientation,
    luma_plane,
    range_table,
    stated_matrix,
    stretch,
)
from v2v_server.video.rows import Rows

FORMATS = ("yuv420p", "yuvj420p", "yuv422p", "yuv444p", "yuv411p", "nv12", "nv21", "nv24", "yuv420p10le", "yuv444p12be")
ORIENTATIONS = [Orientation(*flags) for flags in product((False, True), repeat=3)]


def random_frame(name: str, height: int, width: int, seed: int) -> VideoFrame:
    frame = VideoFrame(width, height, name)
    generator = np.random.default_rng(seed)
    bits = frame.format.components[0].bits
    for plane in frame.planes:
        samples = np.frombuffer(memoryview(plane), np.uint8 if bits == 8 else f"{'>' if 'be' in name else '<'}u2")
        np.asarray(samples)[...] = generator.integers(0, 2**bits, samples.size)
    return frame


def full_size(frame: VideoFrame) -> npt.NDArray[np.int64]:
    """Cb and Cr of every stored pixel, [2, height, width], of a planar copy that FFmpeg makes."""
    name = frame.format.name.replace("nv12", "yuv420p").replace("nv21", "yuv420p").replace("nv24", "yuv444p")
    planar = frame if name == frame.format.name else frame.reformat(format=name)
    bits = planar.format.components[0].bits
    found = []
    for number in (1, 2):
        plane, component = planar.planes[number], planar.format.components[number]
        dtype = np.dtype(np.uint8 if bits == 8 else f"{'>' if 'be' in name else '<'}u2")
        samples = np.frombuffer(memoryview(plane), dtype).reshape(plane.height, -1)[:, : component.width]
        rows = np.arange(frame.height) // -(-frame.height // component.height)
        columns = np.arange(frame.width) // -(-frame.width // component.width)
        found.append(samples[np.ix_(rows, columns)])
    return np.array(found, np.int64)


@pytest.mark.parametrize(
    ("stated", "matrix", "weights"),
    [
        (Colorspace.SMPTE240M, "SMPTE 240M", (0.212, 0.087)),  # ITU-T H.273, table 4
        (Colorspace.ITU709, "BT.709", (0.2126, 0.0722)),
        (Colorspace.ITU601, "BT.601", (0.299, 0.114)),
    ],
)
def test_the_stated_matrix_is_used(stated: Colorspace, matrix: str, weights: tuple[float, float]) -> None:
    frame = VideoFrame(16, 16, "yuv420p")
    frame.colorspace = stated
    assert stated_matrix(frame) == matrix
    (red, blue), (kr, kb) = differences_of(matrix, 1.0)[[0, 3], 128 + 50], weights
    assert (red, blue) == (round(2 * (1 - kr) * 50), round(2 * (1 - kb) * 50))


@given(
    name=st.sampled_from(FORMATS), orientation=st.sampled_from(ORIENTATIONS), top=st.integers(0, 3),
    height=st.integers(8, 13), width=st.integers(8, 13), seed=st.integers(0, 99), data=st.data(),
)  # fmt: skip
def test_each_pixel_has_the_colour_of_its_cell(
    name: str, orientation: Orientation, top: int, height: int, width: int, seed: int, data: st.DataObject
) -> None:
    frame = random_frame(name, *orientation.size(height, width), seed)
    y, x = data.draw(st.integers(top, height - 2)), data.draw(st.integers(0, width - 2))
    window = (y, x, data.draw(st.integers(1, height - y)), data.draw(st.integers(1, width - x)))
    rows = height - top
    cut = ChromaCut((1, 3), window, (top, rows))
    stack = ChromaStack(cut, orientation, height, width)
    for ordinal in range(4):
        stack.add(random_frame(name, *orientation.size(height, width), 7) if ordinal == 3 else frame, ordinal)
    chroma = stack.chroma()
    assert chroma.matrix == "BT.601"
    luma = LumaFormat.of(frame)
    scale, stored = 2 ** (luma.bits - 8), full_size(frame)
    span = 2**luma.bits - 1 if luma.full_range else 224 * scale
    values = np.clip(np.floor((stored - 128 * scale) * 255 / span + 0.5), -128, 127)
    upright = orientation.upright(values)
    expected = upright[
        :,
        # Half as many rows of cells as usable rows, rounded up.
        np.minimum((window[0] + np.arange(window[2])) // 2, top // 2 + (rows + 1) // 2 - 1)[:, None] * 2,
        (window[1] + np.arange(window[3])) // 2 * 2,
    ]
    rows, columns = cut.places
    np.testing.assert_array_equal(chroma.cells[0][:, rows[:, None], columns], expected)
    assert cut.cells[2:] == (rows[-1] + 1, columns[-1] + 1) == chroma.cells.shape[2:]


def rgb_of(frame: VideoFrame) -> npt.NDArray[np.uint8]:
    height, width = frame.height, frame.width
    cut = ChromaCut((0,), (0, 0, height, width), (0, height))
    stack = ChromaStack(cut, Orientation(), height, width)
    stack.add(frame, 0)
    cells, matrix = stack.chroma()
    luma = LumaFormat.of(frame)
    grey = range_table(luma.bits, luma.full_range)[luma_plane(frame, luma)]
    out = np.empty((1, 3, height, width), np.uint8)
    chroma, places = cells.view(np.uint8) ^ 128, np.zeros(1, np.int64)
    add_colour(grey[None], chroma, places, *cut.places, differences_of(matrix, 1.0), out)
    return out[0]


@given(
    seed=st.integers(0, 2**32),
    contrast=st.floats(0.1, 3.0),
    matrix=st.sampled_from(["BT.601", "BT.709", "BT.2020"]),
    is_flipped=st.booleans(),
)
def test_colours_are_those_of_each_pixel_alone(seed: int, contrast: float, matrix: str, is_flipped: bool) -> None:
    """Against a slow oracle: sums of whole numbers beyond all bounds, clipped at the end."""
    random = np.random.default_rng(seed)
    count, height, width = (int(side) for side in random.integers(1, 9, 3))
    grey = random.integers(0, 256, (count, height, width), np.uint8)
    chroma = random.integers(0, 256, (2, 2, 5, 5), np.uint8)
    places, rows = random.integers(0, 2, count), np.sort(random.integers(0, 5, height))
    columns = np.sort(random.integers(0, 5, width))[:: -1 if is_flipped else 1].copy()
    table, out = differences_of(matrix, contrast), np.empty((count, 3, height, width), np.uint8)
    add_colour(grey, chroma, places, rows, columns, table, out)
    for t, y, x in np.ndindex(grey.shape):
        cb, cr = (int(value) for value in chroma[places[t], :, rows[y], columns[x]])
        red, of_cb, of_cr, blue = (int(table[row, value]) for row, value in enumerate((cr, cb, cr, cb)))
        expected = [min(max(int(grey[t, y, x]) + each, 0), 255) for each in (red, of_cb + of_cr, blue)]
        assert out[t, :, y, x].tolist() == expected


@pytest.mark.parametrize("colorspace", [Colorspace.ITU601, Colorspace.ITU709, Colorspace.BT2020])
@pytest.mark.parametrize("colour_range", [ColorRange.MPEG, ColorRange.JPEG])
@pytest.mark.parametrize("name", ["yuv420p", "yuv444p10le"])
def test_colours_come_back_by_the_stated_matrix_and_range(colorspace: Any, colour_range: Any, name: str) -> None:
    colours = np.random.default_rng(3).integers(0, 256, (8, 8, 3), np.uint8)
    picture = colours.repeat(16, 0).repeat(16, 1)
    frame = VideoFrame.from_ndarray(picture, format="rgb24").reformat(
        format=name, dst_colorspace=colorspace, dst_color_range=colour_range
    )
    frame.colorspace, frame.color_range = colorspace, colour_range
    got = rgb_of(frame).transpose(1, 2, 0)
    inner = (slice(8, None, 16), slice(8, None, 16))  # not at the borders of a patch
    assert np.abs(got[inner].astype(int) - colours).max() <= 4


def test_formats_without_planes_have_colour() -> None:
    colours = np.array([[250, 10, 20], [10, 240, 30], [15, 25, 230]], np.uint8)
    picture = np.ascontiguousarray(colours.repeat(8, 0)[:, None].repeat(8, 1))
    got = rgb_of(VideoFrame.from_ndarray(picture, format="rgb24"))
    assert np.abs(got[:, 2::8, 2].T.astype(int) - colours).max() <= 4


# --- grey -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("is_full", [False, True])
def test_a_range_table_is_the_rounded_line(bits: int, is_full: bool) -> None:
    scale = 2 ** (bits - 8)
    black, span = (0, 2**bits - 1) if is_full else (16 * scale, 219 * scale)
    for value, grey in enumerate(range_table(bits, is_full)):
        exact = Fraction((value - black) * 255, span)
        assert grey == min(255, max(0, int(exact + Fraction(1, 2)) if exact > 0 else 0))


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


# --- bands of rows ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "height", "bounds"),
    [
        ("full", 336, (0, 336)),
        ("top:0.54", 336, (0, 181)),
        ("top:1", 336, (0, 336)),
        ("top:180px", 336, (0, 180)),
        ("top:1px", 336, (0, 1)),
        ("0.1:0.6", 336, (33, 201)),
        (" 0:.5 ", 7, (0, 3)),
    ],
)
def test_bounds(text: str, height: int, bounds: tuple[int, int]) -> None:
    assert Rows.parse(text).bounds(height) == bounds


@pytest.mark.parametrize(
    "text",
    ["", "top", "top:", "top:0", "top:1.5", "top:0px", "top:-3px", "0.6:0.1", "0.2:0.2", "0:2", "nan:1", "bottom:1"],
)
def test_nonsense(text: str) -> None:
    with pytest.raises(UsageError, match="rows"):
        Rows.parse(text)


def test_pictures_that_are_too_small() -> None:
    with pytest.raises(UsageError, match="120 rows only"):
        Rows.parse("top:180px").bounds(120)
    with pytest.raises(UsageError, match="no row is left"):
        Rows.parse("0.1:0.2").bounds(3)


@given(st.floats(0, 1), st.floats(0, 1))
def test_text_round_trip(top: float, bottom: float) -> None:
    if top < bottom:
        rows = Rows(top, bottom)
        assert Rows.parse(str(rows)) == rows


@pytest.mark.parametrize("text", ["full", "top:0.54", "top:180px", "0.1:0.6"])
def test_canonical_text(text: str) -> None:
    assert str(Rows.parse(text)) == text
