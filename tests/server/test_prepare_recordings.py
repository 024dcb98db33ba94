"""Raw recordings of every form become files that are served; what is damaged or hostile is refused in words."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.trainer.convert.scene import HEIGHT, PERIOD_US, WIDTH, WINDOWS, expected_voxels, scene
from tests.trainer.convert.test_forms import WITH_PICTURES, WITHOUT
from v2v_protocol.errors import CorpusError
from v2v_protocol.recipe import preset
from v2v_protocol.sample import array_layout, new_arrays
from v2v_recordings.items import EventChunk, FlowField, Note, Picture, SensorSize
from v2v_recordings.layout_writer import RecordingWriter
from v2v_server import prepare_recordings
from v2v_server.commands import prepare
from v2v_server.prepare_recordings import convert_recordings
from v2v_server.recorded import fill_arrays
from v2v_server.simulation.draw import draw
from v2v_server.store.event_file import EventFile

CASES = WITH_PICTURES | WITHOUT
LONGEST_SECONDS = 5.0


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a recording of each form, each in a folder of its own, and prepare all of them as the command does."""
    source, target = tmp_path_factory.mktemp("raw"), tmp_path_factory.mktemp("prepared")
    for case, (_, name, write) in CASES.items():
        (source / case).mkdir()
        write(source / case / name, scene())
    assert not [each for each in convert_recordings(source, target, 1) if each.problem]
    return target


@pytest.mark.parametrize("case", CASES)
def test_every_raw_form_gives_the_known_voxel_grids(case: str, prepared: Path) -> None:
    original, has_pictures = scene(), case in WITH_PICTURES
    (path,) = (prepared / case).rglob("*.v2ve")
    with EventFile(path) as recording:
        size = recording.head.height_px, recording.head.width_px
        events = recording.between(np.array([-(2**62), 2**62]), (0, 0, *size))
        assert np.array_equal(events.pixel, original.y.astype(int) * size[1] + original.x)
        assert np.array_equal(events.brighter, original.p)
        assert np.array_equal(np.diff(events.t_ns), 1000 * np.diff(original.t_us))
        assert len(recording.pictures_table) == (WINDOWS + 1 if has_pictures else 0)
        if not has_pictures:
            return
        assert size == (HEIGHT, WIDTH)
        edges = recording.pictures_table["t_ns"].astype(np.int64)
        events = recording.between(edges, (0, 0, *size))
        assert np.diff(edges).tolist() == [1000 * PERIOD_US] * WINDOWS
        for number, picture in enumerate(original.pictures):
            assert np.array_equal(recording.picture(number), picture)
    size = {"voxels_per_clip": WINDOWS, "crop_height_px": HEIGHT, "crop_width_px": WIDTH, "flip_probability": 0.0}
    recipe = preset("recordings").replace(**size, bin_span="events")
    params = draw(
        recipe, seed=0, epoch=0, index=0, picture_height_px=HEIGHT, picture_width_px=WIDTH, video_id=""
    )  # fmt: skip
    out = new_arrays(array_layout(recipe, "float32", ("voxels", "voxels_bilinear")))
    fill_arrays(events, edges, recipe, params, out)
    for window in range(WINDOWS):
        assert np.array_equal(out["voxels"][window], expected_voxels(window, "discrete"))
        assert np.allclose(out["voxels_bilinear"][window], expected_voxels(window, "interpolated"), rtol=0, atol=1e-6)


def recording_of(path: Path, **columns: Any) -> Path:
    """Write a small recording in the h5 layout, with pictures and true flow."""
    path.parent.mkdir(parents=True, exist_ok=True)
    count = columns.get("count", 100)
    with RecordingWriter(path, source="test") as writer:
        writer.add(SensorSize(20, 16))
        at = np.arange(count)
        writer.add(EventChunk(1_000_000 * at, at % 20, at % 16, at % 2 == 0))
        for number in range(3):
            writer.add(Picture(30_000_000 * number, np.full((16, 20), number, np.uint8)))
            writer.add(FlowField(30_000_000 * number, np.full((2, 16, 20), number, np.float32)))
        writer.add(Note("a note"))
    return path


def test_a_second_run_keeps_what_has_not_changed(tmp_path: Path) -> None:
    source, target = tmp_path / "raw", tmp_path / "prepared"
    for name in ("a.h5", "deep/b.h5"):
        recording_of(source / name)
    made = list(convert_recordings(source, target, 1))
    assert sorted((each.id, each.events, each.pictures, each.flows, each.is_kept) for each in made) == [
        ("a.h5", 100, 3, 3, False), ("deep/b.h5", 100, 3, 3, False),
    ]  # fmt: skip
    first = {path.name: path.read_bytes() for path in target.rglob("*.v2ve")}
    recording_of(source / "deep/b.h5", count=101)
    again = {each.id: each for each in convert_recordings(source, target, 2)}
    assert (again["a.h5"].is_kept, again["deep/b.h5"].is_kept, again["deep/b.h5"].events) == (True, False, 101)
    (target / "a.h5.v2ve").write_bytes(first["a.h5.v2ve"][:-1])
    again = {each.id: each for each in convert_recordings(source, target, 1)}
    assert (again["a.h5"].is_kept, again["deep/b.h5"].is_kept) == (False, True), "a damaged file is written again"
    assert (target / "a.h5.v2ve").read_bytes() == first["a.h5.v2ve"], "with equal bytes"
    assert not [path for path in target.rglob("*") if path.is_file() and path.suffix != ".v2ve"]


def claimed(path: Path, dtype: str, count: int, chunk: int) -> None:
    """Let ``events/ts`` state a number of events that are not there, in chunks of this size."""
    recording_of(path)
    with h5py.File(path, "a") as file:
        del file["events/ts"]
        file.create_dataset("events/ts", (count,), dtype, chunks=(chunk,), compression="gzip")


def _large_chunk(path: Path) -> None:
    """Let a file that is large enough for it have a chunk of 1 GiB, which is unpacked for each part that is read."""
    claimed(path, "<f8", 1 << 27, 1 << 27)
    with h5py.File(path, "a") as file:
        file["padding"] = np.zeros(5_000_000, np.uint8)


def _header_of_npy(path: Path) -> None:
    path.mkdir()
    for name in ("ts", "xy", "p"):
        with (path / f"events_{name}.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "<f8", "fortran_order": False, "shape": (10**12, *([2] if name == "xy" else []))}
            )


HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "a.h5": (lambda path: claimed(path, "<f8", 10**12, 1 << 10), "is stated to be 8,000,000,000,000 bytes"),
    "b.h5": (lambda path: claimed(path, "<f8", 1 << 30, (1 << 27) + 1), "is stated to be"),
    "c": (_header_of_npy, "is stated to be"),
    "g.h5": (_large_chunk, "a chunk is stated to be 1,073,741,824 bytes, and at most 536,870,912"),
    "d.aedat4": (lambda path: path.write_bytes(b"#!AER-DAT4" + bytes(1000)), "d.aedat4"),
    "e.txt": (lambda path: path.write_text("1e300 1 1 1\n2e300 1 1 1\n"), "out of range"),
    "f.txt": (
        lambda path: path.write_text("0.1 5000 1 1\n0.2 1 1 1\n0.3 1 1 0\n"),
        "coordinates must be from 0 to 4095",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_recordings_are_refused_soon(name: str, tmp_path: Path) -> None:
    write, words = HOSTILE[name]
    (tmp_path / "raw").mkdir()
    write(tmp_path / "raw" / name)
    started = time.process_time()
    (made,) = convert_recordings(tmp_path / "raw", tmp_path / "prepared", 0)
    assert words in made.problem
    assert time.process_time() - started < LONGEST_SECONDS
    assert not list((tmp_path / "prepared").rglob("*.v2ve"))


def _sleep_on(job: prepare_recordings.Conversion) -> prepare_recordings.PreparedRecording:
    time.sleep(600.0)
    raise AssertionError


def _take_all_memory(job: prepare_recordings.Conversion) -> prepare_recordings.PreparedRecording:
    try:
        np.ones(prepare_recordings.MOST_MEMORY_BYTES, np.uint8)
    except MemoryError:
        return prepare_recordings.PreparedRecording(job.id, problem="too much")
    raise AssertionError


@pytest.mark.parametrize(("reader", "words"), [(_sleep_on, "s without a result"), (_take_all_memory, "too much")])
def test_reading_has_limits(reader: Any, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording_of(tmp_path / "raw/a.h5")
    monkeypatch.setattr(prepare_recordings, "convert_recording", reader)
    if reader is _sleep_on:
        monkeypatch.setattr(prepare_recordings, "_LEAST_SECONDS", 0.0)
    (made,) = convert_recordings(tmp_path / "raw", tmp_path / "prepared", 1)
    assert words in made.problem


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        ("raw", "raw/prepared", "overlap"),
        ("raw", ".", "overlap"),
        ("empty", "prepared", "no recording of a known form"),
    ],
)
def test_what_cannot_be_prepared_is_said(source: str, target: str, words: str, tmp_path: Path) -> None:
    recording_of(tmp_path / "raw/a.h5")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CorpusError, match=words):
        list(convert_recordings(tmp_path / source, tmp_path / target, 0))


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording_of(tmp_path / "raw/a.h5")
    (tmp_path / "raw/b.txt").write_text("0.5 1\n")
    flags = ["--videos-kind", "recordings", "--workers", "1"]
    line = [str(tmp_path / "raw"), str(tmp_path / "prepared"), *flags]
    assert prepare.main([*line, "--json", str(tmp_path / "record.json")]) == 1
    said = capsys.readouterr().out
    assert "1 of 2 recordings prepared" in said
    assert "a.h5: 100 events, 3 pictures, 3 fields of flow" in said
    assert f"v2v-serve --videos {tmp_path / 'prepared'} --videos-kind recordings" in said
    assert "b.txt: " in said
    (tmp_path / "raw/b.txt").unlink()
    assert prepare.main([str(tmp_path / "raw/a.h5"), *line[1:]]) == 0
    assert "(1 of them earlier)" in capsys.readouterr().out
    assert prepare.main([*line, "--size", "raw"]) == 2
    assert "--size has no effect with --videos-kind recordings" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "prepared")
