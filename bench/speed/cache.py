"""Measure what filling the cache of decoded clips costs, and what reading it saves.

    python -m bench cache --videos DIR --turns 3

The samples of one epoch of the paper's recipe, one after the other in this process: decoded without a cache
(``source``), decoded and written to an empty cache (``fill``), read from it (``hits``). Processor time; a ratio is the
median of the ratios within a turn.

    of source      multiple of the time without a cache; bar: at most 1.7 for ``fill``
    MiB            size of the cache
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.frame import Column, Report, add_videos, add_whole, beyond, ratios
from tests.oracles.leases import open_leases, whole_sample
from v2v_protocol.command import Parser
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.quota import used_bytes

FILL_BAR = 1.7
WAYS = ("source", "fill", "hits")
_COLUMNS: tuple[Column, ...] = (
    ("way", "", "{}", 1.0),
    ("cpu_seconds_per_sample", "CPU ms a sample", "{:.1f}", 1e3),
    ("ratio_to_source", "of source", "{:.2f}", 1.0),
    ("ratio_to_source_lowest", "lowest", "{:.2f}", 1.0),
    ("ratio_to_source_highest", "highest", "{:.2f}", 1.0),
    ("cache_bytes", "MiB", "{:.0f}", 2.0**-20),
)


def epoch(leases: Sequence[Lease], root: Path, cache: Cache | None) -> float:
    """Make every sample once; return the processor seconds."""
    began = time.process_time()
    for lease in leases:
        whole_sample(lease, root, cache)
    return time.process_time() - began


def compare(leases: Sequence[Lease], root: Path, turns: int) -> list[dict[str, Any]]:
    """Run the three ways in turns, each turn with an empty cache; return one record for each way."""
    epoch(leases, root, None)  # warms files and kernels
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    cache_bytes = 0
    for _ in range(turns):
        with tempfile.TemporaryDirectory(prefix="v2v-cache-") as folder:
            make_cache(Path(folder))
            cache = Cache(Path(folder), 1 << 40, least_free_bytes=0)
            for way, where in zip(WAYS, (None, cache, cache), strict=True):
                found[way].append(epoch(leases, root, where))
            cache_bytes = used_bytes(Path(folder))
    return [
        {
            "way": way,
            "cpu_seconds_per_sample": statistics.median(epochs) / len(leases),
            **ratios("ratio_to_source", epochs, found["source"]),
            "cache_bytes": 0 if way == "source" else cache_bytes,
            "samples": len(leases),
            "turns": turns,
        }
        for way, epochs in found.items()
    ]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "clips of at least 201 frames (python -m bench corpus)", rows="top:0.54")
    add_whole(parser, "--turns", 3, "turns of each way")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with open_leases(asked.videos, asked.rows, StreamSpec()) as (root, endless):
        leases = list(itertools.takewhile(lambda lease: lease.epoch == 0, itertools.islice(endless, 200)))
        records = compare(leases, root, asked.turns)
    fill = records[WAYS.index("fill")]
    return Report(records, [(records, _COLUMNS)], missed=beyond("fill", fill, most={"ratio_to_source": FILL_BAR}))
