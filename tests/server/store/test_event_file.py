"""Events in blocks: what was written is found again by its time, whatever the blocks are."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import pytest
import xxhash
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError, VideoError, VideoUnreadable
from v2v_recordings import block_file, item_writer
from v2v_recordings.binning import NEVER, EventsOfCrop
from v2v_recordings.block_file import TABLE, TAIL, EventFileWriter
from v2v_recordings.items import NO_EVENTS, EventChunk, FlowField, Light, Note, Picture, SensorSize
from v2v_server.store import event_file
from v2v_server.store.event_file import EventFile


def written(path: Path, *parts: EventChunk) -> Path:
    with EventFileWriter(path, source="a", fingerprint="source", origin_ns=0) as writer:
        for item in (SensorSize(50, 40), *parts):
            writer.add(item)
    return path


def events_of(t_ns: npt.ArrayLike, *columns: npt.ArrayLike) -> EventChunk:
    x, y, p = map(np.asarray, columns)
    return EventChunk(np.asarray(t_ns, np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(bool))


WHOLE = 0, 0, 40, 50


def columns(found: EventsOfCrop, width: int = 50) -> list[list[int]]:
    return [each.tolist() for each in (found.t_ns, found.pixel % width, found.pixel // width, found.brighter)]


@st.composite
def recordings(draw: st.DrawFn) -> list[EventChunk]:
    """Return parts of a recording, with equal times, and gaps longer than a block can hold."""
    parts, last = [], draw(st.integers(-(10**15), 10**15))
    for _ in range(draw(st.integers(0, 4))):
        steps = draw(st.lists(st.sampled_from([0, 0, 1, 1000, 2**32 - 1, 2**32, 10**11]), max_size=12))
        times = last + np.cumsum(np.array(steps, np.int64))
        last = int(times[-1]) if len(times) else last
        of = [draw(st.lists(st.integers(0, most), min_size=len(steps), max_size=len(steps))) for most in (49, 39, 1)]
        parts.append(events_of(times, *of))
    return parts


@settings(max_examples=60)
@given(parts=recordings(), block=st.integers(1, 9), flush=st.integers(1, 9), data=st.data())
def test_events_are_found_by_time_and_the_times_of_every_n_th(
    parts: list[EventChunk], block: int, flush: int, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_file, "MOST_BLOCK_EVENTS", block)
        patch.setattr(item_writer, "FLUSH_EVENTS", flush)
        patch.setattr(item_writer, "REORDER_EVENTS", 1)
        path = written(tmp_path_factory.mktemp("events") / "a.v2ve", *parts)
        whole = EventChunk.join([NO_EVENTS, *parts])
        moments = st.sampled_from([*whole.t_ns.tolist(), 0]).flatmap(lambda t: st.integers(t - 2, t + 2))
        with EventFile(path) as file:
            edges = np.sort(np.array(data.draw(st.lists(moments, min_size=2, max_size=5))))
            height, width = data.draw(st.integers(1, 40)), data.draw(st.integers(1, 50))
            top, left = data.draw(st.integers(0, 40 - height)), data.draw(st.integers(0, 50 - width))
            flip = data.draw(st.booleans())
            found = file.between(edges, (top, left, height, width), flip)
            for (first, last), (begin, end) in zip(found.span_ns.tolist(), pairwise(edges), strict=True):
                of_grid = whole.t_ns[(whole.t_ns >= begin) & (whole.t_ns < end)].tolist()
                assert (first, last) == ((of_grid[0], of_grid[-1]) if of_grid else (NEVER, NEVER))
            x, y = whole.x.astype(int) - left, whole.y.astype(int) - top
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            shown = np.flatnonzero(inside & (whole.t_ns >= edges[0]) & (whole.t_ns < edges[-1]))
            x = width - 1 - x if flip else x
            assert columns(found, width) == [each[shown].tolist() for each in (whole.t_ns, x, y, whole.p)]
            every, most = data.draw(st.integers(1, 7)), data.draw(st.integers(1, 60))
            assert np.array_equal(file.times_of_every(every, most), whole.t_ns[::every][:most])
            assert file.head.events == len(whole)


@given(parts=recordings())
def test_the_bytes_do_not_depend_on_the_parts(
    parts: list[EventChunk], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("events")
    one = written(folder / "a.v2ve", *parts).read_bytes()
    assert written(folder / "b.v2ve", EventChunk.join([NO_EVENTS, *parts])).read_bytes() == one


def test_pictures_and_flow_come_back_in_the_order_of_time(tmp_path: Path) -> None:
    path = tmp_path / "a.v2ve"
    rng = np.random.default_rng(1)
    pictures = rng.integers(0, 256, (3, 4, 6), np.uint8)
    flow = rng.normal(size=(2, 2, 4, 6)).astype(np.float32)
    flow[0, :, 1, 2] = np.nan
    with EventFileWriter(path, source="a", fingerprint="", origin_ns=0) as writer:
        for time, picture in zip((30, 10, 10), pictures, strict=True):
            writer.add(Picture(time, picture))
        for time, field in zip((5, 6), flow, strict=True):
            writer.add(FlowField(time, field))
        writer.add(Light.parse("linear"))
        writer.add(Note("a note"))
    with EventFile(path) as events:
        assert events.pictures_table["t_ns"].tolist() == [10, 30], "of two pictures at one time the later one stays"
        assert np.array_equal(events.picture(0), pictures[2])
        assert np.array_equal(events.picture(1), pictures[0])
        assert np.array_equal(events.flow(0), flow[0], equal_nan=True)
        assert (events.head.light, events.head.notes, len(events.flows)) == ("linear", ("a note",), 2)


def test_more_events_than_a_sample_may_take_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_file, "MOST_SAMPLE_EVENTS", 4999)
    words = "a sample takes 5,000 events; at most 4,999: give closer marks"
    with EventFile(written(tmp_path / "a.v2ve", SOME)) as events, pytest.raises(VideoError, match=words):
        events.between(np.array([0, 5000]), WHOLE)


SOME = events_of(np.arange(5000), np.arange(5000) % 50, np.arange(5000) % 40, np.arange(5000) % 3 == 0)


@settings(max_examples=100)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_changed_bit_is_an_error(place: float, bit: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    data = bytearray(written(folder / "a.v2ve", SOME).read_bytes())
    at = 8 + int(place * (len(data) - 8))  # the first 8 bytes are for people
    data[at] ^= 1 << bit
    (folder / "a.v2ve").write_bytes(data)
    with pytest.raises(VideoError, match="prepare the recording again"), EventFile(folder / "a.v2ve") as events:
        events.between(np.array([0, 5000]), WHOLE)


@pytest.mark.parametrize("kept", [0, 5, 31, 100, -1])
def test_a_cut_file_is_an_error(kept: int, tmp_path: Path) -> None:
    path = written(tmp_path / "a.v2ve", SOME)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(VideoError, match="prepare the recording again"):
        EventFile(path)
    with pytest.raises(VideoUnreadable):
        EventFile(tmp_path / "none.v2ve")


def forged(path: Path, change: Callable[[dict[str, Any]], None], packed: bytes = b"") -> Path:
    """Write an intact file whose head, or whose first block, states something else, with the hashes of that."""
    pack, folder = zstandard.ZstdCompressor().compress, path.parent
    data = written(folder / "honest.v2ve", SOME).read_bytes()
    place, size, _, _, magic = TAIL.unpack(data[-TAIL.size :])
    head = msgpack.unpackb(zstandard.ZstdDecompressor().decompress(data[place : place + size]))
    change(head)
    body = data[:place]
    if packed:
        table = np.frombuffer(head["blocks"], TABLE).copy()
        table["place"], table["bytes"], table["check"] = len(body), len(packed), xxhash.xxh3_64_intdigest(packed)
        head["blocks"], body = table.tobytes(), body + packed
    raw = msgpack.packb(head)
    head_packed = pack(raw)
    tail = TAIL.pack(len(body), len(head_packed), xxhash.xxh3_64_intdigest(head_packed), len(raw), magic)
    path.write_bytes(body + head_packed + tail)
    return path


def _table(**values: int) -> Callable[[dict[str, Any]], None]:
    def change(head: dict[str, Any]) -> None:
        table = np.frombuffer(head["blocks"], TABLE).copy()
        for name, value in values.items():
            table[name] = value
        head["blocks"] = table.tobytes()

    return change


@pytest.mark.parametrize(
    ("change", "packed", "words"),
    [
        (_table(), zstandard.ZstdCompressor().compress(bytes(1 << 28)), "claims 268435456 bytes instead of 40000"),
        (_table(bytes=1 << 50), b"", "shorter than it says"),
        (_table(place=-5), b"", "shorter than it says"),
        (lambda head: head.update(events=10**12), b"", "its blocks do not follow each other"),
        (lambda head: head.update(width_px=1 << 20), b"", "its head is damaged"),
        (lambda head: head.update(blocks=head["blocks"][:-1]), b"", "its head is damaged"),
    ],
)
def test_a_forged_file_is_refused_without_the_memory_it_claims(
    change: Callable[[dict[str, Any]], None], packed: bytes, words: str, tmp_path: Path
) -> None:
    path = forged(tmp_path / "a.v2ve", change, packed)
    tracemalloc.start()
    try:
        with pytest.raises(VideoError, match=words), EventFile(path) as events:
            events.between(np.array([0, 5000]), WHOLE)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("x", "y", "words"), [(50, 0, "events reach x = 50, y = 0"), (0, 40, "x = 0, y = 40")])
def test_events_outside_of_the_sensor_are_refused(x: int, y: int, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        written(tmp_path / "a.v2ve", events_of([1], [x], [y], [1]))
    assert not list(tmp_path.iterdir())
