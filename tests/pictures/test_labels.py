"""Boxes and masks over panels lie where the labels say, and change nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.pictures.cameras import camera
from v2v_pictures.canvas import Canvas
from v2v_pictures.film import draw_film
from v2v_pictures.labels import class_colour, labelled_panel, tint
from v2v_pictures.sheet import draw_sheet


@pytest.mark.parametrize("with_text", [False, True])
@pytest.mark.parametrize("size", [(12, 16), (16, 12)])
def test_a_box_is_drawn_at_its_place(size: tuple[int, int], with_text: bool) -> None:
    clip = camera(np.ones((3, 2, *size), np.int8))
    grids, height, width = clip.frames.shape
    boxes = np.full((grids, 3, 7), -1.0, np.float32)
    boxes[1, 0] = (4, 2, 10, 8, 2, 0, 1)
    labelled = dataclasses.replace(clip, boxes=boxes)
    scale = 8
    tile_px = scale * max(height, width)
    image = np.full((height, width, 3), 255, np.uint8)
    drawn = {}
    for name, each, grid in (("plain", clip, 1), ("box", labelled, 1), ("none", labelled, 0)):
        page = Canvas(tile_px + 4, tile_px + 4)
        labelled_panel(page, each, grid, 2, 2, image, tile_px, with_text=with_text)
        drawn[name] = page.image()
    assert np.array_equal(drawn["plain"], drawn["none"])
    changed = (drawn["box"] != drawn["plain"]).any(axis=-1)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    left, top = 2 + (tile_px - width * scale) // 2, 2 + (tile_px - height * scale) // 2
    assert (columns[0], columns[-1]) == (left + 4 * scale, left + 10 * scale - 1)
    assert (rows[0], rows[-1]) == (top + 2 * scale, top + 8 * scale - 1)
    colours = np.unique(drawn["box"][changed], axis=0)
    assert list(class_colour(2)) in colours.tolist()
    assert with_text or len(colours) == 1


def test_a_mask_tints_its_classes_only() -> None:
    image = np.full((2, 3, 3), 200, np.uint8)
    mask = np.array([[0, 1, 255], [2, 0, 1]], np.uint8)
    tinted = tint(image, mask)
    assert np.array_equal((tinted != image).any(axis=-1), (mask == 1) | (mask == 2))
    assert np.array_equal(tinted[0, 1], tinted[1, 2])
    assert (tinted[0, 1] != tinted[1, 0]).any()


def test_pages_and_films_show_labels() -> None:
    clip = camera(np.ones((3, 2, 12, 16), np.int8))
    boxes = np.tile(np.array([2, 2, 9, 9, 1, -1, 1], np.float32), (len(clip.frames), 1, 1))
    masks = np.zeros(clip.frames.shape, np.uint8)
    masks[:, 3:6, 3:6] = 4
    for labels in ({"boxes": boxes}, {"masks": masks}):
        labelled = dataclasses.replace(clip, **labels)
        for draw in (draw_sheet, lambda cameras, title: next(draw_film(cameras, title))):
            plain, shown = draw([clip], "a"), draw([labelled], "a")
            assert plain.shape == shown.shape
            assert (plain != shown).any()


def test_tracks_are_drawn_where_they_are_seen() -> None:
    clip = camera(np.ones((3, 2, 12, 16), np.int8))
    tracks = np.zeros((len(clip.frames), 2, 3), np.float32)
    tracks[:, 0] = [(4 + 2 * at, 6, at != 2) for at in range(len(clip.frames))]
    followed = dataclasses.replace(clip, tracks=tracks)
    image, drawn = np.full((12, 16, 3), 255, np.uint8), []
    for each, grid, with_text in ((clip, 0, True), (followed, 0, True), (followed, 2, True), (followed, 0, False)):
        page = Canvas(164, 164)
        labelled_panel(page, each, grid, 2, 2, image, 160, with_text=with_text)
        drawn.append(page.image())
    plain, seen, hidden, events = drawn
    rows, columns = np.nonzero((seen != plain).any(axis=-1))
    assert (round(rows.mean() - 0.5) - 22, round(columns.mean() - 0.5) - 2) == (59, 39), "a dot around its place"
    assert np.array_equal(hidden, plain)
    assert np.array_equal(events, plain)
