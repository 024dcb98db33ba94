"""Measure what equal trainers cost a server that makes equal samples once (``--share-gib``).

    python -m bench sharing --videos CLIPS --json sharing.json

Server and workers, for one trainer and for four with equal samples, in turns. Their clients' time is beside it.

Bar: four take at most 1.2 times the time of one, the median of the turns.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ThreadPoolExecutor

from bench.frame import Column, Report, add_videos, add_whole, beyond, medians, ratios
from bench.processes import cpu_seconds_of, roles_of
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser

EQUAL_TRAINERS, MOST_RATIO = 4, 1.2
_SETTLE_SECONDS = 0.3
_COLUMNS: tuple[Column, ...] = (
    ("trainers", "equal trainers", "{}", 1),
    ("workers_cpu_seconds_per_batch", "workers ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("client_cpu_seconds_per_batch", "clients ms", "{:.1f}", 1e3),
    ("batches_per_second", "batches/s", "{:.1f}", 1),
    ("ratio_to_one", "of one", "{:.2f}", 1),
    ("ratio_to_one_lowest", "lowest", "{:.2f}", 1),
    ("ratio_to_one_highest", "highest", "{:.2f}", 1),
)


def equal_trainers(asked: argparse.Namespace, trainers: int) -> dict[str, float]:
    """Return the record of a server from its start, with trainers that take one epoch of equal samples each."""
    flags = ["--rows", asked.rows, "--share-gib", "2" if trainers > 1 else "0"]
    with LocalServer(asked.videos, workers=1, flags=flags) as server:
        datasets = [V2VStreamDataset(server.address, asked.batch_size, rank=0, world_size=1) for _ in range(trainers)]
        roles = roles_of(server)
        before, began = cpu_seconds_of(roles), time.perf_counter()
        with ThreadPoolExecutor(trainers) as threads:
            batches = max(threads.map(lambda dataset: sum(1 for _ in dataset), datasets))
        elapsed = time.perf_counter() - began
        time.sleep(_SETTLE_SECONDS)  # the server still handles the Goodbye
        after = cpu_seconds_of(roles)
    return {
        **{f"{role}_cpu_seconds_per_batch": (after[role] - before[role]) / batches for role in roles},
        "batches_per_second": batches / elapsed,
    }


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "clips", rows="top:0.54")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_whole(parser, "--turns", 9, "turns of one trainer and of equal ones")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench: medians over the turns."""
    turns = [[equal_trainers(asked, trainers) for trainers in (1, EQUAL_TRAINERS)] for _ in range(asked.turns)]
    one, equal = zip(*turns, strict=True)
    records = [{"trainers": 1, **medians(one)}, {"trainers": EQUAL_TRAINERS, **medians(equal)}]
    sides = [f"{role}_cpu_seconds_per_batch" for role in ("workers", "broker")]
    records[1] |= ratios("ratio_to_one", *([sum(run[side] for side in sides) for run in runs] for runs in (equal, one)))
    missed = beyond(f"{EQUAL_TRAINERS} trainers", records[1], most={"ratio_to_one": MOST_RATIO})
    return Report(records, [(records, _COLUMNS)], missed=missed)
