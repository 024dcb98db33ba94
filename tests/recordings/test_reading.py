"""Test what holds for every form: own exports, cuts, a clock that is reset, names in capitals, limits of size."""

from __future__ import annotations

import gzip
import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trainer.convert import raw_forms
from tests.trainer.convert.aedat4_file import write_aedat4
from tests.trainer.convert.scene import HEIGHT, WIDTH, Scene, scene
from trainer.convert import convert
from trainer.convert.conversion import in_layout
from trainer.evaluation.readers import Recording
from v2v_protocol.errors import UsageError
from v2v_protocol.events import EventList
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, Picture, SensorSize
from v2v_recordings.reading import LATE_NS, _Clock, read_items, recognise
from v2v_recordings.writers import ENDINGS, write_events
from v2v_tools.fit.recording import read_recording


def read(path: Path, options: ConvertOptions | None = None) -> list[Item]:
    return list(read_items(path, None, options or ConvertOptions()))


def times_us(items: list[Item]) -> list[int]:
    return [int(t) // 1000 for item in items if isinstance(item, EventChunk) for t in item.t_ns]


def notes(items: list[Item]) -> str:
    return "; ".join(item.text for item in items if isinstance(item, Note))


def listed(events: int = 500) -> EventList:
    number = np.arange(events)
    return EventList(
        (number % WIDTH).astype(np.uint16), (number % HEIGHT).astype(np.uint16), 37 * number, number % 3 > 0,
        WIDTH, HEIGHT,
    )  # fmt: skip


@pytest.mark.parametrize("capitals", [False, True])
@pytest.mark.parametrize("ending", ENDINGS)
def test_own_exports_are_read_back(tmp_path: Path, ending: str, capitals: bool) -> None:
    path, events = tmp_path / f"ev{ending.upper() if capitals else ending}", listed()
    write_events(path, events)
    assert path.is_file()
    done = convert(path, tmp_path / "out" / "a.h5")
    assert (done.written.events, done.written.size, done.written.notes) == (500, SensorSize(WIDTH, HEIGHT), ())
    with h5py.File(tmp_path / "out" / "a.h5") as file:
        np.testing.assert_allclose(file["events/ts"][:], events.t * 1e-6, rtol=0, atol=1e-12)
        for name, column in (("xs", events.x), ("ys", events.y), ("ps", events.p)):
            np.testing.assert_array_equal(file[f"events/{name}"][:], column)
    again = convert(tmp_path / "out" / "a.h5", tmp_path / "again.h5")
    assert (again.form, again.written.events, again.written.size) == ("h5", 500, SensorSize(WIDTH, HEIGHT))
    for each in (path, tmp_path / "again.h5"):
        assert int(read_recording(each).counts.sum()) == 500
    with in_layout(path, ConvertOptions(), lambda _done, _total: None) as data:
        assert recognise(data if data.is_file() else next(data.iterdir())) == "h5"


def test_own_layout_keeps_pictures_flow_and_clock(tmp_path: Path) -> None:
    raw_forms.write_mvsec(tmp_path / "fly_data.hdf5", scene())
    with h5py.File(tmp_path / "fly_gt.hdf5", "w") as file:
        file["davis/left/flow_dist"] = np.full((1, 2, HEIGHT, WIDTH), 0.5)
        file["davis/left/flow_dist_ts"] = scene().picture_us[:1] / 1e6
    convert(tmp_path / "fly_data.hdf5", tmp_path / "one.h5")
    convert(tmp_path / "one.h5", tmp_path / "two.h5")
    with h5py.File(tmp_path / "one.h5") as one, h5py.File(tmp_path / "two.h5") as two:
        assert one.attrs["start_ns"] == two.attrs["start_ns"] == scene().t_us[0] * 1000
        for name in ("events/ts", "flow/flow000000000", "images/image000000004"):
            np.testing.assert_array_equal(one[name][:], two[name][:])
        assert one["images/image000000004"].attrs["event_idx"] == two["images/image000000004"].attrs["event_idx"]


@pytest.mark.parametrize("camera", ["left", "right"])
def test_one_camera_of_dsec_is_read(tmp_path: Path, camera: str) -> None:
    left, right = scene(), scene()
    raw_forms.write_dsec(tmp_path / "a", left)
    right.x[:] += 1
    raw_forms.write_dsec(tmp_path / "a", right, "right")
    done = convert(tmp_path / "a", tmp_path / "a.h5", options=ConvertOptions(camera=camera))
    assert done.written.images == len(left.pictures)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["events/xs"][0] == (left if camera == "left" else right).x[0]
        assert file.attrs["start_ns"] == left.t_us[0] * 1000  # with t_offset
    raw_forms.write_dsec(tmp_path / "b" / "one", left)
    raw_forms.write_dsec(tmp_path / "b" / "two", left)
    with pytest.raises(UsageError, match=r"holds 2 recordings"):
        convert(tmp_path / "b", tmp_path / "b.h5")


def test_dsec_as_downloaded_in_parts(tmp_path: Path) -> None:
    raw_forms.write_dsec(tmp_path / "raw", scene())
    folder = tmp_path / "interlaken"
    folder.mkdir()
    (tmp_path / "raw/events/left").rename(folder / "interlaken_00_c_events_left")
    (tmp_path / "raw/images/left/rectified").rename(folder / "interlaken_00_c_images_rectified_left")
    (tmp_path / "raw/images/timestamps.txt").rename(folder / "interlaken_00_c_image_timestamps.txt")
    with h5py.File(folder / "interlaken_00_c_events_left/rectify_map.h5", "w") as file:
        file["rectify_map"] = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    done = convert(folder, tmp_path / "a.h5")
    assert (done.written.images, done.written.size) == (5, SensorSize(WIDTH, HEIGHT))
    assert not done.written.size_is_guessed


@pytest.mark.parametrize("stated", [{}, {"width": WIDTH, "height": HEIGHT}])
def test_frames_of_another_camera_are_left_out_and_named(tmp_path: Path, stated: dict[str, int]) -> None:
    raw_forms.write_dsec(tmp_path / "a", scene(), **stated)
    for path in (tmp_path / "a/images/left/rectified").iterdir():
        path.write_bytes(raw_forms.png(np.zeros((5 * HEIGHT, 5 * WIDTH), np.uint8)))
    done = convert(tmp_path / "a", tmp_path / "a.h5")
    assert done.written.images == 0
    assert "5 frames of 120 x 90 px are of another camera" in done.written.notes[0]


def test_columns_of_floats_are_seconds(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.array([1.5, 2.0]), x=np.array([1, 2]), y=np.array([0, 0]), p=np.array([-1, 1]))
    assert times_us(read(tmp_path / "a.npz")) == [1_500_000, 2_000_000]
    np.savez(tmp_path / "a.npz", t=np.array([1.5, 2.0]), x=np.array([1.5, 2]), y=np.array([0, 0]), p=np.array([0, 1]))
    with pytest.raises(UsageError, match="must be integers"):
        read(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", t=np.arange(2), x=np.arange(3), y=np.arange(2), p=np.arange(2))
    with pytest.raises(UsageError, match=r"columns of t, x, y, p have 2, 3, 2, 2 entries"):
        read(tmp_path / "a.npz")


def whole(path: Path, name: str) -> Path:
    if name == "evreal":
        raw_forms.write_folder(path / name, raw_forms.evreal_members(scene()))
        return path / name / "events_ts.npy"
    if name == "txt":
        (path / "a.txt").write_bytes(raw_forms.ijrr_members(scene())["slow/events.txt"])
        return path / "a.txt"
    writers: dict[str, Callable[[Path, Scene], None]] = {"raw": raw_forms.write_evt2, "aedat4": write_aedat4}
    if name in writers:
        writers[name](path / f"a.{name}", scene())
    else:
        write_events(path / f"a.{name}", listed(28))
    return path / f"a.{name}"


@pytest.mark.parametrize(
    ("name", "cut_bytes", "left", "said"),
    [
        ("txt", 5, 27, "cut: line 28, the last, is incomplete"),
        ("raw", 3, 27, "cut: the last 1 bytes are an incomplete event"),
        ("dat", 3, 27, "cut: the last 5 bytes are an incomplete event"),
        ("es", 3, 27, "cut: the last 2 bytes are an incomplete event"),
        ("aedat4", 100, 28, "cut: packet 7 is incomplete; the 6 before it are read"),
        ("evreal", 3, 27, "cut: 27 of 28 events are there"),
    ],
)
def test_a_recording_cut_in_its_last_packet_is_read_up_to_it(
    tmp_path: Path, name: str, cut_bytes: int, left: int, said: str
) -> None:
    file = whole(tmp_path, name)
    path = file if file.parent == tmp_path else file.parent
    uncut = read(path)
    assert len(times_us(uncut)) == 28
    assert notes(uncut) == ""
    file.write_bytes(file.read_bytes()[:-cut_bytes])
    items = read(path)
    assert times_us(items) == times_us(uncut)[:left]
    assert notes(items).startswith(said)
    size = ConvertOptions(size=SensorSize(WIDTH, HEIGHT))
    assert read_recording(path, size).notes == (notes(items),)
    assert convert(path, tmp_path / "out.h5", options=size).written.notes == (notes(items),)


def chunks(times: list[int], lengths: list[int]) -> list[EventChunk]:
    edges = np.cumsum(lengths)
    zeros = np.zeros(len(times), np.int64)
    every = EventChunk(np.array(times, np.int64), zeros, zeros, zeros > 0)
    return [every.part(int(first), int(last)) for first, last in zip([0, *edges], [*edges, len(times)], strict=True)]


def passed(times: list[int], lengths: list[int]) -> list[Item]:
    clock = _Clock(Path("a.raw"))
    return [item for chunk in [*chunks(times, lengths), None] for item in clock.pass_on(chunk)]


MS = 1_000_000


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_late_events_pass_and_a_reset_clock_continues(data: st.DataObject) -> None:
    """Compare with the times that the recording would have, had the clock not been reset."""
    random, count = np.random.default_rng(data.draw(st.integers(0, 2**32))), data.draw(st.integers(30, 80))
    true = np.cumsum(random.integers(0, data.draw(st.sampled_from((1, MS, 3 * MS))) + 1, count))
    late = true - random.integers(0, LATE_NS // 4 + 1, count)
    at = data.draw(st.integers(10, count - 10))
    back = data.draw(st.integers(2 * LATE_NS, 10**12))
    lengths = data.draw(st.lists(st.integers(0, 9), max_size=8))
    assert notes(passed(late.tolist(), lengths)) == ""
    reset = np.concatenate([true[:at], true[at:] - back - (true[at] - true[at - 1])])
    items = passed(reset.tolist(), lengths)
    got = np.concatenate([item.t_ns for item in items if isinstance(item, EventChunk)])
    np.testing.assert_array_equal(got[:at], true[:at])
    np.testing.assert_array_equal(np.diff(got[at:]), np.diff(true[at:]))
    assert got[at] > got[at - 1]
    assert notes(items).startswith(f"at event {at} the times step back by {back * 1e-9:.6g} s: the clock was reset")


def test_a_late_packet_is_no_reset() -> None:
    """Two packets of 30 ms in the wrong order, in the middle of the recording."""
    parts = [np.arange(30) * MS + 30 * MS * number for number in (0, 2, 1, 3, 4)]
    times = np.concatenate(parts).tolist()
    items = passed(times, [30, 30, 30, 30])
    assert notes(items) == ""
    assert [int(t) for item in items if isinstance(item, EventChunk) for t in item.t_ns] == times


def reset_text(path: Path, **others: bytes) -> Path:
    times = [*range(0, 500_000, 500), *range(100_000, 700_000, 500)]
    lines = "".join(f"{t} {t % WIDTH} {t % HEIGHT} 1\n" for t in times).encode()
    raw_forms.write_zip(path, {"events.txt": lines, **others})
    return path


def test_a_reset_clock_is_a_gap_in_fit_and_convert(tmp_path: Path) -> None:
    size = ConvertOptions(size=SensorSize(WIDTH, HEIGHT))
    done = convert(reset_text(tmp_path / "a.zip"), tmp_path / "a.h5", options=size)
    assert done.written.reordered_events == 0
    assert done.written.seconds == pytest.approx(0.4995 + 0.5995, abs=1e-5)
    assert "at event 1000 the times step back by 0.3995 s" in done.written.notes[0]
    assert read_recording(tmp_path / "a.zip", size).seconds == pytest.approx(1.099, abs=1e-5)


def written_with_reset(path: Path, form: str) -> None:
    """Write a stream of words whose clock goes from 1.5 back to 0.2 s."""
    t = np.concatenate([np.arange(1_000_000, 1_500_000, 500), np.arange(200_000, 900_000, 500)])
    x, y, p = t // 500 % WIDTH, t // 500 % HEIGHT, t // 500 % 2
    if form == "dat":
        words = np.stack([t, p << 28 | y << 14 | x], axis=1).astype("<u4").tobytes()
        path.write_bytes(f"% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n".encode() + b"\x0c\x08" + words)
    elif form == "evt3":
        header = f"% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()
        path.write_bytes(header + raw_forms.evt3_words(t, x, y, p))
    else:
        raw_forms.write_evt2(path, Scene(t, x, y, p > 0, np.zeros(0, np.uint8), t))


@pytest.mark.parametrize("form", ["evt2", "evt3", "dat"])
def test_a_reset_clock_in_words_is_seen(tmp_path: Path, form: str) -> None:
    """The package that decodes them takes a time that steps back for one that wrapped around."""
    path = tmp_path / f"a.{'dat' if form == 'dat' else 'raw'}"
    written_with_reset(path, form)
    done = convert(path, tmp_path / "a.h5")
    assert done.written.events == 2400
    assert done.written.seconds == pytest.approx(0.4995 + 0.6995, abs=1e-5)
    assert "at event 1000 the times step back by 1.2995 s" in done.written.notes[0]


def test_a_clock_that_goes_round_is_no_reset(tmp_path: Path) -> None:
    t = np.arange((1 << 24) - 500_000, (1 << 24) + 500_000, 500)
    zeros = np.zeros(len(t), np.int64)
    header = f"% evt 3.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()
    (tmp_path / "a.raw").write_bytes(header + raw_forms.evt3_words(t, zeros, zeros, zeros))
    done = convert(tmp_path / "a.raw", tmp_path / "a.h5")
    assert done.written.notes == ()
    assert done.written.seconds == pytest.approx(0.9995, abs=1e-6)


def test_pictures_beside_a_reset_clock_are_refused(tmp_path: Path) -> None:
    picture = raw_forms.png(np.zeros((HEIGHT, WIDTH), np.uint8))
    reset_text(tmp_path / "a.zip", **{"images.txt": b"0.1 a.png\n", "a.png": picture})
    with pytest.raises(UsageError, match=r"at event 1000 the times step back by 0.3995 s.*pictures.*split"):
        convert(tmp_path / "a.zip", tmp_path / "a.h5")


def test_a_fit_takes_the_size_of_the_pictures(tmp_path: Path) -> None:
    raw_forms.write_zip(tmp_path / "a.zip", raw_forms.ijrr_members(scene()))
    members = {name: content for name, content in raw_forms.evaid_members(scene()).items() if name != "shape.txt"}
    raw_forms.write_zip(tmp_path / "b.zip", members)
    raw_forms.write_dsec(tmp_path / "c", scene())
    for name in ("a.zip", "b.zip", "c"):
        recorded = read_recording(tmp_path / name)
        assert (recorded.width_px, recorded.height_px, len(recorded.frames)) == (WIDTH, HEIGHT, 4)


def stated(path: Path, form: str, width: int, height: int) -> Path:
    """Write a recording that states this size."""
    made = path / f"a.{form}"
    if form == "txt":
        made.write_text(f"{width} {height}\n1 0 0 1\n2 0 0 0\n")
    elif form == "raw":
        words = struct.pack("<2I", 0x8 << 28, 1 << 28)
        made.write_bytes(f"% evt 2.0\n% geometry {width}x{height}\n% end\n".encode() + words)
    elif form == "zip":
        shape = f"{width} {height}".encode()
        raw_forms.write_zip(made, {"event/0.txt": b"1 0 0 1\n", "timestamps.txt": b"", "shape.txt": shape})
    elif form == "npz":
        np.savez(made, t=np.arange(2), x=np.arange(2), y=np.arange(2), p=np.arange(2), width=width, height=height)
    elif form == "h5":
        with h5py.File(made, "w") as file:
            for name in ("ts", "xs", "ys", "ps"):
                file[f"events/{name}"] = np.arange(2)
            file.attrs["sensor_resolution"] = (height, width)
    else:
        with h5py.File(made, "w") as file:
            for name in ("t", "x", "y", "p"):
                file[f"events/{name}"] = np.arange(2)
            file.attrs.update(width=width, height=height)
    return made


@pytest.mark.parametrize("form", ["txt", "raw", "zip", "npz", "h5", "hdf5"])
@pytest.mark.parametrize(("width", "height"), [(0, 0), (-40, -30), (65_535, 65_535), (0, 300), (5000, 5000)])
@pytest.mark.parametrize("use", [read_recording, lambda path: convert(path, path.with_name("out.h5"))])
def test_sensors_of_impossible_size_are_refused(
    tmp_path: Path, form: str, width: int, height: int, use: Callable[[Path], Any]
) -> None:
    with pytest.raises(UsageError, match=r"at most 16,777,216|cannot be decoded"):
        use(stated(tmp_path, form, width, height))
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("side", [0, -40, 65_535])
def test_an_evaluation_refuses_a_sensor_of_impossible_size(tmp_path: Path, side: int) -> None:
    with pytest.raises(UsageError, match=r"at most 16,777,216"):
        Recording(stated(tmp_path, "h5", side, side))


@pytest.mark.parametrize("text", ["0x0", "0x5", "65535x65535", "-40x-30", "99999999999999999999x1"])
def test_a_size_on_the_command_line_has_the_same_limits(text: str) -> None:
    with pytest.raises(UsageError, match=r"--size: .*at most 16,777,216|give WIDTHxHEIGHT"):
        SensorSize.parse(text)


def test_a_picture_of_a_huge_sensor_is_refused(tmp_path: Path) -> None:
    png = cv2.imencode(".png", np.zeros((4097, 4097), np.uint8))[1].tobytes()
    raw_forms.write_zip(tmp_path / "a.zip", {"events.txt": b"1 0 0 1\n", "images.txt": b"0.1 a.png\n", "a.png": png})
    with pytest.raises(UsageError, match=r"4097 x 4097 px.*at most 16,777,216"):
        read(tmp_path / "a.zip")


def test_a_folder_of_event_files_is_converted_for_an_evaluation(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    write_events(folder / "one.RAW", listed())
    write_events(folder / "two.h5", listed())
    write_events(tmp_path / "three.npz", listed())
    convert(tmp_path / "three.npz", folder / "three.h5")
    write_events(folder / "three.npz", listed())
    (folder / "README.txt").write_text("no events\n")
    (folder / "packed.gz").write_bytes(gzip.compress(b""))
    with in_layout(folder, ConvertOptions(), lambda _done, _total: None) as data:
        assert sorted(path.name for path in data.iterdir()) == ["one.h5", "three.h5", "two.h5"]
        assert {recognise(path) for path in data.iterdir()} == {"h5"}
    assert not data.exists()
    assert len(list(folder.iterdir())) == 6


def test_pictures_that_are_no_columns_are_refused(tmp_path: Path) -> None:
    members = raw_forms.evreal_members(scene())
    raw_forms.write_folder(tmp_path / "a", members | {"images.npy": members["images_ts.npy"]})
    with pytest.raises(UsageError, match=r"images.npy has 5 pictures, float64 \[\].*uint8 \[H, W\]"):
        read(tmp_path / "a")
    raw_forms.write_folder(tmp_path / "b", members | {"images.npy": members["images.npy"][:-100]})
    items = read(tmp_path / "b")
    assert notes(items) == "cut: 4 of 5 pictures are there"
    assert sum(isinstance(item, Picture) for item in items) == 4


def test_dsec_of_odd_offsets_cameras_and_columns(tmp_path: Path) -> None:
    """An offset above 2^32 us counts from the clock of the frames; a broken part is named, without a traceback."""
    raw_forms.write_dsec(tmp_path / "a", scene(), "right")
    events = tmp_path / "a/events/right/events.h5"
    later_us = 49_000_000_000
    with h5py.File(events, "a") as file:
        file["t_offset"][...] += later_us
    stamps = tmp_path / "a/images/timestamps.txt"
    stamps.write_bytes(b"".join(b"%d\r\n" % (t + later_us) for t in scene().picture_us))
    with pytest.raises(UsageError, match=r"holds 0 recordings of the left camera; --camera"):
        read(tmp_path / "a")
    items = read(tmp_path / "a", ConvertOptions(camera="right"))
    assert times_us(items)[0] == scene().t_us[0] + later_us
    assert sum(isinstance(item, Picture) for item in items) == 5
    for name, value, said in (
        ("events/p", h5py.Empty("u1"), "columns of t, x, y, p have 28, 28, 28, no entries"),
        ("events/p", None, "columns of t, x, y, p have 28, 28, 28, no entries"),
        ("t_offset", np.zeros(0, np.int64), "index 0 is out of bounds"),
    ):
        with h5py.File(events, "a") as file:
            del file[name]
            if value is None:
                file.create_group(name)
            else:
                file[name] = value
        with pytest.raises(UsageError, match=said):
            read(tmp_path / "a", ConvertOptions(camera="right"))


def test_evreal_as_others_save_it(tmp_path: Path) -> None:
    """Times of 1e9 s, xy in C order, polarities of -1 and 1, no metadata, nested, in capitals."""

    def saved(values: np.ndarray) -> bytes:
        stream = io.BytesIO()
        np.save(stream, values)
        return stream.getvalue()

    made = scene()
    members = raw_forms.evreal_members(made)
    del members["metadata.json"]
    members |= {
        "events_ts.npy": saved(made.t_us / 1e6 + 1e9),
        "events_xy.npy": saved(np.stack([made.x, made.y], axis=1).astype(np.uint16)),
        "events_p.npy": saved(np.where(made.p, 1, -1).astype(np.int8)),
        "images_ts.npy": saved(made.picture_us / 1e6 + 1e9),
    }
    raw_forms.write_folder(tmp_path / "a" / "Übung", {name.upper(): content for name, content in members.items()})
    items = read(tmp_path / "a")
    assert items[0] == SensorSize(WIDTH, HEIGHT)
    chunks = [item for item in items if isinstance(item, EventChunk)]
    np.testing.assert_array_equal(np.concatenate([chunk.x for chunk in chunks]), made.x)
    np.testing.assert_array_equal(np.concatenate([chunk.y for chunk in chunks]), made.y)
    np.testing.assert_array_equal(np.concatenate([chunk.p for chunk in chunks]), made.p)
    assert np.abs(np.array(times_us(items)) - 1e15 - made.t_us).max() <= 1
    for name, values, said in (
        ("events_xy", np.stack([made.x, made.y]), r"events_xy.npy is \[2, 28\]: save events_xy as \[N, 2\]"),
        ("events_p", np.array([None] * 28), "28 entries of float64, uint16, uint16, object"),
        ("images", np.asfortranarray(made.pictures), "images.npy is .* in Fortran order"),
    ):
        raw_forms.write_folder(tmp_path / name, members | {f"{name}.npy": saved(values)})
        with pytest.raises(UsageError, match=said):
            read(tmp_path / name)


def test_few_late_events_at_the_end_are_no_reset(tmp_path: Path) -> None:
    times = [*range(0, 100 * MS, MS), 50 * MS, 51 * MS]
    assert notes(passed(times, [30, 60])) == ""
    assert notes(passed([*times, *range(52 * MS, 62 * MS, MS)], [30, 60])).startswith(
        "at event 100 the times step back"
    )


def test_a_listing_of_windows_and_a_missing_filter(tmp_path: Path) -> None:
    members = raw_forms.ijrr_members(scene())
    listing = members["slow/images.txt"].replace(b"/", b"\\").replace(b"\n", b"\r\n")
    raw_forms.write_folder(tmp_path / "a", members | {"slow/images.txt": b"\xef\xbb\xbf" + listing})
    assert sum(isinstance(item, Picture) for item in read(tmp_path / "a")) == 5
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name in ("x", "y", "t", "p"):
            file.create_dataset(f"events/{name}", data=np.arange(9), chunks=(9,), compression="gzip")
    content = bytearray((tmp_path / "b.h5").read_bytes())
    while (at := content.find(b"deflate")) >= 0:
        struct.pack_into("<H", content, at - 8, 32_001)  # the number of Blosc
        content[at : at + 7] = b"another"
    (tmp_path / "b.h5").write_bytes(content)
    with pytest.raises(UsageError, match="filter may be in the package hdf5plugin"):
        read(tmp_path / "b.h5")
