"""Other programs read from files of events what was written; `v2v-simulate --events` writes the sample's."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_server.simulation import simulate
from v2v_server.simulation.kernels import Voxels
from v2v_tools import simulate as command
from v2v_tools.event_files import EVENT_WRITERS, write_events

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


@pytest.mark.parametrize("ending", EVENT_WRITERS)
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


@pytest.mark.parametrize("ending", EVENT_WRITERS)
def test_no_events_make_a_file_too(ending: str, tmp_path: Path) -> None:
    none = simulate(np.zeros((6, 4, 4), np.uint8), threshold_pos=1.0, start_residual=0.0).to_events(100)
    write_events(tmp_path / f"none{ending}", none)
    assert (tmp_path / f"none{ending}").stat().st_size > 0


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
