"""Events in blocks: what was written is found again by its time, whatever the blocks are."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError, VideoError, VideoUnreadable
from v2v_server.recorded import blocks
from v2v_server.recorded.blocks import EventFile, EventFileWriter, PackedEvents


def written(path: Path, *parts: PackedEvents, height: int = 40, width: int = 50) -> Path:
    with path.open("wb") as file:
        writer = EventFileWriter(file)
        for part in parts:
            writer.add(part)
        writer.finish(height, width, "source")
    return path


@st.composite
def recordings(draw: st.DrawFn) -> list[PackedEvents]:
    """Return parts of a recording, with equal times, and gaps longer than a block can hold."""
    parts, last = [], draw(st.integers(-(10**15), 10**15))
    for _ in range(draw(st.integers(0, 4))):
        steps = draw(st.lists(st.sampled_from([0, 0, 1, 1000, 2**32 - 1, 2**32, 10**11]), max_size=12))
        times = last + np.cumsum(np.array(steps, np.int64))
        last = int(times[-1]) if len(times) else last
        of = [draw(st.lists(st.integers(0, most), min_size=len(steps), max_size=len(steps))) for most in (49, 39, 1)]
        parts.append(PackedEvents.of(times, *of))
    return parts


@settings(max_examples=60)
@given(parts=recordings(), block=st.integers(1, 9), data=st.data())
def test_events_are_found_by_time_and_the_times_of_every_n_th(
    parts: list[PackedEvents], block: int, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "MOST_BLOCK_EVENTS", block)
        path = written(tmp_path_factory.mktemp("events") / "a.v2ve", *parts)
        whole = PackedEvents.join([blocks.NO_EVENTS, *parts])
        times, count = whole.t_ns, len(whole.t_ns)
        moments = st.sampled_from([*times.tolist(), 0]).flatmap(lambda t: st.integers(t - 2, t + 2))
        with EventFile(path) as file:
            begin, end = sorted((data.draw(moments), data.draw(moments)))
            kept = (times >= begin) & (times < end)
            found = file.between(begin, end)
            assert np.array_equal(found.t_ns, times[kept])
            assert np.array_equal(found.packed, whole.packed[kept])
            every = data.draw(st.integers(1, 7))
            assert np.array_equal(file.times_of_every(every), times[::every])
            assert file.head.events == count


@given(parts=recordings())
def test_the_bytes_do_not_depend_on_the_parts(parts: list[PackedEvents]) -> None:
    made = []
    for given_parts in (parts, [PackedEvents.join([blocks.NO_EVENTS, *parts])]):
        file = io.BytesIO()
        writer = EventFileWriter(file)
        for part in given_parts:
            writer.add(part)
        writer.finish(40, 50, "source")
        made.append(file.getvalue())
    assert made[0] == made[1]


def test_pictures_and_flow_come_back_in_the_order_of_time(tmp_path: Path) -> None:
    path = tmp_path / "a.v2ve"
    rng = np.random.default_rng(1)
    pictures = rng.integers(0, 256, (3, 4, 6), np.uint8)
    flow = rng.normal(size=(2, 2, 4, 6)).astype(np.float32)
    flow[0, :, 1, 2] = np.nan
    with path.open("wb") as file:
        writer = EventFileWriter(file)
        for time, picture in zip((30, 10, 10), pictures, strict=True):
            writer.add_picture(time, picture)
        for time, field in zip((5, 6), flow, strict=True):
            writer.add_flow(time, field)
        writer.finish(4, 6, "", "linear", ("a note",))
    with EventFile(path) as events:
        assert events.pictures_table["t_ns"].tolist() == [10, 30], "of two pictures at one time the later one stays"
        assert np.array_equal(events.picture(0), pictures[2])
        assert np.array_equal(events.picture(1), pictures[0])
        assert np.array_equal(events.flow(0), flow[0], equal_nan=True)
        assert (events.head.light, events.head.notes, len(events.flows)) == ("linear", ("a note",), 2)


SOME = PackedEvents.of(np.arange(5000), np.arange(5000) % 50, np.arange(5000) % 40, np.arange(5000) % 3 == 0)


@settings(max_examples=100)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_changed_bit_is_an_error(place: float, bit: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    data = bytearray(written(folder / "a.v2ve", SOME).read_bytes())
    at = 8 + int(place * (len(data) - 8))  # the first 8 bytes are for people
    data[at] ^= 1 << bit
    (folder / "a.v2ve").write_bytes(data)
    with pytest.raises(VideoError, match="prepare the recording again"), EventFile(folder / "a.v2ve") as events:
        events.between(0, 5000)


@pytest.mark.parametrize("kept", [0, 5, 31, 100, -1])
def test_a_cut_file_is_an_error(kept: int, tmp_path: Path) -> None:
    path = written(tmp_path / "a.v2ve", SOME)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(VideoError, match="prepare the recording again"):
        EventFile(path)
    with pytest.raises(VideoUnreadable):
        EventFile(tmp_path / "none.v2ve")


@pytest.mark.parametrize(
    ("x", "y", "size", "words"),
    [(50, 0, (40, 50), "events reach 51x1 px"), (0, 40, (40, 50), "events reach 1x41 px")],
)
def test_events_outside_of_the_sensor_are_refused(x: int, y: int, size: tuple[int, int], words: str) -> None:
    writer = EventFileWriter(io.BytesIO())
    writer.add(PackedEvents.of([1], [x], [y], [1]))
    with pytest.raises(UsageError, match=words):
        writer.finish(*size, "")


def test_events_out_of_order_are_refused() -> None:
    writer = EventFileWriter(io.BytesIO())
    writer.add(SOME)
    with pytest.raises(UsageError, match="not in the order of time"):
        writer.add(SOME)
