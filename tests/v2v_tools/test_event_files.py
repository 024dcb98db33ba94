"""Other programs read from files of events what was written; `v2v-simulate --events` writes the sample's."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_recordings.limits import FORM_LIMITS
from v2v_recordings.writers import ENDINGS, EVENT_FORMS, write_events
from v2v_server.simulation import simulate
from v2v_server.simulation.kernels import Voxels
from v2v_tools import simulate as command

BIN_US = 7000.0


@cache
def simulated() -> Voxels:
    return simulate(np.random.default_rng(1).integers(0, 256, (16, 12, 16), np.uint8), threshold_pos=1.0)


@cache
def some_events() -> EventList:
    return simulated().to_events(BIN_US)


def read(path: Path) -> EventList:
    """By the readers of others."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            assert "linear in time" in str(file["note"])
            return EventList(file["x"], file["y"], file["t"], file["p"], int(file["width"]), int(file["height"]))
    if path.suffix in (".h5", ".hdf5"):
        with h5py.File(path) as file:
            assert "linear in time" in file.attrs["note"]
            x, y, t, p = (file[f"events/{name}"][:] for name in "xytp")
            return EventList(x, y, t + file["t_offset"][()], p > 0, int(file.attrs["width"]), int(file.attrs["height"]))
    import faery  # as every process of a run of all tests imports this module

    stream = faery.events_stream_from_file(path)
    table = stream.to_array()
    return EventList(table["x"], table["y"], table["t"].astype(np.int64), table["on"], *stream.dimensions())


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_read_is_what_was_written(ending: str, tmp_path: Path) -> None:
    path, events = tmp_path / f"events{ending}", some_events()
    write_events(path, events)
    back = read(path)
    for column in "xytp":
        np.testing.assert_array_equal(getattr(back, column), getattr(events, column))
    assert (back.width_px, back.height_px) == (16, 12)
    np.testing.assert_array_equal(back.voxels(3, 5, BIN_US, "int8"), simulated().voxels)


def test_the_index_of_milliseconds_is_that_of_dsec(tmp_path: Path) -> None:
    write_events(tmp_path / "e.h5", some_events())
    with h5py.File(tmp_path / "e.h5") as file:
        t, first = file["events/t"][:], file["ms_to_idx"][:]
    assert len(first) == t[-1] // 1000 + 2
    for ms, index in enumerate(first):
        assert index == len(t) or t[index] >= ms * 1000
        assert index == 0 or t[index - 1] < ms * 1000


@pytest.mark.parametrize("ending", ENDINGS)
def test_no_events_make_a_file_too(ending: str, tmp_path: Path) -> None:
    none = simulate(np.zeros((6, 4, 4), np.uint8), threshold_pos=1.0, start_residual=0.0).to_events(100)
    write_events(tmp_path / f"none{ending}", none)
    assert (tmp_path / f"none{ending}").stat().st_size > 0


def listed(width_px: int, height_px: int, *t_us: int) -> EventList:
    """Return events at the lower right."""
    places = (np.full(len(t_us), side_px - 1, np.uint16) for side_px in (width_px, height_px))
    return EventList(*places, np.array(t_us, np.int64), np.ones(len(t_us), bool), width_px, height_px)


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_largest_picture_is_written_and_larger_ones_are_refused(ending: str, tmp_path: Path) -> None:
    side = FORM_LIMITS[EVENT_FORMS[ENDINGS[ending]].limit].side_px
    path = tmp_path / f"events{ending}"
    for size in ((side, 2), (2, side)):
        events = listed(*size, 5, 9)
        write_events(path, events)
        back = read(path)
        assert (back.width_px, back.height_px, back.t.tolist()) == (*size, [5, 9])
        assert (back.x.tolist(), back.y.tolist()) == (events.x.tolist(), events.y.tolist())
    path.unlink()
    for size in ((side + 1, 2), (2, side + 1)):
        events = dataclasses.replace(listed(2, 2, 5), width_px=size[0], height_px=size[1])
        with pytest.raises(UsageError, match=rf"{size[0]} x {size[1]} px; .* at most {side} px a side: give a smaller"):
            write_events(path, events)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_late_times_are_written_or_refused(ending: str, tmp_path: Path) -> None:
    path, end_us = tmp_path / f"events{ending}", FORM_LIMITS[EVENT_FORMS[ENDINGS[ending]].limit].end_us
    if end_us < 2**36:
        with pytest.raises(UsageError, match=rf"an event at {end_us} us; .* holds times below {end_us} us: give"):
            write_events(path, listed(4, 4, 7, end_us))
    last_us = min(end_us - 1, 2**32 + 5)
    write_events(path, listed(4, 4, 7, last_us))
    assert read(path).t.tolist() == [7, last_us]


@pytest.mark.parametrize("ending", ENDINGS)
def test_events_outside_of_the_picture_are_refused(ending: str, tmp_path: Path) -> None:
    wrong = dataclasses.replace(listed(9, 9, 5), height_px=8)
    with pytest.raises(UsageError, match=r"events reach x = 8, y = 8, outside of the picture of 9 x 8 px"):
        write_events(tmp_path / f"events{ending}", wrong)


def test_the_program_refuses_a_picture_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["missing.mp4", "--out", str(tmp_path / "s.npz"), "--set", "crop_width_px=2049", "--events"]
    assert command.main([*line, str(tmp_path / "e.raw")]) == 2
    said = capsys.readouterr().err
    assert "EVT 3 holds at most 2048 px a side: give a smaller crop, or another form: h5, dsec, npz, aed" in said
    assert command.main([*line, str(tmp_path / "e.dat")]) == 2
    assert "missing.mp4" in capsys.readouterr().err


def test_a_name_that_says_no_form_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"ends in \.h5"):
        write_events(tmp_path / "events.bin", some_events())
    with pytest.raises(UsageError, match="No such file"):
        write_events(tmp_path / "nowhere" / "events.npz", some_events())


@pytest.mark.parametrize(("grids", "bin_us"), [(0, 40_000.0), (3, 40_000 / 15)])
def test_the_program_writes_the_events_of_its_sample(
    grids: int, bin_us: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = write_clip(tmp_path / "gliding.mp4", panned_luma(40, 48, 64))
    sample, events = tmp_path / "sample.npz", tmp_path / "events.h5"
    small = [
        "--set",
        "voxels_per_clip=3",
        "--set",
        "crop_height_px=32",
        "--set",
        "crop_width_px=40",
        "--set",
        f"grids_per_frame={grids}",
    ]
    line = [str(clip), "--out", str(sample), "--cache-dir", str(tmp_path), *small, "--events"]
    assert command.main([*line, str(events)]) == 0
    assert " events written to " in capsys.readouterr().out
    with np.load(sample) as arrays:
        voxels = arrays["voxels"]
    assert voxels.any()
    np.testing.assert_array_equal(read(events).voxels(*voxels.shape[:2], bin_us, "int8"), voxels)
