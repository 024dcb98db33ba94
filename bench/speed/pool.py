"""Compare a pool of workers that two brokers share with a server that has as many workers of its own.

    python -m bench pool --videos CLIPS --json pool.json

Three readings in turns: the server with its own workers; one of the two brokers, alone; both brokers at once. All
processes run throughout, and those that nothing is read from are idle.

Bars, medians of the turns: the one that reads alone gets at least 0.9 of the rate with own workers; when both read,
each gets half of the samples within 10 %.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

from bench.frame import Column, Report, add_positive, add_videos, add_whole, beyond, medians, ratios
from bench.processes import consume, free_ports
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser

LEAST_ALONE, LEAST_SHARE, MOST_SHARE = 0.9, 0.45, 0.55
_WARMUP_BATCHES = 4
_COLUMNS: tuple[Column, ...] = (
    ("reading", "reading", "{}", 1),
    ("batches_per_second", "batches/s", "{:.2f}", 1),
    ("ratio_to_own", "of own", "{:.3f}", 1),
    ("ratio_to_own_lowest", "lowest", "{:.3f}", 1),
    ("ratio_to_own_highest", "highest", "{:.3f}", 1),
    ("share", "share of the first", "{:.3f}", 1),
)


@contextmanager
def shared_pool(asked: argparse.Namespace) -> Iterator[list[LocalServer]]:
    """Yield two brokers that share their workers."""
    addresses = [f"tcp://127.0.0.1:{port}" for port in free_ports(2)]
    command = [sys.executable, "-m", "v2v_server.commands.worker", "--connect", ",".join(addresses)]
    with ExitStack() as opened:
        workers = [
            # In sessions of their own, as a server starts its workers: the kernel shares busy cores by session.
            subprocess.Popen(
                [*command, "--videos", str(asked.videos)], stdin=subprocess.DEVNULL, start_new_session=True
            )
            for _ in range(asked.workers)
        ]
        for worker in workers:
            opened.callback(worker.wait)
            opened.callback(worker.terminate)
        yield [
            opened.enter_context(
                LocalServer(asked.videos, workers=0, flags=["--rows", asked.rows, "--worker-bind", address])
            )
            for address in addresses
        ]


def rates(servers: Sequence[LocalServer], asked: argparse.Namespace) -> list[float]:
    """Return the batches per second of a trainer at each server, all at once."""

    def rate(server: LocalServer) -> float:
        with V2VStreamDataset(server.address, asked.batch_size, rank=0, world_size=1, timeout_seconds=600.0) as dataset:
            taken = consume(dataset, {}, seconds=asked.seconds, warmup_batches=_WARMUP_BATCHES)
        return taken["batches_per_second"]

    with ThreadPoolExecutor(len(servers)) as threads:
        return list(threads.map(rate, servers))


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "clips", rows="top:0.54")
    add_whole(parser, "--workers", 2, "workers of the pool, and of the server with its own")
    add_whole(parser, "--batch-size", 4, "samples of a batch")
    add_whole(parser, "--turns", 5, "turns of the three readings")
    add_positive(parser, "--seconds", 10.0, "duration of a reading, seconds")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench: medians over the turns."""
    with (
        shared_pool(asked) as brokers,
        LocalServer(asked.videos, workers=asked.workers, flags=["--rows", asked.rows]) as own,
    ):
        turns = [(rates([own], asked), rates(brokers[:1], asked), rates(brokers, asked)) for _ in range(asked.turns)]
    by_own, alone, both = zip(*turns, strict=True)
    records = [
        {"reading": name, **medians([{"batches_per_second": sum(each)} for each in readings])}
        for name, readings in (("own workers", by_own), ("one of two brokers", alone), ("both brokers", both))
    ]
    for record, readings in zip(records[1:], (alone, both), strict=True):
        record |= ratios("ratio_to_own", map(sum, readings), map(sum, by_own))
    records[2] |= medians([{"share": first / (first + second)} for first, second in both])
    missed = beyond("one of two brokers", records[1], least={"ratio_to_own": LEAST_ALONE})
    missed += beyond("both brokers", records[2], least={"share": LEAST_SHARE}, most={"share": MOST_SHARE})
    return Report(records, [(records, _COLUMNS)], missed=missed)
