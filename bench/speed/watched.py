"""Measure what watching a service costs: its rate with an open page and metrics scraped, and without.

    python -m bench watched --videos CLIPS --turns 5 --seconds 10 --json watched.json

One server with a page, and one consumer that takes batches as fast as they come. While watched, a browser holds /events
open and Prometheus scrapes /metrics every second. Watched and unwatched stretches take turns.

    kept              batches/s while watched, over those of the stretches before and after; median of the turns
    page CPU          processor time of the page's process while watched, in cores
    broker CPU        processor time of the server's main process that watching adds, in cores

Other work on the machine shows too: take many turns. Bar: kept at least 0.98.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import socket
import statistics
import threading
import time
import urllib.request
from collections.abc import Iterator
from typing import Any

import psutil

from bench.frame import (
    Column,
    Report,
    add_changes,
    add_positive,
    add_videos,
    add_whole,
    progress,
    recipe_of,
    server_flags,
)  # fmt: skip
from bench.processes import cpu_seconds, endless
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError

KEPT_BAR = 0.98
_SCRAPE_SECONDS = 1.0
_WARM_UP_BATCHES = 4
_START_SECONDS = 30.0
_COLUMNS: tuple[Column, ...] = (
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s", "{:.3f}", 1),
    ("kept", "kept", "{:.3f}", 1),
    ("kept_lowest", "lowest", "{:.3f}", 1),
    ("page_cpu_cores", "page CPU", "{:.2%}", 1),
    ("broker_cpu_cores", "broker CPU", "{:.2%}", 1),
)

Stretch = tuple[float, float, float]  # Batches/s, and cores that the page's process and the server's main process used


@contextlib.contextmanager
def watching(port: int) -> Iterator[None]:
    """Read the page's events and scrape its metrics meanwhile, in two threads."""
    stop = threading.Event()

    def browse() -> None:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/events", timeout=10) as events:
            while not stop.is_set():
                events.readline()

    def scrape() -> None:
        while not stop.wait(_SCRAPE_SECONDS):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as metrics:
                metrics.read()

    threads = [threading.Thread(target=browse), threading.Thread(target=scrape)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def page_process(server: int) -> int:
    """Return the process id of a server's page.

    Raises:
        UsageError: the page does not start.
    """
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline:
        for child in psutil.Process(server).children():
            with contextlib.suppress(psutil.Error):
                if "v2v_server.page" in child.cmdline():
                    return child.pid
        time.sleep(0.05)
    raise UsageError(f"the page's process does not start within {_START_SECONDS:g} s; see the server's log")


def turns_of(asked: argparse.Namespace) -> tuple[list[Stretch], list[Stretch]]:
    """Return the unwatched stretches and the watched ones between them."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    with LocalServer(
        asked.videos, workers=asked.workers, flags=[*server_flags(asked.changes), "--page", str(port)]
    ) as server:
        processes = page_process(server.pid), server.pid
        batches = endless(V2VStreamDataset(server.address, asked.batch_size, recipe=recipe_of(asked.changes)))
        for _ in range(_WARM_UP_BATCHES):
            next(batches)

        def stretch() -> Stretch:
            began, taken, used = time.monotonic(), 0, [cpu_seconds(pid) for pid in processes]
            while (elapsed := time.monotonic() - began) < asked.seconds:
                next(batches)
                taken += 1
            page, broker = (cpu_seconds(pid) - before for pid, before in zip(processes, used, strict=True))
            return taken / elapsed, page / elapsed, broker / elapsed

        calm, watched = [stretch()], []
        for turn in range(asked.turns):
            with watching(port):
                watched.append(stretch())
            calm.append(stretch())
            progress(f"turn {turn + 1}/{asked.turns}")
        batches.close()
    return calm, watched


def record_of(calm: list[Stretch], watched: list[Stretch]) -> dict[str, Any]:
    """Return the record of all turns."""
    beside = [statistics.mean((before[0], after[0])) for before, after in itertools.pairwise(calm)]
    kept = [each[0] / rate for each, rate in zip(watched, beside, strict=True)]
    broker = [statistics.median(each[2] for each in stretches) for stretches in (watched, calm)]
    return {
        "batches_per_second": statistics.median(each[0] for each in calm),
        "kept": statistics.median(kept),
        "kept_lowest": min(kept),
        "page_cpu_cores": statistics.median(each[1] for each in watched),
        "broker_cpu_cores": broker[0] - broker[1],
    }


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser)
    add_positive(parser, "--seconds", 10.0, "of each stretch")
    add_whole(parser, "--workers", 2, "workers of the server")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_whole(parser, "--turns", 5, "watched stretches")
    add_changes(parser)


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    record = {"workers": asked.workers, "batch_size": asked.batch_size, "turns": asked.turns}
    record |= record_of(*turns_of(asked))
    missed = [f"kept {record['kept']:.3f}; the bar is {KEPT_BAR}"] if record["kept"] < KEPT_BAR else []
    return Report([record], [([record], _COLUMNS)], missed=missed)
