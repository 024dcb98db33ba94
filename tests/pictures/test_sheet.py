"""Test pages and films of cameras: known content must be at its place, in its colour."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pictures

from tests.pictures.cameras import camera, has, record_texts, without_noise
from tests.protocol.test_sample import PARAMS, PROVENANCE
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import INK, MARK, PAGE_MARGIN_PX, PAUSED_INK, Canvas, beginning, shortened, text_width
from v2v_pictures.colours import BRIGHTER, DARKER, draw_events, draw_grey, full_colour
from v2v_pictures.files import gif_bytes, html_page, mp4_bytes, write_png
from v2v_pictures.film import draw_film
from v2v_pictures.sheet import (
    draw_overview,
    draw_sheet,
    draw_strip,
    flow_panel,
    overview_height,
    overview_width,
    whole_panel,
)
from v2v_protocol.errors import UsageError

WHITE = (255, 255, 255)


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.float32])
def test_colours_of_known_events(dtype: type[np.generic]) -> None:
    counts = np.zeros((12, 12), dtype)
    counts[:, :4], counts[:, 8:] = 4, -4
    image = draw_events(counts, 4.0)
    assert (image[:, :4] == BRIGHTER).all()
    assert (image[:, 4:8] == WHITE).all()
    assert (image[:, 8:] == DARKER).all()
    assert np.argmax(BRIGHTER) == 0
    assert np.argmax(DARKER) == 2


def test_a_single_event_is_visible_at_any_scale() -> None:
    image = draw_events(np.array([[1, 0, -1]], np.int8), 1000.0).astype(int)
    assert (image[0, 1] == WHITE).all()
    assert np.abs(image[0, 0] - WHITE).max() > 80
    assert np.abs(image[0, 2] - WHITE).max() > 80


def test_the_least_count_of_int8_does_not_wrap() -> None:
    """|-128| does not fit int8: its colour must not change to that of the other sign."""
    counts = np.full((12, 12), -128, np.int8)
    assert (draw_events(counts, full_colour([counts])) == DARKER).all()


@given(st.lists(st.integers(-128, 127), min_size=1, max_size=50))
def test_more_events_are_never_paler(values: list[int]) -> None:
    counts = np.sort(np.abs(np.array([values], np.int16)))
    green = draw_events(counts, full_colour([counts]))[0, :, 1].astype(int)
    assert (np.diff(green) <= 0).all()


def test_full_colour_ignores_outliers() -> None:
    counts = np.full(1000, 3, np.int8)
    counts[0] = 127
    assert full_colour([counts, np.zeros(5, np.int8)]) == 3.0
    assert full_colour([np.zeros(5, np.int8)]) == 1.0
    assert full_colour([]) == 1.0


def test_grey_is_shown_as_it_is() -> None:
    frame = np.array([[0, 255], [7, 200]], np.uint8)
    assert (draw_grey(frame)[..., 1] == frame).all()
    assert (draw_grey(frame / 255) == draw_grey(frame)).all()
    assert draw_grey(np.array([[-1.0, 2.0]])).tolist() == [[[0, 0, 0], [255, 255, 255]]]


def test_a_sheet_has_a_panel_for_each_bin_and_one_scale() -> None:
    voxels = np.zeros((10, 3, 32, 32), np.int8)
    voxels[5, 0], voxels[5, 2] = 4, -4
    sheet = draw_sheet([camera(voxels)], "title", tile_px=64)
    assert sheet.dtype == np.uint8
    assert has(sheet, BRIGHTER) >= 64 * 64
    assert has(sheet, DARKER) >= 64 * 64
    pale = voxels.copy()
    pale[5] = np.where(pale[5] > 0, 1, 0)
    both = draw_sheet([camera(voxels), camera(pale)], "title", tile_px=64)
    assert has(both, BRIGHTER) < 2 * 64 * 64  # the second camera's single events are paler: it has no scale of its own


def test_pauses_are_hatched_and_named() -> None:
    voxels = np.ones((10, 5, 16, 16), np.int8)
    assert has(draw_sheet([camera(voxels, pauses=((1, 20),))], "t"), PAUSED_INK) > has(
        draw_sheet([camera(voxels)], "t"), PAUSED_INK
    )


def test_a_full_bar_of_the_strip_is_the_rate_that_is_written_above_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full bar is half of the strip's height, from middle to edge. Higher rates are clipped, and the text says so."""
    voxels = np.zeros((40, 5, 10, 10), np.int8)
    voxels[:, :, :5] = 1  # half an event a pixel in each bin
    voxels[10, 0] = 1  # twice as many
    voxels[20, 0, :5] = 0
    voxels[20, 0, :, :2] = 1  # 0.2 instead of 0.5: a bar of the square root of 0.4
    written = record_texts(monkeypatch)
    page = Canvas(1100, 160)
    draw_strip(page, camera(voxels), 50, 40, 1000, 80, 0.5)
    assert "full bar: 0.5 or more a pixel and bin" in written
    image = page.image()
    bars = [has(image[40:121, 50 + 5 * number + 2][None], BRIGHTER) for number in (0, 50, 100)]
    assert bars == pytest.approx([40, 40, 25], abs=2)


@pytest.mark.parametrize("draw", [draw_sheet, lambda cameras, title: list(draw_film(cameras, title))])
def test_all_strips_of_a_page_have_one_scale(draw: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera with hardly any events must not look as active as one with motion."""
    busy, quiet = np.ones((4, 2, 16, 16), np.int8), np.zeros((4, 2, 16, 16), np.int8)
    quiet[:, :, 0, 0] = 1
    written = record_texts(monkeypatch)
    draw([camera(quiet), camera(busy)], "one scale")
    assert {text for text in written if text.startswith("full bar")} == {"full bar: 1 or more a pixel and bin"}


def test_bars_of_noise_are_pale() -> None:
    loud, quiet = np.ones((4, 2, 8, 8), np.int8), np.zeros((4, 2, 8, 8), np.int8)
    quiet[:2] = 1
    page = Canvas(500, 160)
    draw_strip(page, without_noise(camera(loud), quiet), 50, 40, 400, 80, 1.0)
    image = page.image()[60]
    assert tuple(image[60]) == BRIGHTER
    assert tuple(image[440]) not in (BRIGHTER, WHITE)
    assert image[440, 0] > image[440, 1]  # reddish


def test_the_whole_picture_has_a_box_around_the_crop() -> None:
    """A crop of 16 x 16 at (left 20, top 10) of a picture twice as large as the video's: a box of 8 x 8 at (10, 5)."""
    voxels = np.zeros((2, 2, 16, 16), np.int8)
    params = dataclasses.replace(PARAMS, scale=2.0, crop_left_px=20, crop_top_px=10)
    shown = dataclasses.replace(camera(voxels), provenance=dataclasses.replace(PROVENANCE, params=params))
    assert shown.crop == (10, 5, 18, 13)
    page = Canvas(200, 200)
    whole_panel(page, dataclasses.replace(shown, whole=np.full((30, 40), 99, np.uint8)), 0, 0, 160, 120)
    rows, columns = np.nonzero((page.image() == MARK).all(axis=-1))
    assert (columns.min(), rows.min(), columns.max(), rows.max()) == (40, 20, 71, 51)
    before = page.image()
    whole_panel(page, shown, 0, 0, 160, 120)
    assert np.array_equal(page.image(), before)


def test_the_overview_marks_the_cameras_of_its_clip_only() -> None:
    voxels = np.zeros((2, 2, 30, 40), np.int8)
    whole = dataclasses.replace(camera(voxels), title="all of it")
    params = dataclasses.replace(PARAMS, scale=1.0, crop_left_px=10, crop_top_px=5)
    seen = dataclasses.replace(PROVENANCE, params=params)
    looks = dataclasses.replace(camera(voxels[..., :16, :16]), provenance=seen, whole=np.zeros((30, 40), np.uint8))
    other = dataclasses.replace(looks, provenance=dataclasses.replace(seen, start_frame=seen.start_frame + 1))

    def marked(cameras: list[Camera]) -> tuple[int, int]:
        page = Canvas(overview_width(80), 300)
        draw_overview(page, whole, cameras, 10, 80, 1.0, 1.0)
        image = page.image()
        return has(image[:, :190], MARK), has(image[:, 200:370], MARK)

    nothing, _ = marked([other])
    assert nothing == 0
    frame, events = marked([looks])
    assert frame > events > 0  # the number stands in one of both
    sheet = draw_sheet([looks, other], "t", whole=whole)
    assert sheet.shape[0] - draw_sheet([looks, other], "t").shape[0] == overview_height(whole, 192)


def test_the_text_of_the_overview_ends_within_the_right_margin() -> None:
    page = Canvas(overview_width(80), 300)
    draw_overview(page, camera(np.zeros((2, 2, 30, 40), np.int8)), [], 10, 80, 1.0, 0.00012)
    assert (page.image()[:, -PAGE_MARGIN_PX // 2 :] == page.image()[0, 0]).all()


def test_cameras_with_one_box_share_its_label(monkeypatch: pytest.MonkeyPatch) -> None:
    voxels = np.zeros((2, 2, 30, 40), np.int8)
    seen = dataclasses.replace(PROVENANCE, params=dataclasses.replace(PARAMS, scale=1.0, crop_left_px=10))
    looks = dataclasses.replace(camera(voxels[..., :16, :16]), provenance=seen, whole=np.zeros((30, 40), np.uint8))
    written = record_texts(monkeypatch)
    draw_overview(Canvas(overview_width(80), 300), camera(voxels), [looks, looks], 10, 80, 1.0, 1.0)
    assert "1, 2" in written


def test_arrows_of_flow_point_where_pixels_move() -> None:
    """Flow is to the right in the upper half and zero below: only above are dark tips, right of the light rims."""
    flow = np.zeros((2, 32, 32), np.float32)
    flow[0, :16] = 3.0
    page = Canvas(128, 128)
    flow_panel(page, 0, 0, flow, 3.0, 128)
    dark = (page.image() == INK).all(axis=-1)
    assert dark[:64].any()
    assert not dark[64:].any()
    arrow = dark[:32, :32]  # one cell of four by four
    tall = [int(np.ptp(np.flatnonzero(column))) if column.any() else -1 for column in arrow.T]
    drawn = np.flatnonzero(np.array(tall) >= 0)
    assert tall.index(max(tall)) > drawn.mean()  # the head is at its right


@pytest.mark.parametrize(("height", "width"), [(16, 32), (32, 16)])
def test_arrows_of_flow_lie_in_the_picture(height: int, width: int) -> None:
    page = Canvas(148, 148)
    flow_panel(page, 10, 10, np.full((2, height, width), 1.0, np.float32), 3.0, 128)
    dark = (page.image() == INK).all(axis=-1)
    shown = np.zeros_like(dark)
    shown[74 - 2 * height : 74 + 2 * height, 74 - 2 * width : 74 + 2 * width] = True
    assert (dark & shown).any()
    assert not (dark & ~shown).any()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 300), (300, 1), (128, 128), (300, 200)])
def test_a_panel_keeps_the_shape_of_its_picture(height: int, width: int) -> None:
    page = Canvas(200, 200)
    page.panel(10, 10, np.full((height, width, 3), BRIGHTER, np.uint8), 168, 168)
    filled = (page.image() == BRIGHTER).all(axis=2)
    assert max(filled.any(axis=1).sum(), filled.any(axis=0).sum()) == 168
    assert filled.any(axis=1).sum() == max(1, round(height * 168 / max(height, width)))


def test_a_film_has_a_picture_for_each_bin() -> None:
    voxels = np.zeros((3, 2, 16, 16), np.int8)
    voxels[1, 1] = 1
    flow = np.ones((3, 2, 16, 16), np.float16)
    film = list(draw_film([camera(voxels, flow=flow), camera(voxels, flow=flow)], "t", tile_px=32))
    assert len(film) == 6
    assert len({picture.shape for picture in film}) == 1
    busiest = [has(picture, BRIGHTER) for picture in film]
    assert busiest.index(max(busiest)) == 3


def test_a_camera_of_mostly_noise_says_so_in_a_film_too(monkeypatch: pytest.MonkeyPatch) -> None:
    loud, quiet = np.ones((3, 2, 16, 16), np.int8), np.zeros((3, 2, 16, 16), np.int8)
    quiet[:, :, :4] = 1
    written = record_texts(monkeypatch)
    next(draw_film([without_noise(camera(loud), quiet)], "t"))
    assert "mostly noise: 75% of the events" in written


def test_a_film_begins_with_the_whole_picture() -> None:
    quiet = camera(np.zeros((3, 2, 16, 16), np.int8))
    voxels = np.zeros((3, 2, 30, 40), np.int8)
    voxels[2, 0] = 1
    film = list(draw_film([quiet], "t", tile_px=32, whole=camera(voxels)))
    assert len(film) == 6
    red = [has(picture, BRIGHTER) for picture in film]
    assert red.index(max(red)) == 4
    assert film[0].shape[0] > next(draw_film([quiet], "t", tile_px=32)).shape[0]


def test_nothing_at_all_is_drawn_without_a_warning() -> None:
    """Warnings are errors in all tests."""
    draw_sheet([camera(np.zeros((1, 1, 8, 8), np.float32), flow=np.zeros((1, 2, 8, 8), np.float16))], "t")


def test_files_read_back(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (31, 80, 3)).astype(np.uint8)[:, ::2]  # not contiguous
    write_png(tmp_path / "picture.png", image)
    assert np.array_equal(np.asarray(Pictures.open(tmp_path / "picture.png")), image)
    film = [np.full((31, 40, 3), value, np.uint8) for value in (0, 120, 250)]
    with av.open(io.BytesIO(mp4_bytes(film, 10.0))) as container:
        greys = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(video=0)]
    assert greys == pytest.approx([0, 120, 250], abs=3)
    assert Pictures.open(io.BytesIO(gif_bytes(film, 10.0))).n_frames == 3
    page = html_page("a <b> & c", image, film, 10.0)
    assert "a &lt;b&gt; &amp; c" in page
    assert "data:video/mp4;base64," in page
    with pytest.raises(UsageError, match=r"picture\.png: cannot be written: No such file or directory"):
        write_png(tmp_path / "nowhere" / "picture.png", image)


def test_a_gif_keeps_the_colours_that_mean_something() -> None:
    """Among many greys and hues of a photograph, paper stays white and red stays red."""
    page = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    page[:8], page[8], page[9] = WHITE, BRIGHTER, DARKER
    page[10] = (250, 250, 250)
    with Pictures.open(io.BytesIO(gif_bytes([page, page], 10.0))) as film:
        read = np.asarray(film.convert("RGB"))
    assert (read[:8] == WHITE).all()
    assert (read[8] == BRIGHTER).all()
    assert (read[9] == DARKER).all()


def test_a_long_name_keeps_its_end() -> None:
    name = "folder/" * 40 + "clip.mp4"
    short = shortened(name, 200)
    assert short.endswith("clip.mp4")
    assert text_width(short) <= 200
    assert shortened("clip.mp4", 200) == "clip.mp4"


def test_a_long_description_keeps_its_beginning() -> None:
    short = beginning("threshold +0.20 / -0.17   " + "shot noise 2.4 Hz   " * 20, 300)
    assert short.startswith("threshold +0.20")
    assert short.endswith("...")
    assert text_width(short) <= 300
    assert beginning("mirrored", 300) == "mirrored"


def test_the_strip_states_the_time_of_the_clip() -> None:
    made = camera(np.zeros((10, 3, 32, 32), np.int8))
    assert made.timing == dataclasses.replace(made, step_seconds=float("nan")).timing == ""
    grids, bins = made.voxels.shape[:2]
    for rate, shown in ((240, "240"), (30_000 / 1001, "30")):
        seconds = grids * made.steps_per_frame / rate
        timed = dataclasses.replace(made, step_seconds=1 / rate)
        assert timed.timing == f"{seconds:.2g} s, {shown} frames/s, {1e3 * seconds / (grids * bins):.2g} ms a bin"
