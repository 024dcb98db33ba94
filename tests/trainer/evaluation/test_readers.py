"""Test recordings in the layout of each data set, with the faults of published files."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trainer.evaluation.h5_file import random_recording, write_h5
from trainer.evaluation import readers
from trainer.evaluation.readers import EventWindow, Recording
from trainer.evaluation.windows import picture_windows, regular_windows, windows_of_events, windows_of_seconds
from v2v_protocol.errors import UsageError

PIXELS = np.arange(12, dtype=np.uint8).reshape(3, 4)
T = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5])


def recording(
    path: Path, attributes: list[dict[str, Any]], *, polarities: tuple[int, int] = (0, 1), **options: Any
) -> Path:
    """Six events at 1.0, 1.1 ... 1.5 s, x = their number modulo 4."""
    numbers = np.arange(len(T))
    pictures = [(PIXELS + number, given) for number, given in enumerate(attributes)]
    return write_h5(path / "a.h5", T, numbers % 4, numbers % 3, np.array(polarities)[numbers % 2], pictures, **options)


def stamped(*times: float, shift: int = 0) -> list[dict[str, Any]]:
    return [{"timestamp": time, "event_idx": max(0, int(np.searchsorted(T, time)) + shift)} for time in times]


@pytest.mark.parametrize(
    ("data_set", "options"),
    [
        ("HQF", {"ts_dtype": "f8", "ps_dtype": "?"}),
        ("IJRR, MVSEC", {"ts_dtype": "f8", "ps_dtype": "u1"}),
        ("EVAID", {"ts_dtype": "f4", "ps_dtype": "u1"}),
        ("polarities of -1 and 1", {"ps_dtype": "i1", "polarities": (-1, 1)}),
    ],
)
def test_layouts(tmp_path: Path, data_set: str, options: dict[str, Any]) -> None:
    with Recording(recording(tmp_path, stamped(1.05, 1.25, 1.45), **options)) as opened:
        assert (opened.name, opened.size, len(opened)) == ("a", (3, 4), 6)
        first, second = picture_windows(opened)
        events = opened.events(first)
        assert events.x.tolist() == [1, 2]
        assert events.p.tolist() == [1, -1]
        np.testing.assert_allclose(events.t, [1.1, 1.2], rtol=0, atol=1e-6)
        assert opened.events(second).x.tolist() == [3, 0]
        assert second.target is not None
        np.testing.assert_array_equal(opened.image(second.target), PIXELS + 2)


def test_an_event_at_the_time_of_a_picture_belongs_to_the_window_after_it(tmp_path: Path) -> None:
    with Recording(recording(tmp_path, stamped(1.0, 1.2, 1.4))) as opened:
        assert [opened.events(window).t.tolist() for window in picture_windows(opened)] == [[1.0, 1.1], [1.2, 1.3]]


def test_event_indices_one_early_are_repaired_or_kept_as_published(tmp_path: Path) -> None:
    path = recording(tmp_path, stamped(1.05, 1.25, 1.45, shift=-1))
    with Recording(path) as opened:
        assert [len(opened.events(window)) for window in picture_windows(opened)] == [2, 2]
        assert opened.events(picture_windows(opened)[0]).t.tolist() == [1.1, 1.2]
    with Recording(path, as_published=True) as opened:
        assert opened.events(picture_windows(opened)[0]).t.tolist() == [1.0, 1.1]


def test_a_time_stamp_that_goes_back_is_repaired_or_kept_as_published(tmp_path: Path) -> None:
    """Pictures at 1.05, 1.25, [1.15], 1.45: the third is moved to 1.35. Published: an empty window, then 3 events."""
    path = recording(tmp_path, stamped(1.05, 1.25, 1.15, 1.45))
    with Recording(path) as opened:
        assert opened.repaired_images == 1
        assert [image.time for image in opened.images] == pytest.approx([1.05, 1.25, 1.35, 1.45])
        assert [opened.events(window).t.tolist() for window in picture_windows(opened)] == [[1.1, 1.2], [1.3], [1.4]]
    with Recording(path, as_published=True) as opened:
        assert opened.repaired_images == 0
        assert [opened.events(window).t.tolist() for window in picture_windows(opened)] == [
            [1.1, 1.2],
            [],
            [1.2, 1.3, 1.4],
        ]
    with Recording(recording(tmp_path, stamped(1.05, 1.25, 1.15))) as opened:
        assert opened.images[-1].time == pytest.approx(1.35)


def test_different_clocks_are_refused_or_accepted_as_published(tmp_path: Path) -> None:
    """The released aedat4 script searches microseconds in seconds: every event_idx is the number of events."""
    attributes = [{"timestamp": 1.6e15 + step, "event_idx": 6} for step in range(2)]
    path = recording(tmp_path, attributes)
    with pytest.raises(UsageError, match=r"different clocks.*v2v-convert.*--as-published"):
        Recording(path)
    with Recording(path, as_published=True) as opened:
        assert [len(opened.events(window)) for window in picture_windows(opened)] == [0]


@pytest.mark.parametrize("shift", [0, -1])
def test_clocks_of_different_units_are_refused_even_if_they_overlap(tmp_path: Path, shift: int) -> None:
    """Both clocks start at the first picture, but one counts microseconds."""
    attributes = [
        {**each, "timestamp": 1.05 + (each["timestamp"] - 1.05) * 1e6}
        for each in stamped(1.05, 1.25, 1.45, shift=shift)
    ]
    with pytest.raises(UsageError, match="different clocks"):
        Recording(recording(tmp_path, attributes))


@pytest.mark.parametrize("index", [5, 6])
def test_pictures_before_and_after_all_events_are_accepted(tmp_path: Path, index: int) -> None:
    """The released conversion of HQF writes one event less."""
    attributes = [{"timestamp": time, "event_idx": index if time > 2 else 0} for time in (-2.0, 1.25, 3.0, 4.0)]
    with Recording(recording(tmp_path, attributes)) as opened:
        assert [len(opened.events(window)) for window in picture_windows(opened)] == [3, 3, 0]


def test_without_time_stamps_the_index_decides(tmp_path: Path) -> None:
    with Recording(recording(tmp_path, [{"event_idx": 1}, {"event_idx": 4}])) as opened:
        assert [window.start for window in picture_windows(opened)] == [1]
        assert picture_windows(opened)[0].stop == 4
        assert [image.time for image in opened.images] == [1.1, 1.4]


def test_pictures_are_listed_without_all_being_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_datasets = []
    repair = Recording._repair_times

    def count_and_repair(self: Recording, times: list[float]) -> list[float]:
        open_datasets.append(h5py.h5f.get_obj_count(self._file.id, h5py.h5f.OBJ_DATASET))
        return repair(self, times)

    monkeypatch.setattr(Recording, "_repair_times", count_and_repair)
    with Recording(random_recording(tmp_path / "a.h5", images=50, events=50)) as opened:
        assert len(opened.images) == 50
    assert open_datasets[0] <= 6, "four columns, and at most the picture read last"


def test_time_ranges_count_from_the_first_picture(tmp_path: Path) -> None:
    path = random_recording(tmp_path / "a.h5", images=51, period=0.1, events=500)
    with Recording(path) as opened:
        windows = picture_windows(opened, (1.0, 3.0))
        assert len(windows) == 19
        assert windows[0].begin == pytest.approx(2.0)
        assert windows[-1].end == pytest.approx(3.9)  # the picture at the end of a time range is not in it, as released
        assert len(picture_windows(opened, (0.0, 60.0))) == 50


def test_a_shifted_time_range_moves_by_pictures(tmp_path: Path) -> None:
    with Recording(random_recording(tmp_path / "a.h5", images=51, period=0.1, events=500)) as opened:
        for time_range, first, last in (((1.05, 3.05), 12, 31), ((0.0, 60.0), 1, 50)):
            windows = picture_windows(opened, time_range, later=1)
            assert (windows[0].begin, windows[-1].end) == (opened.images[first].time, opened.images[last].time)


def test_windows_end_at_every_third_picture(tmp_path: Path) -> None:
    with Recording(random_recording(tmp_path / "a.h5", images=12, events=500)) as opened:
        windows = picture_windows(opened, pictures=3)
        assert [window.target for window in windows] == [opened.images[place] for place in (3, 6, 9)]
        one_by_one = picture_windows(opened)[:9]
        assert [len(opened.events(window)) for window in windows] == [
            sum(len(opened.events(part)) for part in one_by_one[start : start + 3]) for start in (0, 3, 6)
        ]


def test_windows_of_time_have_the_picture_nearest_to_their_end(tmp_path: Path) -> None:
    path = recording(tmp_path, stamped(1.0, 1.19, 1.26, 1.33, 1.5))
    with Recording(path) as opened:
        windows = windows_of_seconds(opened, 0.1)
        assert [(window.start, window.stop) for window in windows] == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
        assert [window.end for window in windows] == pytest.approx([1.1, 1.2, 1.3, 1.4, 1.5])
        # 1.0 is more than half a window from an end; of 1.26 and 1.33, both nearest to 1.3, 1.33 is the nearer one.
        times = [None if window.target is None else window.target.time for window in windows]
        assert times == [None, 1.19, 1.33, None, 1.5]


def test_windows_of_events_have_equal_numbers(tmp_path: Path) -> None:
    with Recording(recording(tmp_path, stamped(1.05, 1.21, 1.4))) as opened:
        windows = windows_of_events(opened, 2)
        assert [(window.start, window.stop) for window in windows] == [(0, 2), (2, 4), (4, 6)]
        assert [window.begin for window in windows] == pytest.approx([1.0, 1.2, 1.4])
        assert [window.end for window in windows] == pytest.approx([1.2, 1.4, 1.5])
        times = [None if window.target is None else window.target.time for window in windows]
        assert times == [1.21, 1.4, None]
        assert [len(opened.events(window)) for window in windows_of_events(opened, 4)] == [4]


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 400), st.floats(0.005, 0.2), st.booleans())
def test_windows_are_consecutive_and_a_picture_is_scored_once(
    tmp_path_factory: pytest.TempPathFactory, events: int, seconds: float, is_cut: bool
) -> None:
    path = random_recording(tmp_path_factory.mktemp("any") / "a.h5", images=21)
    time_range = (0.1, 0.35) if is_cut else None
    with Recording(path) as opened:
        allowed = {
            image.key
            for image in opened.images
            if time_range is None or time_range[0] <= image.time - 1.0 < time_range[1]
        }
        for windows in (
            windows_of_seconds(opened, seconds, time_range),
            windows_of_events(opened, min(events, 200), time_range),
        ):
            for one, other in itertools.pairwise(windows):
                assert (one.stop, one.end) == (other.start, other.begin)
            for window in windows:
                t = opened.events(window).t
                assert ((t >= window.begin) & (t <= window.end)).all()
            keys = [window.target.key for window in windows if window.target is not None]
            assert len(set(keys)) == len(keys)
            assert set(keys) <= allowed


@pytest.mark.parametrize("stated", [{}, {"sensor_resolution": (4, 3)}], ids=["none", "x and y swapped"])
def test_a_given_size_takes_the_place_of_the_stated_one(tmp_path: Path, stated: dict[str, Any]) -> None:
    with Recording(recording(tmp_path, [], **stated), size=(3, 4)) as opened:
        assert opened.size == (3, 4)


@settings(max_examples=30)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=40), st.integers(1, 9))
def test_search_in_blocks_equals_search_in_memory(
    tmp_path_factory: pytest.TempPathFactory, times: list[int], block: int
) -> None:
    t = np.sort(np.array(times, np.float64))
    stamps = np.arange(-0.5, 51.0, 3.5)
    near = [stamp for stamp in stamps if t[0] - 1 <= stamp <= t[-1] + 1] or [float(t[0])]
    path = tmp_path_factory.mktemp("blocks") / "a.h5"
    zeros = np.zeros(len(t))
    write_h5(path, t, zeros, zeros, zeros, [(PIXELS, {"timestamp": stamp, "event_idx": 0}) for stamp in near])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(readers, "BLOCK_EVENTS", block)
        patch.setattr(readers, "CACHED_BLOCKS", 2)
        with Recording(path) as opened:
            assert [image.event_index for image in opened.images] == np.searchsorted(t, near).tolist()


def test_regular_windows(tmp_path: Path) -> None:
    with Recording(recording(tmp_path, [], sensor_resolution=(3, 4))) as opened:
        windows = regular_windows(opened, 5)
        assert [opened.events(window).t.tolist() for window in windows] == [[1.0, 1.1], [1.2, 1.3]]
        assert all(window.target is None for window in windows)


@pytest.mark.parametrize(
    ("windows", "message"),
    [
        (lambda opened: picture_windows(opened, (0.4, 20.0)), "lasts 0.45 s, and the time range is from 0.4 to 20 s"),
        (lambda opened: picture_windows(opened, (0.41, 0.46)), "1 pictures in the time range .* at least 2"),
        (lambda opened: picture_windows(opened, pictures=3), "3 pictures; a window needs at least 4"),
        (lambda opened: picture_windows(opened, pictures=0), "at least 1"),
        (lambda opened: windows_of_seconds(opened, 0.0), "give more than 0"),
        (lambda opened: windows_of_seconds(opened, 2.0), "less than one window of 2 s"),
        (lambda opened: windows_of_events(opened, 0), "at least 1"),
        (lambda opened: windows_of_events(opened, 7), "6 events are less than one window of 7"),
        (lambda opened: regular_windows(opened, 0), "give a number above 0"),
        (lambda opened: regular_windows(opened, float("nan")), "give a number above 0"),
        (lambda opened: regular_windows(opened, float("inf")), "give a number above 0"),
        (lambda opened: regular_windows(opened, 1.9), "less than one window"),
    ],
)
def test_impossible_windows_are_refused(tmp_path: Path, windows: Callable[[Recording], object], message: str) -> None:
    with Recording(recording(tmp_path, stamped(1.0, 1.2, 1.45))) as opened, pytest.raises(UsageError, match=message):
        windows(opened)


def with_columns(path: Path, **columns: Any) -> Path:
    file = recording(path, stamped(1.05))
    with h5py.File(file, "r+") as opened:
        for name, values in columns.items():
            del opened[f"events/{name}"]
            opened[f"events/{name}"] = values
    return file


def raw(path: Path) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        file["davis/left/events"] = np.zeros((2, 4))
    return path / "a.h5"


def text(path: Path) -> Path:
    (path / "a.h5").write_text("no HDF5")
    return path / "a.h5"


def of_colour(path: Path) -> Path:
    return write_h5(path / "a.h5", T, T, T, T, [(np.zeros((3, 4, 3), np.uint8), {"timestamp": 1.0, "event_idx": 0})])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path / "a.h5", "no file"),
        (text, "cannot be read as HDF5"),
        (raw, r"no events/ts.*v2v-convert"),
        (of_colour, r"is \[3, 4, 3\], not \[H, W\]"),
        (lambda path: with_columns(path, xs=np.arange(2)), r"columns of events have \[2, 6\]"),
        (lambda path: with_columns(path, xs=np.ones((6, 1), int)), r"events/xs is int64 \[6, 1\], not a column"),
        (lambda path: with_columns(path, xs=1), r"events/xs is int64 \[\], not a column"),
        (
            lambda path: with_columns(path, xs=T),
            r"events/xs is float64 \[6\], not a column \[N\]; coordinates must be integers",
        ),
        (lambda path: recording(path, []), "give the sensor.s size with --size WxH"),
        (lambda path: recording(path, [{"timestamp": 1.0}]), "without the attribute event_idx"),
        (
            lambda path: recording(path, stamped(1.3, 1.2, 1.1)),
            "pictures 1 and 2 are not later than that of picture 0.*only single times",
        ),
        (
            lambda path: recording(path, stamped(1.2, 1.2)),
            "picture 1, the last, is not later than that of picture 0",
        ),
    ],
)
def test_unreadable_recordings_are_refused(tmp_path: Path, make: Callable[[Path], Path], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Recording(make(tmp_path))


def test_late_events_are_sorted(tmp_path: Path) -> None:
    late = np.array([0, 2, 1, 4, 3, 5])
    with Recording(with_columns(tmp_path, ts=T[late], xs=late)) as opened:
        events = opened.events(EventWindow(0, len(T), 1.0, 1.5, None))
        assert events.t.tolist() == T.tolist()
        assert events.x.tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (T[[0, 1, 5, 3, 4, 2]], r"event \d, at .*Sort the file"),
        (T[::-1], r"event \d, at .*Sort the file"),
        (np.where(T == 1.2, np.nan, T), "event 2, at nan s"),
    ],
    ids=["two", "all", "nan"],
)
def test_unsorted_events_are_refused(tmp_path: Path, times: np.ndarray, message: str) -> None:
    with Recording(with_columns(tmp_path, ts=times)) as opened, pytest.raises(UsageError, match=message):
        opened.events(EventWindow(0, len(T), 1.05, 1.25, None))


def damaged(path: Path, name: str) -> Path:
    """Write a recording in which one dataset's compressed bytes are invalid."""
    file = recording(path, stamped(1.05, 1.25, 1.45))
    with h5py.File(file, "r+") as opened:
        values, attributes = opened[name][:], dict(opened[name].attrs)
        del opened[name]
        made = opened.create_dataset(name, data=values, compression="gzip")
        made.attrs.update(attributes)
        made.id.write_direct_chunk((0,) * values.ndim, b"none")
    return file


@pytest.mark.parametrize("name", ["events/ts", "events/xs", "images/image000000002"])
def test_damage_is_reported(tmp_path: Path, name: str) -> None:
    file = damaged(tmp_path, name)

    def read() -> None:
        with Recording(file) as opened:
            opened.events(picture_windows(opened)[0])
            opened.image(opened.images[2])

    with pytest.raises(UsageError, match=r"a.h5 cannot be read as HDF5: .*HDF5_PLUGIN_PATH"):
        read()


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    first, second = stamped(1.05, 1.25)
    write_h5(path, T, T, T, T, [(PIXELS, first), (PIXELS[:2], second)])
    with Recording(path) as opened, pytest.raises(UsageError, match=r"\[2, 4\], not uint8 \[3, 4\]"):
        opened.image(opened.images[1])
