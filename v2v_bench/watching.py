"""What it costs a stream to be watched.

    v2v-bench watching --videos STORE --rows full --turns 5

One server with its page and one consumer that takes what it can get. Spells in which nobody looks and spells in which a
browser's connection (``/events``) and Prometheus (``/metrics`` once a second) read alternate; a ratio is the median
over the turns.

    batches/s      while nobody looks, and while somebody does
    kept           of the rate; at least 0.98 was asked
    page CPU       processor time of the page's process, of all that the service and its consumer use meanwhile
"""

from __future__ import annotations

import argparse
import http.client
import socket
import statistics
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from v2v_bench.records import Column, at_least, plain_parser, run, say_missed, show, write
from v2v_bench.usage import Consumed, consume, roles_of
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer

KEPT_BAR = 0.98
_COLUMNS: tuple[Column, ...] = (
    ("alone", "alone, batches/s", "{:.2f}", 1.0),
    ("watched", "watched, batches/s", "{:.2f}", 1.0),
    ("kept", "kept", "{:.3f}", 1.0),
    ("kept_lowest", "lowest", "{:.3f}", 1.0),
    ("kept_highest", "highest", "{:.3f}", 1.0),
    ("page_cpu_share", "page CPU", "{:.2%}", 1.0),
)


@contextmanager
def watchers(port: int) -> Iterator[None]:
    """Reads ``/events`` all the time and ``/metrics`` once a second, as long as the block lasts."""
    stop = threading.Event()

    def events() -> None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
        connection.request("GET", "/events")
        answer = connection.getresponse()
        while not stop.is_set():
            answer.readline()
        connection.close()

    def metrics() -> None:
        while not stop.wait(1.0):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)
            connection.request("GET", "/metrics")
            connection.getresponse().read()
            connection.close()

    threads = [threading.Thread(target=each, daemon=True) for each in (events, metrics)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def compare(pairs: Sequence[tuple[Consumed, Consumed]]) -> dict[str, Any]:
    """The record of turns (nobody looked, somebody did)."""
    kept = [watched.batches_per_second / alone.batches_per_second for alone, watched in pairs]
    return {
        "alone": statistics.median(alone.batches_per_second for alone, _ in pairs),
        "watched": statistics.median(watched.batches_per_second for _, watched in pairs),
        "kept": statistics.median(kept),
        "kept_lowest": min(kept),
        "kept_highest": max(kept),
        "page_cpu_share": statistics.median(
            watched.cpu_seconds["page"] / sum(watched.cpu_seconds.values()) for _, watched in pairs
        ),
        "turns": len(pairs),
    }


def missed(record: dict[str, Any]) -> list[str]:
    """The bar that a record misses, in words."""
    return [f"{record['kept']:.3f} of the rate kept, {KEPT_BAR} was asked"] if record["kept"] < KEPT_BAR else []


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, turns=1)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    flags = ["--rows", asked.rows, "--page", str(port)]
    with LocalServer(asked.videos, workers=asked.workers, flags=flags) as server:
        children = psutil.Process(server.pid).children()
        page = [child.pid for child in children if "v2v_server.page" in child.cmdline()]
        roles = roles_of(server) | {"page": page}
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, rank=0, world_size=1)
        pairs = []
        for _ in range(asked.turns):
            alone = consume(dataset, roles, seconds=asked.seconds, warmup_batches=2)
            with watchers(port):
                pairs.append((alone, consume(dataset, roles, seconds=asked.seconds, warmup_batches=2)))
    record = compare(pairs)
    show([record], _COLUMNS)
    write([record], asked.json)
    return say_missed(missed(record))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = plain_parser(__doc__, "watching")
    parser.add_argument("--videos", required=True, type=Path, help="a store or clips of at least 201 frames")
    parser.add_argument("--rows", default="full", help="of --videos (default full)")
    parser.add_argument("--workers", type=int, default=2, help="default 2")
    parser.add_argument("--batch-size", type=int, default=12, help="default 12")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each spell (default 8)")
    parser.add_argument("--turns", type=int, default=5, help="default 5")
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
