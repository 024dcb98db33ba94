"""What the cache of decoded clips costs when it is filled, and gives when it is read.

    v2v-bench cache --videos DIR --turns 3

The samples of one epoch of the paper's recipe, one after the other in this process: decoded as without a cache
(``source``), decoded and kept in an empty one (``fill``), read from it (``hits``). Processor time; a ratio is the
median of the ratios within a turn.

    of source      against the samples decoded as without a cache; at most 1.2 was asked of ``fill``
    read           share of getting the clip: decode, or read and unpack; with ``fill``, compress and write, too
    view           share of cutting out what the camera sees: crop, resize, flip
    kernel         share of the rest: the pixels
    MiB            that the cache holds then
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.leases import open_leases
from bench.records import Column, at_least, plain_parser, run, say_missed, show, write
from v2v_protocol.messages import Lease
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.view import apply_view
from v2v_server.store.cache import Cache, make_cache
from v2v_server.worker.produce import decode_for, make_sample

FILL_BAR = 1.2
WAYS = ("source", "fill", "hits")
_COLUMNS: tuple[Column, ...] = (
    ("way", "", "{}", 1.0),
    ("ms_per_sample", "CPU ms a sample", "{:.1f}", 1.0),
    ("of_source", "of source", "{:.2f}", 1.0),
    ("of_source_lowest", "lowest", "{:.2f}", 1.0),
    ("of_source_highest", "highest", "{:.2f}", 1.0),
    ("read", "read", "{:.0%}", 1.0),
    ("view", "view", "{:.0%}", 1.0),
    ("kernel", "kernel", "{:.0%}", 1.0),
    ("cache_mib", "MiB", "{:.0f}", 1.0),
)


@dataclass(frozen=True, slots=True)
class Epoch:
    """Processor time of one epoch, in seconds, in its parts."""

    read: float
    view: float
    kernel: float

    @property
    def total(self) -> float:
        """Of all of them."""
        return self.read + self.view + self.kernel


def epoch(leases: Sequence[Lease], root: Path, cache: Cache | None) -> Epoch:
    """Makes every sample once."""
    read = view = made = 0.0
    for lease in leases:
        began = time.process_time()
        decoded = decode_for(lease, lease.indices, root, cache)[0]
        came = time.process_time()
        make_sample(lease, decoded)
        done = time.process_time()
        # Once more by itself: make_sample has it inside.
        apply_view(decoded.clip.frames, decoded.plan.params, decoded.plan.spec.recipe)
        view += time.process_time() - done
        read, made = read + came - began, made + done - came
    return Epoch(read, view, made - view)


def compare(leases: Sequence[Lease], root: Path, turns: int) -> list[dict[str, Any]]:
    """The three ways in turn, several times over, each time with an empty cache; a record for each way."""
    epoch(leases, root, None)  # files and kernels are warm
    found: list[dict[str, Epoch]] = []
    held = 0
    for _ in range(turns):
        with tempfile.TemporaryDirectory(prefix="v2v-cache-") as folder:
            make_cache(Path(folder))
            cache = Cache(Path(folder), 1 << 40, least_free_bytes=0)
            ways = (None, cache, cache)
            found.append({way: epoch(leases, root, where) for way, where in zip(WAYS, ways, strict=True)})
            held = cache.used_bytes
    records = []
    for way in WAYS:
        ratios = [turn[way].total / turn["source"].total for turn in found]
        records.append(
            {
                "way": way,
                "ms_per_sample": statistics.median(turn[way].total for turn in found) / len(leases) * 1e3,
                "of_source": statistics.median(ratios),
                "of_source_lowest": min(ratios),
                "of_source_highest": max(ratios),
                "read": statistics.median(turn[way].read / turn[way].total for turn in found),
                "view": statistics.median(turn[way].view / turn[way].total for turn in found),
                "kernel": statistics.median(turn[way].kernel / turn[way].total for turn in found),
                "cache_mib": 0.0 if way == "source" else held / (1 << 20),
                "samples": len(leases),
                "turns": turns,
            }
        )
    return records


def missed(records: Sequence[dict[str, Any]]) -> list[str]:
    """The bar that these records miss, in words."""
    ratio = next(record["of_source"] for record in records if record["way"] == "fill")
    return [f"fill: {ratio:.2f} of source, at most {FILL_BAR} was asked"] if ratio > FILL_BAR else []


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, turns=1, samples=1)
    with open_leases(asked.videos, asked.rows, StreamSpec()) as (root, endless):
        leases = list(itertools.takewhile(lambda lease: lease.epoch == 0, itertools.islice(endless, asked.samples)))
        records = compare(leases, root, asked.turns)
    show(records, _COLUMNS)
    write(records, asked.json)
    return say_missed(missed(records))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = plain_parser(__doc__, "cache")
    parser.add_argument("--videos", required=True, type=Path, help="clips of at least 201 frames (bench.corpus)")
    parser.add_argument("--rows", default="top:0.54", help="of --videos (default top:0.54)")
    parser.add_argument("--samples", type=int, default=200, help="at most, of the first epoch (default 200)")
    parser.add_argument("--turns", type=int, default=3, help="default 3")
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
