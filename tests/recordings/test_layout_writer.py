"""Test the writer: order, pairing of pictures, bounds, and that only complete files appear."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.convert import cli
from v2v_protocol.errors import UsageError
from v2v_recordings import item_writer
from v2v_recordings.item_writer import Written
from v2v_recordings.items import EventChunk, Item, Picture, SensorSize
from v2v_recordings.layout_writer import RecordingWriter
from v2v_recordings.reading import FORMS, RawForm


def chunk(times_ns: list[int], x: int = 0, y: int = 0) -> EventChunk:
    count = len(times_ns)
    return EventChunk(np.array(times_ns, np.int64), np.full(count, x), np.full(count, y), np.ones(count, bool))


def picture(t_ns: int, shape: tuple[int, int] = (8, 9)) -> Picture:
    return Picture(t_ns, np.zeros(shape, np.uint8))


def write(path: Path, items: list[Item], size: SensorSize | None = None) -> Written:
    with RecordingWriter(path, source="test", size=size) as writer:
        for item in items:
            writer.add(item)
    assert writer.written is not None
    return writer.written


@settings(max_examples=40)
@given(st.data())
def test_pictures_are_paired_and_late_events_sorted_whatever_the_chunks(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Compare with sorting and searching in one piece. Buffers hold few events, so that every boundary is crossed."""
    times = sorted(data.draw(st.lists(st.integers(0, 200), min_size=1, max_size=60)))
    # Late by fewer than the four events that the buffer holds back.
    keys = [position + data.draw(st.integers(0, 3)) for position in range(len(times))]
    shuffled = [times[position] for position in np.argsort(keys, kind="stable")]
    pictures = data.draw(st.lists(st.integers(-20, 220), max_size=5))
    edges = sorted(data.draw(st.lists(st.integers(0, len(times)), max_size=8)))
    items: list[Item] = [chunk(list(part)) for part in np.split(np.array(shuffled), edges)]
    for time in pictures:
        items.insert(data.draw(st.integers(0, len(items))), picture(time))
    path = tmp_path_factory.mktemp("writer") / "a.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(item_writer, "FLUSH_EVENTS", 5)
        patch.setattr(item_writer, "REORDER_EVENTS", 4)
        written = write(path, items)
    assert written.events == len(times)
    with h5py.File(path) as file:
        origin = file.attrs["start_ns"]
        np.testing.assert_allclose(file["events/ts"][:] * 1e9 + origin, times, rtol=0, atol=1e-3)
        assert file.attrs["t0"] * 1e9 + origin == pytest.approx(min(times), abs=1e-3)
        assert file.attrs["duration"] * 1e9 == pytest.approx(max(times) - min(times), abs=1e-3)
        paired = [
            (round(image.attrs["timestamp"] * 1e9) + origin, image.attrs["event_idx"])
            for image in file["images"].values()
        ]
    assert sorted(paired) == sorted((time, np.searchsorted(times, time)) for time in pictures)


def test_events_later_than_the_buffer_reaches_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(item_writer, "FLUSH_EVENTS", 4)
    monkeypatch.setattr(item_writer, "REORDER_EVENTS", 2)
    with pytest.raises(UsageError, match=r"goes back by 2\.000000 s over more than 2 events"):
        write(tmp_path / "a.h5", [chunk([10**10 + i for i in range(8)]), chunk([8 * 10**9] * 6)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("items", "size", "message"),
    [
        ([picture(0)], None, "no events"),
        ([chunk([0], x=9), picture(0)], None, r"reach x = 9, y = 0, outside of the sensor of 9 x 8"),
        ([chunk([0], y=4)], SensorSize(9, 4), r"y = 4, outside of the sensor of 9 x 4"),
        ([chunk([0], x=-1)], None, "events at x -1"),
        ([chunk([0], x=70000)], None, "events at x 70000"),
        ([SensorSize(5, 5), chunk([0])], SensorSize(9, 8), "states a sensor of 5 x 5, not 9 x 8"),
        ([chunk([0]), picture(0), picture(1, (8, 8))], None, "pictures of different sizes"),
        ([SensorSize(5, 5), chunk([0]), picture(0)], None, r"the sensor is SensorSize\(width=5"),
    ],
)
def test_invalid_items_are_refused_and_leave_no_file(
    tmp_path: Path, items: list[Item], size: SensorSize | None, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        write(tmp_path / "a.h5", items, size)
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    write(path, [chunk([0, 5])])
    before = path.read_bytes()

    def interrupted() -> None:
        with RecordingWriter(path, source="test") as writer:
            writer.add(chunk([1, 2, 3]))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_disorder_is_counted(tmp_path: Path) -> None:
    written = write(tmp_path / "a.h5", [chunk([0, 7, 5, 9]), picture(4), picture(3)])
    assert (written.reordered_events, written.backward_images) == (1, 1)


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(UsageError, match="different lengths"):
        EventChunk(np.zeros(2, np.int64), np.zeros(2, int), np.zeros(1, int), np.zeros(2, bool))


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
from trainer.convert.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("limit", [1000, 100_000])
def test_a_full_disk_is_one_line(tmp_path: Path, limit: int) -> None:
    """A limit of the file's size stands for it, early and late. HDF5 by itself ends the process by a signal."""
    random, count = np.random.default_rng(0), 100_000
    t, x, y = np.sort(random.integers(0, 10**6, count)), *random.integers(0, 100, (2, count))
    np.savez(tmp_path / "a.npz", t=t, x=x, y=y, p=x % 2)
    command = [
        sys.executable,
        "-c",
        LIMITED,
        str(limit),
        str(tmp_path / "a.npz"),
        "--out",
        str(tmp_path / "out" / "a.h5"),
    ]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == f"v2v-convert: {tmp_path / 'out' / 'a.h5'}: cannot be written: File too large\n"
    assert list((tmp_path / "out").iterdir()) == []


def test_sigterm_leaves_no_incomplete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def read(*_: object) -> Iterator[Item]:
        yield chunk([0, 5])
        assert list(tmp_path.glob("out/.*.partial"))
        signal.raise_signal(signal.SIGTERM)
        yield chunk([7])

    def too_late(*_: object) -> None:
        pytest.fail("the command does not handle SIGTERM")

    (tmp_path / "a.toy").touch()
    monkeypatch.setitem(FORMS, "toy", RawForm("toy", lambda path: path.suffix == ".toy", read))
    before = signal.signal(signal.SIGTERM, too_late)
    try:
        assert cli.main([str(tmp_path / "a.toy"), "--out", str(tmp_path / "out")]) == 130
        assert signal.getsignal(signal.SIGTERM) is too_late
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == "v2v-convert: interrupted; no incomplete file is left\n"
    assert list(tmp_path.glob("out/.*")) == []
