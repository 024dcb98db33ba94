"""EVT 3 is decoded as a slow decoder does word by word; what is written is read back, by others too; odd files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_protocol.errors import UsageError
from v2v_recordings import evt3
from v2v_recordings.evt3 import Decoder, Encoder, header_of
from v2v_recordings.items import ConvertOptions, EventChunk, Item, Note, SensorSize
from v2v_recordings.reading import read_items

HEAD = b"% evt 3.0\n% geometry 300x200\n% end\n"
Event = tuple[int, int, int, bool]


def slow(words: Sequence[int]) -> list[Event]:
    """Decode word by word: (t_us, x, y, p) of each event."""
    events: list[Event] = []
    t_us = high = row = column = camera = None
    polarity = 0
    for word in words:
        kind, bits = word >> 12, word & 0xFFF
        if kind == 0x8:
            step = 0 if high is None else bits - high % 4096
            if step < -2 and step + 4096 <= 1024:  # the next round
                step += 4096
            if step >= 4094:  # late, of the round before
                step -= 4096
            now = bits if high is None else high + step
            if now != high:
                high, t_us = now, now << 12
        elif kind == 0x6 and high is not None:
            t_us = high << 12 | bits
        elif kind in (0x0, 0x1):
            if kind == 0 and camera is None:
                camera = bits >> 11
            row = bits & 0x7FF if kind == 0 and bits >> 11 == camera else None
        elif kind == 0x3:
            column, polarity = bits & 0x7FF, bits >> 11
        elif kind == 0x2 and t_us is not None and row is not None:
            events.append((t_us, bits & 0x7FF, row, bool(bits >> 11)))
        elif kind in (0x4, 0x5) and column is not None:
            length = 12 if kind == 0x4 else 8
            if t_us is not None and row is not None:
                events += [(t_us, column + i, row, bool(polarity)) for i in range(length) if bits >> i & 1]
            column += length
    return events


def listed(chunk: EventChunk) -> list[Event]:
    return list(zip((chunk.t_ns // 1000).tolist(), chunk.x.tolist(), chunk.y.tolist(), chunk.p.tolist(), strict=True))


def decoded(words: Sequence[int], lengths: Sequence[int] = ()) -> list[Event]:
    """Decode in blocks of these lengths, and the rest at once."""
    decoder, parts = Decoder(), np.split(np.array(words, evt3.WORD), np.cumsum(lengths, dtype=int))
    return [event for part in parts for event in listed(decoder.decode(part))]


payloads = st.one_of(st.sampled_from([0, 1, 2, 5, 0x7FF, 0x800, 0x801, 1030, 3071, 4093, 4095]), st.integers(0, 0xFFF))
kinds = st.sampled_from([0, 0, 1, 2, 2, 3, 3, 4, 4, 5, 6, 6, 7, 8, 8, 0xA, 0xE, 0xF])
any_words = st.lists(st.builds(lambda kind, bits: kind << 12 | bits, kinds, payloads), max_size=150)
lengths = st.lists(st.integers(0, 40), max_size=6)


@settings(max_examples=300, deadline=None)
@given(words=any_words, lengths=lengths)
def test_any_words_are_decoded_as_word_by_word(words: list[int], lengths: list[int]) -> None:
    assert decoded(words, lengths) == slow(words)


@pytest.mark.parametrize(
    ("words", "times_us"),
    [
        ([0x8FFF, 0x6005, 3, 0x2001, 0x8001, 0x6001, 0x2001], [16773125, 16781313]),  # round without a word of 5 ms
        ([0x8FFF, 0x6005, 3, 0x2001, 0x83FF, 0x2001], [16773125, (4096 + 1023) << 12]),  # quiet for a quarter of it
        ([0x8000, 0x6005, 3, 0x2001, 0x8FFF, 0x6002, 0x2001], [5, -4094]),  # late, of the round before
        ([0x8064, 0x6005, 3, 0x2001, 0x8062, 0x2001], [409605, 401408]),  # late
        (
            [0x8900, 0x6005, 3, 0x2001, 0x8800, 0x2001],
            [9437189, 8388608],
        ),  # reset: too far back for late or for a round
        ([0x8001, 0x6005, 3, 0x8001, 0x2001, 0x8002, 0x2001], [4101, 8192]),  # repeated upper bits keep the lower ones
        ([0x8001, 0x6005, 3, 0x2001, 0x6003, 0x2001], [4101, 4099]),  # lower bits step back
        ([3, 0x6005, 0x2001, 0x3001, 0x4FFF, 0x8001, 0x2001], [4096]),  # from the middle of a stream
        ([0x8001, 0x2001, 0x3001, 0x4FFF, 3, 0x2001], [4096]),  # no row yet
        ([0x8001, 3, 0x4FFF, 0x5FFF, 0x3001, 0x4001], [4096]),  # no column yet
        ([0x8001, 3, 0x1004, 0x2001, 0x3001, 0x4FFF, 4, 0x2001], [4096]),  # grey levels
        ([0x8001, 3, 0xA101, 0xE014, 0xF123, 0xF456, 0x7007, 0x2001], [4096]),  # trigger, counter and their words
        ([0x8001, 0x803, 0x2001, 3, 0x2001, 0x3001, 0x4FFF, 0x803, 0x2001], [4096] * 2),  # the camera of the first row
    ],
)
def test_times_and_what_has_none(words: list[int], times_us: list[int]) -> None:
    assert [t for t, *_ in slow(words)] == times_us
    assert decoded(words) == slow(words)
    assert decoded(words, [1] * len(words)) == slow(words)


@settings(max_examples=60, deadline=None)
@given(gaps=st.lists(st.integers(0, 4_100_000), min_size=1, max_size=60))
def test_times_are_right_for_minutes_with_words_at_events_only(gaps: list[int]) -> None:
    times = np.cumsum(gaps).tolist()
    words = [each for t in times for each in (0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, 7, 0x2009)]
    first = times[0] - times[0] % (1 << 24)  # rounds before the first word are not known
    assert [t for t, *_ in decoded(words)] == [t - first for t in times]


@st.composite
def chunks(draw: st.DrawFn) -> list[EventChunk]:
    """Draw events in order of time, in parts."""
    random, count = np.random.default_rng(draw(st.integers(0, 2**32))), draw(st.integers(0, 60))
    most = draw(st.sampled_from([0, 1, 5000, 3_000_000]))
    t_ns = 1000 * np.cumsum(random.integers(0, most + 1, count))
    x, y = random.integers(0, 2048, count), np.repeat(random.integers(0, 2048, count), 3)[:count]
    every = EventChunk(t_ns, x.astype(np.uint16), y, random.random(count) < 0.5)
    edges = sorted(draw(st.lists(st.integers(0, count), max_size=3)))
    return [every.part(*edge) for edge in zip([0, *edges], [*edges, count], strict=True)]


@settings(max_examples=60, deadline=None)
@given(parts=chunks())
def test_what_is_written_is_read_back(tmp_path_factory: pytest.TempPathFactory, parts: list[EventChunk]) -> None:
    import faery

    encoder = Encoder()
    words = np.concatenate([encoder.encode(part) for part in parts])
    true = [event for part in parts for event in listed(part)]
    assert decoded(words.tolist()) == slow(words.tolist()) == true
    highs = words[words >> 12 == 8] & 0xFFF
    if true:  # none of the upper bits is skipped
        np.testing.assert_array_equal(highs, np.arange((true[-1][0] >> 12) + 1) % 4096)
    path = tmp_path_factory.mktemp("evt3") / "a.raw"
    path.write_bytes(header_of(2048, 2048) + words.tobytes())
    with faery.evt.Decoder(path, None, None) as decoder:
        assert (decoder.version, decoder.dimensions) == ("evt3", (2048, 2048))
        packets = [packet["events"] for packet in decoder if "events" in packet]
    assert [tuple(event.tolist()) for packet in packets for event in packet] == true


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_words_as_of_a_sensor_are_read_as_faery_reads_them(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Rows with vectors and single events, upper bits every 16 us; no round and no step back, which faery has wrong."""
    import faery

    random, words = np.random.default_rng(seed), list[int]()
    for t in np.cumsum(random.integers(1, 40, 80)).tolist():
        words += [0x8000 | t >> 12, 0x6000 | t & 0xFFF, int(random.integers(720)), 0x2000 | int(random.integers(1280))]
        words += [0x3000 | int(random.integers(2)) << 11 | int(random.integers(1248))]
        words += [
            0x4000 | int(random.integers(4096)),
            0x4000 | int(random.integers(4096)),
            0x5000 | int(random.integers(256)),
        ]
        words += [0xA001, 0xE014, 0xF001, 0x7001][: int(random.integers(5))]
    path = tmp_path_factory.mktemp("evt3") / "a.raw"
    path.write_bytes(header_of(1280, 720) + np.array(words, evt3.WORD).tobytes())
    with faery.evt.Decoder(path, None, None) as decoder:
        packets = [packet["events"] for packet in decoder if "events" in packet]
    assert [tuple(event.tolist()) for packet in packets for event in packet] == decoded(words) == slow(words)


@pytest.mark.parametrize("times_us", [[-1], [5, 4], [1 << 35]])
def test_times_that_cannot_be_written_are_refused(times_us: list[int]) -> None:
    zeros = np.zeros(len(times_us), np.int64)
    with pytest.raises(UsageError, match=r"EVT 3 takes times in order, from 0 to 34359738367 us"):
        Encoder().encode(EventChunk(np.array(times_us) * 1000, zeros, zeros, zeros > 0))


def read(path: Path, content: bytes, size: SensorSize | None = None) -> list[Item]:
    path.write_bytes(content)
    return list(read_items(path, None, ConvertOptions(size=size)))


FEW = struct.pack("<6H", 0x8001, 0x6005, 3, 0x2801, 0x3804, 0x4003)
EVENTS = [(4101, 1, 3, True), (4101, 4, 3, True), (4101, 5, 3, True)]


@pytest.mark.parametrize(
    "head",
    [
        HEAD,
        HEAD.replace(b"\n", b"\r\n"),
        HEAD.replace(b"% end\n", b""),
        HEAD.replace(b"% end", b"%end"),
        HEAD.replace(b"% geometry", b"% integrator_name Gr\xfc\xdfe\n%\n%remark\n%  geometry"),
        b"% date 2020-01-01 00:00:00\n% evt 3.0\n% width 300\n% height 200\n",
        b"% evt 3.0\n% format EVT3;height=200;width=300\n% geometry 300x200\n% end\n",
        b"% evt 2.0\n% format EVT3;width=300;height=200\n% end\n",
        b"% format EVT3;height=200;width=300\n% end of the header comes\n% end\n",
        b"% Evt 3.0\n% Geometry 300 x 200\n% END\n",
    ],
)
def test_headers_of_many_hands(tmp_path: Path, head: bytes) -> None:
    size, *items = read(tmp_path / "a.raw", head + FEW)
    assert size == SensorSize(300, 200)
    assert [event for item in items if isinstance(item, EventChunk) for event in listed(item)] == EVENTS


def test_words_that_begin_like_a_line_of_the_header_are_words(tmp_path: Path) -> None:
    for first in (0x8025, 0x3025):  # "%" and a byte that is no text; 0x20 would be a space
        words = struct.pack("<5H", first, 0x8001, 3, 0x2801, 0x0A0A)
        items = read(tmp_path / "a.raw", HEAD.replace(b"% end\n", b"") + words)
        expected = slow(struct.unpack("<5H", words))
        assert [event for item in items if isinstance(item, EventChunk) for event in listed(item)] == expected


REFUSED = {
    "no size": (b"% evt 3.0\n% end\n" + FEW, r"states no size of the sensor; give --size WIDTHxHEIGHT"),
    "two sizes": (b"% evt 3.0\n% format EVT3;height=9;width=9\n% geometry 300x200\n% end\n" + FEW, r"several sizes"),
    "too wide": (
        b"% evt 3.0\n% geometry 2304x64\n% end\n" + FEW,
        r"a picture of 2304 x 64 px; EVT 3 holds at most 2048 px a side",
    ),
    "too wide, EVT 2": (
        b"% evt 2.0\n% geometry 2304x64\n% end\n" + struct.pack("<2I", 8 << 28, 0),
        r"a picture of 2304 x 64 px; EVT 2 holds at most 2048 px a side",
    ),
    "huge": (b"% evt 3.0\n% geometry 999999999x999999999\n% end\n" + FEW, r"at most 16,777,216"),
    "upper byte first": (
        HEAD + np.arange(0x6000, 0x6FFF).astype(">u2").tobytes(),
        r"of 4095 words have types that EVT 3 reserves: the file is damaged, or",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_files_that_cannot_be_right_are_refused(tmp_path: Path, case: str) -> None:
    content, message = REFUSED[case]
    with pytest.raises(UsageError, match=message):
        read(tmp_path / "a.raw", content)


@pytest.mark.parametrize(
    ("content", "size", "said"),
    [
        (HEAD + FEW, SensorSize(300, 200), ""),
        (b"% evt 3.0\n% end\n" + FEW, SensorSize(300, 200), ""),
        (b"% evt 3.0\n% format EVT3;height=9;width=9\n% geometry 300x200\n" + FEW, SensorSize(300, 200), ""),
        (HEAD + FEW + b"\0", None, "cut: the last 1 bytes are an incomplete event and left out"),
        (HEAD + FEW + b"\0\x90\0\xb0", None, "2 words of types that EVT 3 reserves are passed over"),
        (
            HEAD + FEW + struct.pack("<2H", 0x803, 0x2001),
            None,
            "the events of a second camera, in 1 rows, are left out",
        ),
    ],
    ids=["nothing", "size given", "size chosen", "half a word", "reserved", "second camera"],
)
def test_what_is_left_out_is_said(tmp_path: Path, content: bytes, size: SensorSize | None, said: str) -> None:
    items = read(tmp_path / "a.raw", content, size)
    assert items[0] == SensorSize(300, 200)
    assert [event for item in items if isinstance(item, EventChunk) for event in listed(item)] == EVENTS
    assert "; ".join(item.text for item in items if isinstance(item, Note)) == said


def test_a_large_file_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = HEAD + FEW + struct.pack("<2H", 0x4FFF, 0x5FFF) * 40
    whole = read(tmp_path / "a.raw", content, None)
    monkeypatch.setattr(evt3, "BLOCK_WORDS", 10)
    parts = [item for item in read(tmp_path / "a.raw", content) if isinstance(item, EventChunk)]
    assert len(parts) == 9
    assert max(map(len, parts)) <= 10 * 12
    together = [event for item in whole if isinstance(item, EventChunk) for event in listed(item)]
    assert (
        [event for part in parts for event in listed(part)]
        == together
        == slow(struct.unpack("<86H", content[len(HEAD) :]))
    )
