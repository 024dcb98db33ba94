"""Test colours of events and flow, sizes, and files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from trainer.pictures import (
    PANEL_GAP_PX,
    Video,
    add_header,
    contact_sheet,
    draw_events,
    draw_flow,
    flow_scale,
    side_by_side,
    write_png,
)
from v2v_pictures.colours import BRIGHTER, DARKER
from v2v_protocol.errors import UsageError


def test_events_are_red_blue_and_white() -> None:
    voxels = np.zeros((1, 3, 2, 3), np.float32)
    voxels[0, :, 0, 0] = 3
    voxels[0, :, 1, 2] = -3
    voxels[0, :, 1, 1] = (0.3, 0.4, -0.7)  # cancels but for rounding
    assert voxels[0, :, 1, 1].sum() != 0
    drawn = draw_events(voxels)
    assert drawn.shape == (1, 2, 3, 3)
    assert tuple(drawn[0, 0, 0]) == BRIGHTER
    assert tuple(drawn[0, 1, 2]) == DARKER
    assert (drawn[0, 0, 1:] == 255).all()
    assert (drawn[0, 1, :2] == 255).all()
    assert (draw_events(np.zeros((1, 2, 2, 3), np.int8)) == 255).all()


def test_flow_is_white_at_rest_and_red_to_the_right() -> None:
    flow = np.zeros((2, 1, 3))
    flow[:, 0, 1], flow[:, 0, 2] = (4, 0), (40, 0)
    drawn = draw_flow(flow, scale=4)
    assert drawn[0].tolist() == [[255, 255, 255], [255, 0, 0], [191, 0, 0]]
    assert (draw_flow(np.stack([flow, flow]), scale=4) == drawn).all()
    assert flow_scale(flow) > 4
    assert flow_scale(np.zeros((2, 3, 3))) > 0


def test_a_film_is_large_enough_to_see() -> None:
    steps, height, width = 7, 20, 30
    film = side_by_side([np.zeros((steps, height, width, 3), np.uint8)] * 3)
    factor = 7  # 7 x 20 px is the first multiple that is not below 128 px
    assert film.shape == (steps, factor * height + PANEL_GAP_PX, 3 * (factor * width + PANEL_GAP_PX), 3)
    assert contact_sheet(film, steps=3).shape == (3 * film.shape[1], film.shape[2], 3)
    assert contact_sheet(film[:2], steps=5).shape[0] == 2 * film.shape[1]


def test_a_header_keeps_the_pixels_and_names_the_columns() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (60, 390, 3)).astype(np.uint8)
    page = add_header(picture, ("events", "target", "reconstruction"), "step 7", time_runs_down=True)
    assert np.array_equal(page[-60:, -390:], picture)
    names = page[:-60, -390:]
    columns = np.split(names, 3, axis=1)
    assert all((column < 100).all(axis=-1).any() for column in columns)
    assert (columns[0] == BRIGHTER).all(axis=-1).any()
    assert (columns[0] == DARKER).all(axis=-1).any()
    assert not any((column == BRIGHTER).all(axis=-1).any() for column in columns[1:])
    assert add_header(picture, ()) is picture


def test_a_picture_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file"):
        write_png(tmp_path / "file" / "a.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(UsageError, match="file"), Video(tmp_path / "file" / "a.mp4", 25.0) as video:
        video.add(np.zeros((16, 16, 3), np.uint8))


@pytest.mark.parametrize("fps", [1.0, 65.5354, 149.993, 1000.123])
def test_a_video_of_any_rate_is_written(tmp_path: Path, fps: float) -> None:
    """EVAID has 150 pictures per second, and time stamps in microseconds make the rate fractional."""
    with Video(tmp_path / "a.mp4", fps) as video:
        video.add(np.zeros((17, 24, 3), np.uint8))
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-2)
