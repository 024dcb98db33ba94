"""Pictures of samples: shapes, and the colours of events that are known."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.protocol.test_sample import PARAMS, PROVENANCE
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Sample
from v2v_server.offline.picture import _NEGATIVE, _POSITIVE, Row, draw_rows, draw_sample, write_png
from v2v_server.offline.remake import simulate_to_file

TILE, GAP, LABEL = 168, 6, 250
WHITE = (255, 255, 255)


def row(bins: npt.NDArray[Any], frame: npt.NDArray[np.uint8] | None = None) -> Row:
    shape = bins.shape[1:]
    return Row(np.full(shape, 90, np.uint8) if frame is None else frame, bins, PROVENANCE, "voxel 3")


def tile(image: npt.NDArray[np.uint8], column: int) -> npt.NDArray[np.uint8]:
    """Column 0 is the frame, the bins follow."""
    left = LABEL + GAP + column * (TILE + GAP)
    return image[:TILE, left : left + TILE]


def sample(voxels: npt.NDArray[Any], frames: npt.NDArray[np.uint8]) -> Sample:
    return Sample({"voxels": voxels, "frames": frames}, PROVENANCE)


def test_one_row_for_each_voxel_one_tile_for_each_bin() -> None:
    bins = np.zeros((3, 12, 12), np.int8)
    image = draw_rows([row(bins), row(bins)])
    assert image.dtype == np.uint8
    assert image.shape == (2 * (TILE + GAP), LABEL + GAP + 4 * (TILE + GAP), 3)


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.float32])
def test_colours_of_known_events(dtype: type[np.generic]) -> None:
    bins = np.zeros((2, 12, 12), dtype)
    bins[0, :, :6] = 4
    bins[0, :, 6:] = -4
    image = draw_rows([row(bins)])
    first, second = tile(image, 1), tile(image, 2)
    assert (first[:, : TILE // 2] == _POSITIVE).all()
    assert (first[:, TILE // 2 :] == _NEGATIVE).all()
    assert (second == WHITE).all()
    # Positive is red, negative is blue, in OpenCV's order of channels.
    assert np.argmax(_POSITIVE) == 2
    assert np.argmax(_NEGATIVE) == 0


def test_fewer_events_are_paler_and_more_are_no_darker_than_full() -> None:
    bins = np.full((1, 12, 12), 4, np.int16)
    bins[0, 0:3] = 1
    bins[0, 3] = 32_000
    shown = tile(draw_rows([row(bins)]), 1)
    pale, strongest, full = shown[3], shown[3 * 14 + 3], shown[-3]
    assert (pale[0] > full[0]).any()
    assert (pale[0] <= WHITE).all()
    assert (pale[0] != WHITE).any()
    assert strongest[0].tolist() == list(_POSITIVE)


def test_the_least_count_of_int8_does_not_wrap() -> None:
    """|-128| is no int8: its colour must not turn."""
    bins = np.full((1, 12, 12), -128, np.int8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shown = tile(draw_rows([row(bins)]), 1)
    assert (shown == _NEGATIVE).all()


def test_a_voxel_without_events_is_white_and_divides_nothing_by_zero() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = draw_rows([row(np.zeros((5, 12, 12), np.float32))])
    assert all((tile(image, column) == WHITE).all() for column in range(1, 6))


def test_the_frame_is_shown_as_it_is() -> None:
    frame = np.zeros((12, 12), np.uint8)
    frame[:, 6:] = 200
    shown = tile(draw_rows([row(np.zeros((1, 12, 12), np.int8), frame)]), 0)
    assert (shown[:, : TILE // 2] == 0).all()
    assert (shown[:, TILE // 2 :] == 200).all()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 400), (400, 1), (128, 128), (169, 700), (300, 200)])
def test_any_picture_fits_its_tile_with_its_shape_kept(height: int, width: int) -> None:
    bins = np.ones((1, height, width), np.int8)
    image = draw_rows([row(bins)])
    assert image.shape == (TILE + GAP, LABEL + GAP + 2 * (TILE + GAP), 3)
    filled = (tile(image, 1) == _POSITIVE).all(axis=2)
    shown_height, shown_width = filled.any(axis=1).sum(), filled.any(axis=0).sum()
    assert max(shown_height, shown_width) == TILE
    assert shown_height == max(1, round(height * TILE / max(height, width)))
    assert shown_width == max(1, round(width * TILE / max(height, width)))


def test_a_sample_is_shown_at_evenly_spaced_voxels_with_the_frames_that_close_them() -> None:
    """Voxel t holds t + 1 events everywhere, its frame has the grey value 10 (t + 1); one lead frame and one lead
    voxel stand in front."""
    voxels = np.arange(5, dtype=np.int8)[:, None, None, None] * np.ones((1, 2, 12, 12), np.int8)
    frames = (10 * np.arange(5, dtype=np.uint8))[:, None, None, None] * np.ones((1, 1, 12, 12), np.uint8)
    image = draw_sample(sample(voxels, frames), rows=3)
    assert image.shape[0] == 3 * (TILE + GAP)
    greys = [int(tile(image[number * (TILE + GAP) :], 0)[5, 5, 0]) for number in range(3)]
    assert greys == [0, 20, 40]
    # With a lead frame only, or a lead voxel only, the last entries still belong together.
    assert int(tile(draw_sample(sample(voxels[1:], frames), rows=1), 0)[5, 5, 0]) == 10
    assert int(tile(draw_sample(sample(voxels, frames[1:]), rows=1), 0)[5, 5, 0]) == 10


def test_more_rows_than_voxels_shows_each_once() -> None:
    image = draw_sample(sample(np.zeros((2, 5, 8, 8), np.int8), np.zeros((2, 1, 8, 8), np.uint8)), rows=6)
    assert image.shape[0] == 2 * (TILE + GAP)


@pytest.mark.parametrize("name", ["voxels", "frames"])
def test_both_arrays_are_needed(name: str) -> None:
    with pytest.raises(UsageError, match="--arrays voxels,frames"):
        draw_sample(Sample({name: np.zeros((2, 1, 8, 8), np.uint8)}, PROVENANCE))


def test_the_label_shows_the_thresholds_as_bars() -> None:
    label = draw_rows([row(np.zeros((1, 8, 8), np.int8))])[:TILE, :LABEL]
    for colour, y, threshold in ((_POSITIVE, 107, PARAMS.threshold_pos), (_NEGATIVE, 133, PARAMS.threshold_neg)):
        bar = (label[y, 93:212] == colour).all(axis=1).sum()
        assert bar == pytest.approx(120 * threshold / 3.0, abs=2)


def test_png_reads_back(tmp_path: Path) -> None:
    image = draw_rows([row(np.random.default_rng(0).integers(-3, 4, (2, 12, 12)).astype(np.int8))])
    write_png(tmp_path / "picture.png", image)
    assert np.array_equal(np.asarray(cv2.imread(str(tmp_path / "picture.png"))), image)
    with pytest.raises(UsageError, match=r"picture\.png: No such file or directory"):
        write_png(tmp_path / "nowhere" / "picture.png", image)


def test_what_cannot_be_drawn_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a picture needs both arrays"):
        simulate_to_file(
            str(tmp_path / "absent"), out=tmp_path / "a.npz", picture=tmp_path / "a.png", list_file=None, rows="full",
            spec={}, arrays=("voxels",), seed=0, epoch=0, index=0,
        )  # fmt: skip
