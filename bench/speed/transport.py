"""Measure what moving samples costs beside making them.

    python -m bench transport --videos CLIPS --fast-videos PREPARED --json transport.json

"At work": workers, server and a V2VStreamDataset over whole epochs. Making a sample is the time that the workers state
for it; moving it is all other processor time of all processes. "Null workers" make nothing: they show the cost of
moving alone, through shared memory and in messages.

"Equal trainers": server and workers, for one trainer and for four with equal samples (``--share-gib``), in turns. Their
clients' time is beside it.

Bars: moving takes at most 5 % of all processor time under the preset "exact", on ``--videos``, and at most 10 % under
"fast", on ``--fast-videos``. Four equal trainers take at most 1.2 times the time of one, the median of the turns.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.frame import (
    Column,
    Record,
    Report,
    add_changes,
    add_positive,
    add_videos,
    add_whole,
    recipe_of,
    server_flags,
)  # fmt: skip
from bench.processes import Meter, consume, roles_of
from bench.speed.null_workers import null_service
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser
from v2v_protocol.spec import SpeedPreset

EQUAL_TRAINERS, MOST_RATIO = 4, 1.2
MOST_SHARE = {"exact": 0.05, "fast": 0.10}
WORKERS = 2
_SETTLE_SECONDS = 0.3
_COLUMNS: tuple[Column, ...] = (
    ("name", "", "{}", 1),
    ("making_cpu_seconds_per_batch", "making ms", "{:.0f}", 1e3),
    ("workers_cpu_seconds_per_batch", "workers ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("client_cpu_seconds_per_batch", "client ms", "{:.1f}", 1e3),
    ("cpu_seconds_per_batch", "moving ms", "{:.1f}", 1e3),
    ("share", "of all", "{:.1%}", 1),
    ("batches_per_second", "batches/s", "{:.1f}", 1),
    ("ratio_to_one", "of one", "{:.2f}", 1),
    ("ratio_to_one_lowest", "lowest", "{:.2f}", 1),
    ("ratio_to_one_highest", "highest", "{:.2f}", 1),
)


def at_work(asked: argparse.Namespace, preset: SpeedPreset, videos: Path, rows: str) -> dict[str, Any]:
    """Return the record of the whole stream: whole epochs, so that no sample is in flight at either end."""
    with LocalServer(videos, workers=WORKERS, flags=["--rows", rows, *server_flags(asked.changes)]) as server:
        dataset = V2VStreamDataset(server.address, asked.batch_size, rank=0, world_size=1, preset=preset)
        for _ in dataset:  # warm-up
            pass
        meter, began, batches, making = Meter(roles_of(server)), time.perf_counter(), 0, 0.0
        while not batches or time.perf_counter() - began < asked.seconds:
            for batch in dataset:
                batches, making = batches + 1, making + batch.cpu_seconds
        elapsed = time.perf_counter() - began
        time.sleep(_SETTLE_SECONDS)  # the server still handles the Goodbye
        used = meter.used()
    used["workers"] -= making
    moving = sum(used.values())
    return {
        "name": f"{preset}, at work",
        "preset": preset,
        "making_cpu_seconds_per_batch": making / batches,
        **{f"{role}_cpu_seconds_per_batch": seconds / batches for role, seconds in used.items()},
        "cpu_seconds_per_batch": moving / batches,
        "share": moving / (moving + making),
        "batches_per_second": batches / elapsed,
    }


def with_null_workers(asked: argparse.Namespace, shared_memory: bool) -> dict[str, Any]:
    """Return the record of moving alone."""
    with null_service(recipe_of(asked.changes), workers=WORKERS, flags=server_flags(asked.changes)) as service:
        dataset = V2VStreamDataset(
            service.server.address, asked.batch_size, rank=0, world_size=1, shared_memory=shared_memory
        )
        done = consume(dataset, service.roles, seconds=asked.seconds, warmup_batches=2)
    return {
        "name": f"null workers, {'shared memory' if shared_memory else 'messages'}",
        **{f"{role}_cpu_seconds_per_batch": done.cpu_seconds_per_batch(role) for role in done.cpu_seconds},
        "cpu_seconds_per_batch": done.cpu_seconds_per_batch(),
        "batches_per_second": done.batches_per_second,
    }


def equal_trainers(asked: argparse.Namespace, trainers: int) -> dict[str, Any]:
    """Return the record of a server from its start, with trainers that take one epoch of equal samples each."""
    flags = ["--rows", asked.rows, "--share-gib", "2" if trainers > 1 else "0", *server_flags(asked.changes)]
    with LocalServer(asked.videos, workers=1, flags=flags) as server:

        def take(dataset: V2VStreamDataset) -> int:
            return sum(1 for _ in dataset)

        datasets = [V2VStreamDataset(server.address, asked.batch_size, rank=0, world_size=1) for _ in range(trainers)]
        meter, began = Meter(roles_of(server)), time.perf_counter()
        with ThreadPoolExecutor(trainers) as threads:
            batches = max(threads.map(take, datasets))
        elapsed = time.perf_counter() - began
        time.sleep(_SETTLE_SECONDS)
        used = meter.used()
    return {
        "name": f"equal trainers: {trainers}",
        **{f"{role}_cpu_seconds_per_batch": seconds / batches for role, seconds in used.items()},
        "batches_per_second": batches / elapsed,
    }


def sharing(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the records of one trainer and of equal ones: medians over the turns."""
    turns = [[equal_trainers(asked, trainers) for trainers in (1, EQUAL_TRAINERS)] for _ in range(asked.share_turns)]
    found = []
    for runs in zip(*turns, strict=True):
        keys = [key for key in runs[0] if key != "name"]
        found.append({"name": runs[0]["name"], **{key: statistics.median(run[key] for run in runs) for key in keys}})

    def server_seconds(run: dict[str, Any]) -> float:
        return float(run["workers_cpu_seconds_per_batch"] + run["broker_cpu_seconds_per_batch"])

    ratios = [server_seconds(equal) / server_seconds(one) for one, equal in turns]
    found[1]["ratio_to_one"] = statistics.median(ratios)
    found[1] |= {"ratio_to_one_lowest": min(ratios), "ratio_to_one_highest": max(ratios)}
    return found


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bars that these records miss."""
    return [
        f"{record['name']}: moving takes {record['share']:.1%} of all processor time; the bar is {most:.0%}"
        for record in records
        if "preset" in record and record["share"] > (most := MOST_SHARE[record["preset"]])
    ] + [
        f"{record['name']}: {record['ratio_to_one']:.2f} times the processor time of one; the bar is {MOST_RATIO}"
        for record in records
        if record.get("ratio_to_one", 0.0) > MOST_RATIO
    ]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, 'clips for the preset "exact"', rows="top:0.54")
    parser.add_argument("--fast-videos", type=Path, metavar="DIR", help='clips for the preset "fast", prepared')
    add_positive(parser, "--seconds", 5.0, "of each row, at least")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_whole(parser, "--share-turns", 9, "turns of one trainer and of equal ones; 0: none", least=0)
    add_changes(parser)


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = [at_work(asked, "exact", asked.videos, asked.rows)]
    if asked.fast_videos is not None:
        records.append(at_work(asked, "fast", asked.fast_videos, "full"))
    records += [with_null_workers(asked, shared_memory) for shared_memory in (True, False)]
    records += sharing(asked) if asked.share_turns else []
    records = [record | {"batch_size": asked.batch_size} for record in records]
    return Report(records, [(records, _COLUMNS)], missed=missed(records))
