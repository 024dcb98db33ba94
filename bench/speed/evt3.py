"""Measure what reading EVT 3 takes, in multiples of the package faery's time.

    python -m bench evt3 --turns 5

Two files as a sensor sends them, with upper bits of the time every 16 us: ``events`` one by one, and ``vectors`` of 32
pixels with single events between them. Both read the same events, in blocks. Processor time; a ratio is the median of
the ratios within a turn.

    of faery       bar: at most 3
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.frame import Column, Report, add_whole, beyond, medians, ratios
from v2v_protocol.command import Parser
from v2v_recordings import prophesee
from v2v_recordings.archive import package
from v2v_recordings.evt3 import WORD, Uint16s, header_of
from v2v_recordings.items import ConvertOptions, EventChunk

WIDTH, HEIGHT, BAR = 1280, 720, 3.0
_COLUMNS: tuple[Column, ...] = (
    ("words_as", "words as", "{}", 1),
    ("events", "million events", "{:.1f}", 1e-6),
    ("seconds", "CPU s", "{:.2f}", 1),
    ("faery_seconds", "faery, CPU s", "{:.2f}", 1),
    ("ratio", "of faery", "{:.2f}", 1),
    ("ratio_lowest", "lowest", "{:.2f}", 1),
    ("ratio_highest", "highest", "{:.2f}", 1),
)


def words_of(kind: str, rows: int) -> Uint16s:
    """Return the words of random rows, [M]: a time, the row, single events, and a vector of 12, 12 and 8 px."""
    random = np.random.default_rng(0)
    t_us = np.cumsum(random.integers(1, 6, rows))
    singles = [0x2000 | random.integers(2, size=rows) << 11 | random.integers(WIDTH, size=rows) for _ in range(2)]
    base = 0x3000 | random.integers(2, size=rows) << 11 | 32 * random.integers(WIDTH // 32, size=rows)
    valid = [random.integers(1 << bits, size=rows) & random.integers(1 << bits, size=rows) for bits in (12, 12, 8)]
    vector = [base, 0x4000 | valid[0], 0x4000 | valid[1], 0x5000 | valid[2]] if kind == "vectors" else []
    times = [0x8000 | t_us >> 12 & 0xFFF, 0x6000 | t_us & 0xFFF]
    words = np.stack([*times, random.integers(HEIGHT, size=rows), *singles, *vector], axis=1)
    is_sent = np.ones(words.shape, bool)
    is_sent[1:, 0] = np.diff(t_us >> 4) > 0
    return words[is_sent].astype(WORD)


def by_us(path: Path) -> Iterator[int]:
    """Yield the number of events of each block."""
    items = prophesee.read(path, ConvertOptions(), lambda _done, _total: None)
    yield from (len(item) for item in items if isinstance(item, EventChunk))


def by_faery(path: Path) -> Iterator[int]:
    """Yield the number of events of each packet."""
    with package("faery", "this bench").evt.Decoder(path, None, None) as decoder:
        yield from (len(packet["events"]) for packet in decoder)


def timed(read: Callable[[Path], Iterator[int]], path: Path) -> tuple[int, float]:
    """Return the number of events, and the processor seconds that reading them takes."""
    began = time.process_time()
    return sum(read(path)), time.process_time() - began


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_whole(parser, "--rows", 4_000_000, "rows of each file")
    add_whole(parser, "--turns", 5, "turns of each way")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        RuntimeError: the two read different numbers of events.
    """
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="v2v-evt3-") as folder:
        for kind in ("events", "vectors"):
            path = Path(folder, f"{kind}.raw")
            path.write_bytes(header_of(WIDTH, HEIGHT) + words_of(kind, asked.rows).tobytes())
            turns = [(timed(by_us, path), timed(by_faery, path)) for _ in range(asked.turns)]
            if len({events for turn in turns for events, _ in turn}) > 1:
                raise RuntimeError(f"{kind}: different numbers of events: {turns}")
            mine, base = ([turn[way][1] for turn in turns] for way in (0, 1))
            seconds = medians([{"seconds": one, "faery_seconds": other} for one, other in zip(mine, base, strict=True)])
            records.append({"words_as": kind, "events": turns[0][0][0], **seconds, **ratios("ratio", mine, base)})
    missed = [text for each in records for text in beyond(each["words_as"], each, most={"ratio": BAR})]
    return Report(records, [(records, _COLUMNS)], missed=missed)
