"""EVT 2 and DAT: words decoded as faery decodes them, where faery is right; and what it has wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trainer.convert.raw_forms import write_evt2
from tests.trainer.convert.scene import Scene
from v2v_protocol.errors import UsageError
from v2v_recordings import evt3
from v2v_recordings.items import ConvertOptions, EventChunk, Item
from v2v_recordings.reading import read_items

WIDTH, HEIGHT = 1280, 720
DAT_HEAD = f"% Version 2\n% Width {WIDTH}\n% Height {HEIGHT}\n".encode() + b"\x0c\x08"
EVT2_HEAD = f"% evt 2.0\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode()


def read(path: Path) -> list[Item]:
    return list(read_items(path, None, ConvertOptions()))


def rows(items: list[Item]) -> list[tuple[int, ...]]:
    """Return time, us, column, row and polarity of all events."""
    chunks = [item for item in items if isinstance(item, EventChunk)]
    return [
        row
        for each in chunks
        for row in zip((each.t_ns // 1000).tolist(), each.x.tolist(), each.y.tolist(), each.p.tolist(), strict=True)
    ]


def high(value: int) -> int:
    return 0x8 << 28 | value


def event(low: int, x: int = 1, y: int = 2, p: int = 1) -> int:
    return p << 28 | low << 22 | x << 11 | y


def evt2(path: Path, *words: int) -> list[tuple[int, ...]]:
    path.write_bytes(EVT2_HEAD + np.array(words, "<u4").tobytes())
    return rows(read(path))


def write_dat(path: Path, events: Scene) -> None:
    p, y, x = events.p.astype(np.int64), events.y.astype(np.int64), events.x.astype(np.int64)
    path.write_bytes(DAT_HEAD + np.stack([events.t_us, p << 28 | y << 14 | x], axis=1).astype("<u4").tobytes())


@settings(max_examples=15)
@given(st.integers(0, 2**32), st.sampled_from([7, 1 << 17]))
@pytest.mark.parametrize(("write", "kind"), [(write_evt2, "evt"), (write_dat, "dat")])
def test_words_are_read_as_faery_reads_them(
    tmp_path_factory: pytest.TempPathFactory, write: Callable[[Path, Scene], None], kind: str, seed: int, block: int
) -> None:
    import faery

    random, count = np.random.default_rng(seed), 300
    t_us = int(random.integers(1 << 31)) + np.cumsum(random.integers(0, 100, count))
    x, y, p = random.integers(WIDTH, size=count), random.integers(HEIGHT, size=count), random.integers(2, size=count)
    path = tmp_path_factory.mktemp(kind) / ("a.raw" if kind == "evt" else "a.dat")
    write(path, Scene(t_us, x, y, p > 0, np.zeros(0, np.uint8), t_us))
    path.write_bytes(path.read_bytes().replace(b"24x18", b"1280x720"))
    with pytest.MonkeyPatch.context() as patch, getattr(faery, kind).Decoder(path, None, None) as decoder:
        patch.setattr(evt3, "BLOCK_WORDS", block)
        packets = [packet["events"] if isinstance(packet, dict) else packet for packet in decoder]
        expected = [(int(t), int(x), int(y), int(p)) for packet in packets for t, x, y, p in packet.tolist()]
        assert rows(read(path)) == expected
    assert len(expected) == count


@pytest.mark.parametrize(
    ("words", "times_us"),
    [
        ([event(5), event(6), high(10), event(5)], [645]),  # no time before the first upper bits
        ([high(10), 0xA << 28 | 5, 0xE << 28 | 7, 0xF << 28, event(6)], [646]),  # triggers and messages
        ([high(1000), event(5), high(990), event(3), high(1001), event(1)], [64005, 63363, 64065]),  # a late event
        ([high((1 << 28) - 1), event(5), high(0), event(3)], [(1 << 34) - 59, (1 << 34) + 3]),  # a new round
        (
            [high((1 << 28) - 1), event(5), high(0), event(3), high((1 << 28) - 1), event(8), high(1), event(2)],
            [(1 << 34) - 59, (1 << 34) + 3, (1 << 34) - 56, (1 << 34) + 66],
        ),  # ... and an event of the one before
    ],
)
@pytest.mark.parametrize("block", [1, 2, 1 << 17])
def test_times_of_evt2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[int], times_us: list[int], block: int
) -> None:
    monkeypatch.setattr(evt3, "BLOCK_WORDS", block)
    assert evt2(tmp_path / "a.raw", *words) == [(t, 1, 2, 1) for t in times_us]


def test_a_clock_of_32_bits_goes_round(tmp_path: Path) -> None:
    t_us = np.array([(1 << 32) - 3, 5, (1 << 32) - 1, 9])
    write_dat(tmp_path / "a.dat", Scene(t_us, t_us % 7, t_us % 5, t_us % 2 > 0, np.zeros(0, np.uint8), t_us))
    assert [t for t, *_ in rows(read(tmp_path / "a.dat"))] == [(1 << 32) + at for at in (-3, 5, -1, 9)]


def test_dat_of_version_1(tmp_path: Path) -> None:
    head = DAT_HEAD.replace(b"Version 2", b"Version 1").replace(b"1280", b"304").replace(b"720", b"240")
    (tmp_path / "a.dat").write_bytes(head + np.array([7, 1 << 17 | 200 << 9 | 300], "<u4").tobytes())
    assert rows(read(tmp_path / "a.dat")) == [(7, 300, 200, 1)]


@pytest.mark.parametrize(
    ("name", "head", "why"),
    [
        ("a.dat", DAT_HEAD[:-2] + b"\x0e\x08", "its events are of type and size 0e 08; 00 08 and 0c 08 can be read"),
        ("a.dat", DAT_HEAD[:-2] + b"\x0c", "its events are of type and size 0c;"),
        ("a.dat", b"% Version 2\n\x0c\x08", "states no size of the sensor; give --size"),
        ("a.raw", b"% evt 4.0\n% geometry 24x18\n% end\n", "is in EVT 4, which is not supported; EVT 2, EVT 3 and DAT"),
        ("a.raw", b"% geometry 24x18\n% end\n", "is in EVT of no stated version"),
        ("a.raw", EVT2_HEAD.replace(b"% end", b"% format EVT2;height=9;width=9"), "states several sizes of the sensor"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, head: bytes, why: str) -> None:
    (tmp_path / name).write_bytes(head)
    with pytest.raises(UsageError, match=why):
        read(tmp_path / name)
