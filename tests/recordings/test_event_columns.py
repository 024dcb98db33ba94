"""Test what the numbers of events mean, by rule: each reader with each way to write polarities, times, coordinates."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trainer.convert import raw_forms
from tests.trainer.convert.scene import HEIGHT, WIDTH, Scene
from trainer.convert import convert
from trainer.evaluation.readers import Recording
from v2v_protocol.errors import UsageError
from v2v_recordings.event_columns import EventColumns, Polarities, TimeUnit, clock_fault
from v2v_recordings.items import ConvertOptions, EventChunk, Note, SensorSize
from v2v_recordings.reading import read_items
from v2v_tools.fit.recording import read_recording

EVENTS = 4000
SIZE = SensorSize(WIDTH, HEIGHT)
Columns = dict[str, np.ndarray]


def columns(**changed: Any) -> Columns:
    """Return 4000 events in 1.2 s, times in us."""
    number = np.arange(EVENTS)
    return {"t": 300 * number, "x": number % WIDTH, "y": number % HEIGHT, "p": number % 3 > 0} | changed


def write_npz(path: Path, made: Columns) -> Path:
    np.savez(path / "a.npz", **made)
    return path / "a.npz"


def write_evreal(path: Path, made: Columns) -> Path:
    (path / "a").mkdir()
    xy = np.stack([made["x"], made["y"]], axis=1)
    for name, values in (("events_ts", made["t"]), ("events_xy", xy), ("events_p", made["p"])):
        np.save(path / "a" / f"{name}.npy", values)
    return path / "a"


def write_dsec(path: Path, made: Columns, **attributes: Any) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        for name, values in made.items():
            file[f"events/{name}"] = values
        file["events/t"].attrs.update(attributes)
    return path / "a.h5"


def write_layout(path: Path, made: Columns, **attributes: Any) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        for name, values in made.items():
            file[f"events/{name}s"] = values
        file["events/ts"].attrs.update(attributes)
        file.attrs["sensor_resolution"] = (HEIGHT, WIDTH)
    return path / "a.h5"


def write_mvsec(path: Path, made: Columns, **attributes: Any) -> Path:
    with h5py.File(path / "a_data.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([np.asarray(made[name], np.float64) for name in "xytp"], axis=1)
        file["davis/left/events"].attrs.update(attributes)
    return path / "a_data.hdf5"


def write_text(path: Path, made: Columns) -> Path:
    rows = zip(*(made[name].tolist() for name in "txyp"), strict=True)
    (path / "a.txt").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    return path / "a.txt"


WRITERS: dict[str, tuple[Callable[..., Path], str]] = {
    "npz": (write_npz, "us"),
    "evreal": (write_evreal, "us"),
    "dsec": (write_dsec, "us"),
    "layout": (write_layout, "s"),
    "mvsec": (write_mvsec, "s"),
    "text": (write_text, "us"),
}
"""How each form is written, and the unit in which its readers take whole numbers."""
UNITS_PER_US = {"s": 1e-6, "ms": 1e-3, "us": 1, "ns": 1000}
IS_TRUE = columns()["p"]
POLARITIES = {
    "0 and 1": IS_TRUE.astype(np.uint8),
    "0.0 and 1.0": IS_TRUE.astype(np.float32),
    "-1 and 1": np.where(IS_TRUE, 1, -1).astype(np.int8),
    "-1.0 and 1.0": np.where(IS_TRUE, 1.0, -1.0),
    "false and true": IS_TRUE,
    "-1 without a sign": np.where(IS_TRUE, 1, -1).astype(np.int8).view(np.uint8),
    "-1 without a sign, of 16 bits": np.where(IS_TRUE, 1, -1).astype(np.int16).view(np.uint16),
    "1 and 2": IS_TRUE + 1,
}
UNKNOWN = {
    "0 and 255": (255 * IS_TRUE, "polarities are 0, 255; they must be 0 and 1"),
    "-1 and 0": (IS_TRUE - 1, "polarities are -1, 0;"),
    "-1, 0 and 1": (np.arange(EVENTS) % 3 - 1, "polarities are -1, 0, 1;"),
    "0 to 3": (np.arange(EVENTS) % 4, "polarities are 0, 1, 2, 3;"),
    "halves": (0.5 * IS_TRUE, "polarities are 0, 0.5;"),
    "an odd one": (np.where(np.arange(EVENTS) == EVENTS - 1, 7, IS_TRUE), "polarities are 0, 1, 7;"),
    "one sign of two codes": (np.full(EVENTS, 255), "polarities are 255;"),
    "times": (np.arange(EVENTS), r"polarities are 0, 1, 2, 3, 4, 5 ... \(4000 numbers\);"),
}


@pytest.fixture(params=WRITERS)
def form(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def written(path: Path, form: str, unit: str = "", **changed: Any) -> Path:
    """Write the events in a form; times in its own unit, or in another one."""
    write, own = WRITERS[form]
    made = columns(**changed)
    if "t" not in changed:
        made["t"] = made["t"] * UNITS_PER_US[unit or own]
    return write(path, made)


def read(path: Path, time_unit: str | None = None) -> tuple[EventChunk, list[str]]:
    """Return all events of a recording, and the notes."""
    items = list(read_items(path, None, ConvertOptions(size=SIZE, time_unit=time_unit)))
    chunks = [item for item in items if isinstance(item, EventChunk)]
    parts = ([getattr(chunk, name) for chunk in chunks] for name in ("t_ns", "x", "y", "p"))
    return EventChunk(*map(np.concatenate, parts)), [item.text for item in items if isinstance(item, Note)]


def seconds(events: EventChunk) -> float:
    return float(events.t_ns[-1] - events.t_ns[0]) * 1e-9


@pytest.mark.parametrize("kind", POLARITIES)
def test_polarities_of_every_form_are_read(tmp_path: Path, form: str, kind: str) -> None:
    events, notes = read(written(tmp_path, form, p=POLARITIES[kind]))
    np.testing.assert_array_equal(events.p, IS_TRUE)
    assert seconds(events) == pytest.approx(1.1997)
    has_second_meaning = kind.startswith(("-1 without", "1 and 2"))
    assert [note.startswith("polarities are ") for note in notes] == [True] * has_second_meaning


@pytest.mark.parametrize("kind", UNKNOWN)
def test_polarities_without_a_meaning_are_refused_by_every_form(tmp_path: Path, form: str, kind: str) -> None:
    polarities, said = UNKNOWN[kind]
    with pytest.raises(UsageError, match=said):
        read(written(tmp_path, form, p=polarities))


@pytest.mark.parametrize("word", ["True False", "true false", "TRUE FALSE"])
def test_polarities_of_texts_may_be_words(tmp_path: Path, word: str) -> None:
    true, false = word.split()
    events, _ = read(written(tmp_path, "text", p=np.where(IS_TRUE, true, false)))
    np.testing.assert_array_equal(events.p, IS_TRUE)


@given(st.lists(st.lists(st.sampled_from([-1, 0, 1, 2, 255]), max_size=4), max_size=6))
@settings(max_examples=200, deadline=None)
def test_parts_are_read_by_one_code(parts: list[list[int]]) -> None:
    """Whatever the parts: the same answer as for the whole column, or a refusal."""
    by_part, whole = Polarities(), Polarities()
    try:
        found = [by_part.are_brighter(np.array(part), "a").tolist() for part in parts]
    except UsageError:
        return
    everything = np.array([value for part in parts for value in part])
    assert [each for part in found for each in part] == whole.are_brighter(everything, "a").tolist()
    assert by_part.meaning == whole.meaning


@pytest.mark.parametrize("unit", UNITS_PER_US)
@pytest.mark.parametrize("dtype", [np.int64, np.float64])
def test_times_of_another_unit_are_refused_and_read_as_stated(tmp_path: Path, form: str, unit: str, dtype: Any) -> None:
    times = (columns()["t"] * UNITS_PER_US[unit]).astype(dtype)
    has_points = dtype is np.float64 and form in ("npz", "evreal", "text")
    path, own = written(tmp_path, form, t=times), "s" if has_points else WRITERS[form][1]
    if unit == own:
        assert seconds(read(path)[0]) == pytest.approx(float(times[-1]) / UNITS_PER_US[own] * 1e-6)
    else:
        with pytest.raises(
            UsageError, match=rf"if their times are in {own}, are not of a camera.*--time-unit {unit}\."
        ):
            read(path)
    assert seconds(read(path, unit)[0]) == pytest.approx(float(times[-1]) / UNITS_PER_US[unit] * 1e-6)


@pytest.mark.parametrize("name", ["dsec", "layout", "mvsec"])
@pytest.mark.parametrize(
    ("words", "unit"),
    [("s", "s"), ("seconds", "s"), (b"milliseconds", "ms"), ("µs", "us"), ("Microseconds", "us"), ("nsec", "ns")],
)
def test_an_attribute_states_the_unit(tmp_path: Path, name: str, words: Any, unit: str) -> None:
    write, _ = WRITERS[name]
    made = columns()
    path = write(tmp_path, made | {"t": made["t"] * UNITS_PER_US[unit]}, units=words)
    assert seconds(read(path)[0]) == pytest.approx(1.1997)
    if name == "layout" and unit != "s":
        with pytest.raises(UsageError, match=rf"times are in {unit}: convert it with v2v-convert"):
            Recording(path)
    with pytest.raises(UsageError, match="times in 'ticks': give one of s, ms, us, ns with --time-unit"):
        read(write(tmp_path, made, units="ticks"))


@pytest.mark.parametrize(
    ("count", "seconds", "unit", "is_stated", "likely"),
    [
        (1000, 0.0, "us", False, None),
        (1001, 0.0, "us", False, ""),
        (1001, 0.9e-3, "us", True, "ms"),
        (1001, 1.1e-3, "us", True, None),
        (10**6, 1e5, "s", True, "ms"),
        (10**6, 8e4, "s", True, None),
        (10**6, 8e4, "s", False, "ms"),
        (10**9, 3600.0, "us", False, None),
        (10**5, 3e-3, "us", False, "ms"),
        (5000, 3e-3, "us", False, None),
        (10**6, 50e-3, "us", False, None),
        (10**4, 99.0, "us", False, None),
        (10**4, 101.0, "us", False, "ns"),
        (5000, float("nan"), "s", False, ""),
    ],
)
def test_limits_of_a_recording(count: int, seconds: float, unit: str, is_stated: bool, likely: str | None) -> None:
    if likely is None:
        TimeUnit(unit, is_stated=is_stated).check(count, seconds, "a")
        return
    with pytest.raises(UsageError, match=rf"a: {count} events in .*{f'--time-unit {likely}' if likely else ''}"):
        TimeUnit(unit, is_stated=is_stated).check(count, seconds, "a")
    TimeUnit(unit, is_given=True).check(count, seconds, "a")


@pytest.mark.parametrize(("per_us", "unit", "is_said"), [(1, "us", False), (10, "us", True), (1000, "ns", False)])
def test_a_guess_that_gives_few_events_is_said(tmp_path: Path, per_us: int, unit: str, is_said: bool) -> None:
    path = write_npz(tmp_path, columns(t=columns()["t"] * per_us))
    _, notes = read(path, time_unit=None if unit == "us" else unit)
    assert any("times are taken for us, 333" in note and "--time-unit" in note for note in notes) == is_said
    assert not read(path, time_unit=unit)[1]


def test_a_file_of_this_project_states_its_unit(tmp_path: Path) -> None:
    """A burst of 1.2 ms may be one in ms; in what v2v-convert wrote it is certain."""
    path = written(tmp_path, "text", t=columns()["t"] // 1000)
    with pytest.raises(UsageError, match=r"4000 events in 0.001199 s.*--time-unit ms"):
        read(path)
    convert(path, tmp_path / "b.h5", options=ConvertOptions(size=SIZE, time_unit="us"))
    assert seconds(read(tmp_path / "b.h5")[0]) == pytest.approx(0.001199)
    with Recording(tmp_path / "b.h5") as recording:
        assert len(recording) == EVENTS


@pytest.mark.parametrize("dtype", [np.uint32, np.int32])
def test_times_of_32_bits_go_on_after_they_wrap(dtype: Any) -> None:
    """Also where events are late at the wrap, and whatever the parts."""
    true = (1 << 32) - 5000 + np.array([0, 4000, 4990, 5010, 4995, 5020, 9000, (1 << 32) + 10_000])
    stored = true.astype(np.uint32).view(dtype)
    for edge in range(len(true) + 1):
        read, zeros = EventColumns("a", TimeUnit("us")), np.zeros(len(true), np.int64)
        parts = (slice(0, edge), slice(edge, None))
        got = np.concatenate([read.part(stored[p], zeros[p], zeros[p], zeros[p]).t_ns for p in parts]) // 1000
        if edge < 7:
            np.testing.assert_array_equal(np.diff(got[:7]), np.diff(true[:7]))


@pytest.mark.parametrize("times", [np.arange(EVENTS)[::-1] * 1000, np.random.default_rng(0).permutation(EVENTS) * 1000])
def test_times_in_no_order_are_refused(tmp_path: Path, times: np.ndarray) -> None:
    with pytest.raises(UsageError, match=r"not in the order of time.*sort it, or give --time-unit"):
        read(write_npz(tmp_path, columns(t=times)))


@pytest.mark.parametrize(
    ("x", "said"),
    [
        (np.arange(EVENTS) % WIDTH - 5, "x of event 0 is -5.*columns in another order"),
        (np.arange(EVENTS) % 1000 + 65_000, "x of event 536 is 65536"),
        (np.arange(EVENTS) % WIDTH + 0.5, r"x of event 0 is 0\.5: coordinates must be integers|is not `t x y p`"),
    ],
    ids=["negative", "too large", "half"],
)
def test_impossible_coordinates_are_refused_by_every_form(tmp_path: Path, form: str, x: np.ndarray, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read(written(tmp_path, form, x=x))


def test_whole_floats_are_coordinates(tmp_path: Path, form: str) -> None:
    events, _ = read(written(tmp_path, form, x=columns()["x"].astype(np.float32)))
    np.testing.assert_array_equal(events.x, columns()["x"])


@pytest.mark.parametrize("order", ["xytp", "xypt", "ptxy", "txpy", "tpxy", "pxyt"])
def test_texts_in_another_order_are_refused(tmp_path: Path, order: str) -> None:
    made = columns(t=columns()["t"] + 0.25) | {"p": IS_TRUE.astype(int)}
    rows = zip(*(made[name].tolist() for name in order), strict=True)
    (tmp_path / "a.txt").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    with pytest.raises(UsageError, match=r"polarities are|is not `t x y p`|coordinates must be|are not of a camera"):
        read(tmp_path / "a.txt")


@pytest.mark.parametrize("offset", [np.int64(2**63 - 1), np.int64(-(2**63)), np.uint64(2**64 - 1), np.float64("nan")])
def test_offsets_out_of_range_are_refused(tmp_path: Path, offset: Any) -> None:
    path = write_dsec(tmp_path, columns())
    with h5py.File(path, "a") as file:
        file["t_offset"] = offset
    with pytest.raises(UsageError, match=r"are added to it, which is out of range|cannot convert float NaN"):
        read(path)


# Pictures beside the events, from 0 to 1.2 s: (times, s; what is said, "" if they are taken).
CLOCKS = {
    "the same": ([0.1, 0.9, 1.7], ""),
    "one before and after": ([-0.5, 0.9, 2.0], ""),
    "one picture": ([0.5], ""),
    "hours later": ([7200.1, 7200.9, 7201.7], r"--frame-offset -7200100\.000"),
    "since 1970": ([1.7e9, 1.7e9 + 1], "--frame-offset -1700000000000"),
    "from the camera's start": ([4.1, 4.9, 5.7], r"--frame-offset -4100\.000"),
    "from the last event on": ([1.3, 2.1, 2.9], r"--frame-offset -1300\.000"),
    "up to the first event": ([-1.7, -0.9, -0.1], r"--frame-offset 1700\.000"),
    "microseconds": ([1e5, 9e5, 17e5], "in different units"),
    "milliseconds from the first": ([0.0, 800.0, 1600.0], "in different units"),
    "too dense": ([1e-7, 9e-7, 17e-7], "in different units"),
}


@pytest.mark.parametrize("case", CLOCKS)
def test_pictures_on_another_clock_are_refused(tmp_path: Path, case: str) -> None:
    """By convert, fit and eval alike, in the same words."""
    times, said = CLOCKS[case]
    pixels = np.zeros((HEIGHT, WIDTH), np.uint8)
    made = columns()
    lines = zip(
        *((made[name] * scale).tolist() for name, scale in zip("txyp", (1e-6, 1, 1, 1), strict=True)), strict=True
    )
    members = {"events.txt": "".join("{:.6f} {} {} {}\n".format(*line) for line in lines).encode()}
    members["images.txt"] = "".join(f"{time!r} {number}.png\n" for number, time in enumerate(times)).encode()
    raw_forms.write_folder(tmp_path / "a", members | {f"{n}.png": raw_forms.png(pixels) for n in range(len(times))})
    path = write_layout(tmp_path, made | {"t": made["t"] * 1e-6})
    with h5py.File(path, "a") as file:
        for number, time in enumerate(times):
            file[f"images/{number}"] = pixels
            file[f"images/{number}"].attrs.update(timestamp=time, event_idx=0)
    uses: list[Callable[[], Any]] = [
        lambda: convert(tmp_path / "a", tmp_path / "out.h5"),
        lambda: convert(path, tmp_path / "out.h5", overwrite=True),
        lambda: read_recording(tmp_path / "a"),
        lambda: Recording(path).__exit__(),
    ]
    for use in uses:
        if said:
            with pytest.raises(UsageError, match=rf"{len(times)} pictures are from .*different clocks, .*{said}"):
                use()
        else:
            use()
    if "--frame-offset" in said:
        first, _, last = said.removeprefix("--frame-offset ").replace("\\", "").partition("x")
        options = ConvertOptions(frame_offset_ns=round(float(first) * 1e6))
        assert convert(tmp_path / "a", tmp_path / "b.h5", options=options).written.images == len(times), last


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=9), st.floats(0, 100))
@settings(deadline=None)
def test_pictures_among_the_events_are_on_their_clock(times: list[float], first: float) -> None:
    begin, end = min(times), max(times)
    is_dense = len(times) > 2 and end - begin < 60e-6 * len(times)
    assert is_dense or clock_fault(times, begin - first, end + first) == ""


def sized(write: Callable[[h5py.File], Any]) -> Callable[[Path], Path]:
    """Return a function that writes events in the layout, and something more."""

    def make(path: Path) -> Path:
        made = columns()
        file = write_layout(path, made | {"t": made["t"] * 1e-6})
        with h5py.File(file, "a") as opened:
            write(opened)
        return file

    return make


def claimed(file: h5py.File, name: str, shape: tuple[int, ...], chunk: int = 64, **attributes: Any) -> None:
    if name in file:
        del file[name]
    made = file.create_dataset(name, shape, "u1", chunks=tuple(min(chunk, side) for side in shape))
    made.attrs.update(attributes)


def large_chunk(file: h5py.File) -> None:
    file["padding"] = np.zeros(9 << 20, np.uint8)
    claimed(file, "events/ps", ((2 << 30) - 1,), 1 << 30)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda file: claimed(file, "events/ps", (10**12,)), "ps is stated to be 1,000,000,000,000 bytes"),
        (large_chunk, "ps: a chunk is stated to be 1,073,741,824 bytes, and at most 536,870,912"),
        (lambda file: claimed(file, "images/a", (1 << 20, 1 << 20), timestamp=0.5, event_idx=9), "a is stated to be"),
        (
            lambda file: claimed(file, "images/a", (4097, 4096), 4096, timestamp=0.5, event_idx=9),
            "a sensor of 4096 x 4097",
        ),
        (lambda file: claimed(file, "sensor_resolution", (1 << 40,)), "sensor_resolution is stated to be"),
        (lambda file: claimed(file, "images/a", (5, 5), event_idx=-3), "event_idx is -3, and there are 4000 events"),
        (lambda file: claimed(file, "images/a", (5, 5), event_idx=4001), "event_idx is 4001"),
    ],
    ids=["events", "chunk", "picture", "wide picture", "size", "negative index", "large index"],
)
def test_what_a_file_claims_has_limits(tmp_path: Path, write: Callable[[h5py.File], Any], said: str) -> None:
    path = sized(write)(tmp_path)
    for use in (read, lambda path: Recording(path).__exit__()):
        with pytest.raises(UsageError, match=said):
            use(path)


def test_what_a_file_of_numpy_claims_has_limits(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name, values in columns().items():
            stream = io.BytesIO()
            np.save(stream, values)
            claim = stream.getvalue().replace(b"(4000,), } ", b"(200000000,), } ").replace(b"     \n", b"\n", 1)
            archive.writestr(f"{name}.npy", claim)
    with pytest.raises(UsageError, match=r"t.npy is stated to be 1,600,000,000 bytes, and at most"):
        read(tmp_path / "a.npz")


def test_a_zip_bomb_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", b"0.5 1 1 1\n" * 2_000_000)
    with pytest.raises(UsageError, match=r"events.txt is stated to be 20,000,000 bytes, and at most 16,777,216"):
        read(tmp_path / "a.zip")


@pytest.mark.parametrize("side", [1 << 20, 30_000, 5000])
def test_pictures_that_claim_to_be_huge_are_refused(tmp_path: Path, side: int) -> None:
    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(bytes(99))) + part(b"IEND", b"")
    raw_forms.write_folder(tmp_path / "a", {"events.txt": b"1 0 0 1\n", "images.txt": b"0.1 a.png\n", "a.png": png})
    with pytest.raises(UsageError, match=r"a.png( is not a readable picture|: a sensor of 5000 x 5000 px)"):
        read(tmp_path / "a")


def test_forms_of_one_meaning_are_read_by_the_same_functions(tmp_path: Path) -> None:
    """A bag or a stream of words whose events all have one time is refused too."""
    number = np.arange(EVENTS)
    same = Scene(number * 0 + 5, number % WIDTH, number % HEIGHT, IS_TRUE, np.zeros((0, 1, 1), np.uint8), number[:0])
    raw_forms.write_bag(tmp_path / "a.bag", same)
    raw_forms.write_evt2(tmp_path / "a.raw", same)
    for path in (tmp_path / "a.bag", tmp_path / "a.raw"):
        with pytest.raises(UsageError, match="4000 events in 0 s"):
            read(path)
