"""Test that every raw form gives the same recording: its events, its pictures, the known voxel grids."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.trainer.convert import raw_forms
from tests.trainer.convert.aedat4_file import write_aedat4
from tests.trainer.convert.scene import HEIGHT, PERIOD_US, WIDTH, WINDOWS, Scene, expected_voxels, scene
from trainer.convert import convert
from trainer.evaluation.readers import Recording
from trainer.evaluation.voxelise import VoxelSettings, voxel_grid
from trainer.evaluation.windows import picture_windows, regular_windows
from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, SensorSize

Write = Callable[[Path, Scene], None]

WITH_PICTURES: dict[str, tuple[str, str, Write]] = {
    "ijrr zip": ("ijrr", "slow.zip", lambda path, s: raw_forms.write_zip(path, raw_forms.ijrr_members(s))),
    "ijrr in capitals": (
        "ijrr",
        "SLOW.ZIP",
        lambda path, s: raw_forms.write_zip(
            path,
            {
                name.upper().replace("IMAGES/FRAME", "images/frame").replace("PNG", "png"): content
                for name, content in raw_forms.ijrr_members(s).items()
            },
        ),
    ),
    "ijrr folder": ("ijrr", "slow", lambda path, s: raw_forms.write_folder(path, raw_forms.ijrr_members(s))),
    "evaid zip": ("evaid", "ball.zip", lambda path, s: raw_forms.write_zip(path, raw_forms.evaid_members(s))),
    "evaid zip of macOS": (
        "evaid",
        "ball.zip",
        lambda path, s: raw_forms.write_zip(path, raw_forms.with_macos_notes(raw_forms.evaid_members(s))),
    ),
    "evaid folder": ("evaid", "ball", lambda path, s: raw_forms.write_folder(path, raw_forms.evaid_members(s))),
    "mvsec": ("mvsec", "indoor_flying1_data.hdf5", raw_forms.write_mvsec),
    "dsec": ("dsec", "zurich_city_00_a", raw_forms.write_dsec),
    "dsec with a stated size": (
        "dsec",
        "zurich_city_00_a",
        lambda path, s: raw_forms.write_dsec(path, s, width=WIDTH, height=HEIGHT),
    ),
    "evreal": ("columns", "boxes", lambda path, s: raw_forms.write_folder(path, raw_forms.evreal_members(s))),
    "evreal zip": ("columns", "BOXES.ZIP", lambda path, s: raw_forms.write_zip(path, raw_forms.evreal_members(s))),
    "bag": ("bag", "desk.bag", raw_forms.write_bag),
    "bag of colour": ("bag", "desk.bag", lambda path, s: raw_forms.write_bag(path, s, image_encoding="bgr8")),
    "bag of packets": ("bag", "desk.bag", lambda path, s: raw_forms.write_bag(path, s, packets=True)),
    "bag of packets from the middle": (
        "bag",
        "desk.bag",
        lambda path, s: raw_forms.write_bag(path, s, packets=True, front=raw_forms.EVT3_MIDDLE),
    ),
    "aedat4": ("aedat4", "own.aedat4", write_aedat4),
}
WITHOUT: dict[str, tuple[str, str, Write]] = {
    "evt2": ("prophesee", "own.raw", raw_forms.write_evt2),
    "evt3": ("prophesee", "own.raw", raw_forms.write_evt3),
    "evt2 from the middle": (
        "prophesee",
        "own.raw",
        lambda path, s: raw_forms.write_evt2(path, s, front=b"\4\x18\0\x14" * 3),
    ),
    "evt3 from the middle": (
        "prophesee",
        "own.raw",
        lambda path, s: raw_forms.write_evt3(path, s, front=raw_forms.EVT3_MIDDLE),
    ),
    "evt2 in capitals": ("prophesee", "OWN.RAW", raw_forms.write_evt2),
    "evt2 called dat": ("prophesee", "OWN.DAT", raw_forms.write_evt2),
    "npz": ("columns", "own.npz", raw_forms.write_npz),
    "npz in capitals": ("columns", "OWN.NPZ", raw_forms.write_npz),
    "text": ("ijrr", "own.txt", lambda path, s: path.write_bytes(raw_forms.ijrr_members(s)["slow/events.txt"])),
}


def fingerprint(path: Path) -> dict[str, str]:
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def check_events(path: Path, expected: Scene) -> None:
    with h5py.File(path) as file:
        assert {name: column.dtype.str for name, column in file["events"].items()} == {
            "ts": "<f8", "xs": "<u2", "ys": "<u2", "ps": "|b1"
        }  # fmt: skip
        np.testing.assert_allclose(file["events/ts"][:], (expected.t_us - expected.t_us[0]) / 1e6, rtol=0, atol=1e-12)
        for name, values in (("xs", expected.x), ("ys", expected.y), ("ps", expected.p)):
            np.testing.assert_array_equal(file[f"events/{name}"][:], values)
        assert file.attrs["num_events"] == len(expected.t_us)


@pytest.mark.parametrize("case", WITH_PICTURES)
@pytest.mark.parametrize("kind", ["discrete", "interpolated"])
def test_every_raw_form_gives_the_known_voxel_grids(tmp_path: Path, case: str, kind: str) -> None:
    form, name, write = WITH_PICTURES[case]
    source, destination = tmp_path / name, tmp_path / "out" / "sequence.h5"
    original = scene()
    write(source, original)
    before = fingerprint(source)

    done = convert(source, destination)
    assert (done.form, done.written.events, done.written.images) == (form, len(original.t_us), WINDOWS + 1)
    assert done.written.size == SensorSize(WIDTH, HEIGHT)
    assert fingerprint(source) == before
    assert list(destination.parent.iterdir()) == [destination]
    check_events(destination, original)

    with Recording(destination) as recording:
        assert recording.size == (HEIGHT, WIDTH)
        assert recording.repaired_images == 0
        windows = picture_windows(recording)
        assert len(windows) == WINDOWS
        for number, window in enumerate(windows):
            assert window.end - window.begin == pytest.approx(PERIOD_US / 1e6, abs=1e-9)
            grid = voxel_grid(
                recording.events(window), recording.size, VoxelSettings(kind=kind), (window.begin, window.end)
            )
            np.testing.assert_allclose(grid, expected_voxels(number, kind), rtol=0, atol=1e-6)
            assert window.target is not None
            np.testing.assert_array_equal(recording.image(window.target), original.pictures[number + 1])


@pytest.mark.parametrize("case", WITHOUT)
def test_events_without_pictures_are_converted(tmp_path: Path, case: str) -> None:
    form, name, write = WITHOUT[case]
    original = scene()
    write(tmp_path / name, original)
    options = ConvertOptions(size=SensorSize(WIDTH, HEIGHT)) if case == "text" else ConvertOptions()
    done = convert(tmp_path / name, tmp_path / "own.h5", options=options)
    assert (done.form, done.written.images, done.written.size) == (form, 0, SensorSize(WIDTH, HEIGHT))
    check_events(tmp_path / "own.h5", original)
    with Recording(tmp_path / "own.h5") as recording:
        assert recording.size == (HEIGHT, WIDTH)
        with pytest.raises(UsageError, match="no pictures"):
            picture_windows(recording)
        # 39 ms at 100 windows a second: three whole ones, the first three of the scene.
        windows = regular_windows(recording, 100)
        assert len(windows) == 3
        for number, window in enumerate(windows):
            grid = voxel_grid(recording.events(window), recording.size, VoxelSettings(), (window.begin, window.end))
            np.testing.assert_array_equal(grid, expected_voxels(number, "discrete"))


def test_the_published_event_index_is_written_as_well(tmp_path: Path) -> None:
    """HQF's script pairs a picture with the event before it; MVSEC's takes the index in the raw file."""
    original = scene()
    raw_forms.write_bag(tmp_path / "desk.bag", original)
    raw_forms.write_mvsec(tmp_path / "fly_data.hdf5", original)
    first_events = np.searchsorted(original.t_us, original.picture_us)
    for name in ("desk.bag", "fly_data.hdf5"):
        out = tmp_path / f"{name}.h5"
        convert(tmp_path / name, out)
        with Recording(out) as recording:
            assert [image.event_index for image in recording.images] == first_events.tolist()
        with Recording(out, as_published=True) as recording:
            assert [image.event_index for image in recording.images] == [0, *(first_events[1:] - 1)]


def test_the_right_camera_of_a_stereo_recording(tmp_path: Path) -> None:
    raw_forms.write_mvsec(tmp_path / "fly_data.hdf5", scene())
    convert(tmp_path / "fly_data.hdf5", tmp_path / "fly.h5", options=ConvertOptions(camera="right"))
    with h5py.File(tmp_path / "fly.h5") as file:
        np.testing.assert_array_equal(file["events/xs"][:], scene().x + 1)


def test_text_units_and_header(tmp_path: Path) -> None:
    """Integers are us and numbers with a point are s, unless the user gives the unit. A header states the size."""
    for text, unit, seconds in (
        ("5000000 1 2 1\n5000300 1 2 0\n", None, 300e-6),
        ("5.0 1 2 1\n5.0003 1 2 -1", None, 300e-6),
        ("0 1 2 1\n0.0003 1 2 0\n", None, 300e-6),
        ("0 1 2 1\n3e-04 1 2 0\n", None, 300e-6),
        ("5000000 1 2 1\n5000300 1 2 0\n", "ns", 300e-9),
        ("24 18\n\n5000000 1 2 1\n5000300 1 2 0\n\n", None, 300e-6),
    ):
        (tmp_path / "own.txt").write_text(text)
        out = tmp_path / "own.h5"
        done = convert(tmp_path / "own.txt", out, options=ConvertOptions(time_unit=unit), overwrite=True)
        assert done.written.seconds == pytest.approx(seconds, abs=1e-12)
        assert done.written.size == (SensorSize(24, 18) if text.startswith("24") else SensorSize(2, 3))
        with h5py.File(out) as file:
            assert file["events/ps"][:].tolist() == [True, False]
