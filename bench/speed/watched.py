"""What it costs to watch a service: its rate with a page open and metrics scraped, and without, in turns.

    v2v-bench watched --videos CLIPS --turns 5 --seconds 10 --json watched.json

One server with a page, and one consumer that takes batches as fast as they come. A turn is a stretch in which nobody
looks, one in which a browser holds /events open and Prometheus asks for /metrics every second (which is often), and one
in which nobody looks again.

    kept              batches a second while watched, over those of the stretches before and after; median of the turns
    page CPU          processor time of the page's process, of one core, while watched
    broker CPU        processor time of the server's main process that a second of watching adds

A host whose cores others use as well measures them too: believe the median of many turns, and the processor times.
Bar: kept at least 0.98.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import socket
import statistics
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from bench.records import at_least, plain_parser, recipe_of, run, server_flags, show, write
from bench.usage import cpu_seconds
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError, V2VError

KEPT_BAR = 0.98
_SCRAPE_SECONDS = 1.0
_WARM_UP_BATCHES = 4
_COLUMNS = (
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s", "{:.3f}", 1),
    ("kept", "kept", "{:.3f}", 1),
    ("kept_lowest", "lowest", "{:.3f}", 1),
    ("page_cpu_share", "page CPU", "{:.2%}", 1),
    ("broker_cpu_share", "broker CPU", "{:.2%}", 1),
)


class Consumer:
    """Takes batches in a thread of its own, as fast as they come.

    Args:
        dataset: epoch after epoch of it.
    """

    def __init__(self, dataset: V2VStreamDataset) -> None:
        self._dataset = dataset
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._take)
        self.batches = 0
        self.trouble: V2VError | None = None

    def __enter__(self) -> Consumer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _take(self) -> None:
        try:
            while not self._stop.is_set():
                for _ in self._dataset:
                    self.batches += 1
                    if self._stop.is_set():
                        return
        except V2VError as error:
            self.trouble = error

    def wait_for(self, batches: int) -> None:
        """Returns once so many have come.

        Raises:
            V2VError: they do not.
        """
        while self.batches < batches:
            self.check()
            time.sleep(0.05)

    def check(self) -> None:
        """
        Raises:
            V2VError: the stream ended with it.
        """
        if self.trouble is not None:
            raise self.trouble


@dataclass(frozen=True, slots=True)
class Stretch:
    """Some seconds: batches a second, and cores that the page's and the server's main process took."""

    rate: float
    page_cpu: float
    broker_cpu: float


def stretch(consumer: Consumer, page: int, broker: int, seconds: float) -> Stretch:
    """Measures for so long."""
    before, began = (consumer.batches, cpu_seconds(page), cpu_seconds(broker)), time.monotonic()
    time.sleep(seconds)
    elapsed = time.monotonic() - began
    consumer.check()
    taken = (consumer.batches - before[0], cpu_seconds(page) - before[1], cpu_seconds(broker) - before[2])
    return Stretch(*(amount / elapsed for amount in taken))


@contextlib.contextmanager
def watching(port: int) -> Iterator[None]:
    """A browser and a Prometheus look at the page meanwhile."""
    stop = threading.Event()

    def browse() -> None:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/events", timeout=10) as events:
            while not stop.is_set():
                events.readline()

    def scrape() -> None:
        while not stop.wait(_SCRAPE_SECONDS):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as metrics:
                metrics.read()

    lookers = [threading.Thread(target=browse), threading.Thread(target=scrape)]
    for looker in lookers:
        looker.start()
    try:
        yield
    finally:
        stop.set()
        for looker in lookers:
            looker.join()


def measure(
    videos: Path, workers: int, batch_size: int, turns: int, seconds: float, changes: Sequence[str]
) -> dict[str, Any]:
    """A record of all turns.

    Raises:
        V2VError: the server or the stream does not come up.
    """
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    with LocalServer(videos, workers=workers, flags=[*server_flags(changes), "--page", str(port)]) as server:
        page = _page_of(server.pid)
        with Consumer(V2VStreamDataset(server.address, batch_size, recipe=recipe_of(changes))) as consumer:
            consumer.wait_for(_WARM_UP_BATCHES)
            calm, watched = [stretch(consumer, page, server.pid, seconds)], []
            for turn in range(turns):
                with watching(port):
                    watched.append(stretch(consumer, page, server.pid, seconds))
                calm.append(stretch(consumer, page, server.pid, seconds))
                kept = watched[-1].rate / statistics.mean((calm[-2].rate, calm[-1].rate))
                print(f"turn {turn + 1}/{turns}  kept {kept:.3f}", file=sys.stderr)
    beside = [statistics.mean((before.rate, after.rate)) for before, after in itertools.pairwise(calm)]
    kept_of_each = [each.rate / rate for each, rate in zip(watched, beside, strict=True)]
    broker = statistics.median(each.broker_cpu for each in watched) - statistics.median(
        each.broker_cpu for each in calm
    )
    return {
        "workers": workers,
        "batch_size": batch_size,
        "turns": turns,
        "seconds": seconds,
        "batches_per_second": statistics.median(each.rate for each in calm),
        "kept": statistics.median(kept_of_each),
        "kept_lowest": min(kept_of_each),
        "page_cpu_share": statistics.median(each.page_cpu for each in watched),
        "broker_cpu_share": broker,
    }


def _page_of(server: int) -> int:
    """The page's process.

    Raises:
        UsageError: it does not come up.
    """
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        for child in psutil.Process(server).children():
            with contextlib.suppress(psutil.Error):
                if "v2v_server.page" in child.cmdline():
                    return child.pid
        time.sleep(0.05)
    raise UsageError("the page's process does not come up; the server's log says why")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = plain_parser(__doc__, "watched")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="of each stretch (default 10)")
    parser.add_argument(
        "--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="change a recipe field"
    )
    parser.add_argument("--videos", type=Path, required=True, metavar="DIR", help="what to serve")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="of the server (default 2)")
    parser.add_argument("--batch-size", type=int, default=12, metavar="N", help="samples of a batch (default 12)")
    parser.add_argument("--turns", type=int, default=5, metavar="N", help="median of so many (default 5)")
    return run(parser, _run, arguments)


def _run(asked: argparse.Namespace) -> int:
    at_least(asked, workers=1, batch_size=1, turns=1)
    record = measure(asked.videos, asked.workers, asked.batch_size, asked.turns, asked.seconds, asked.changes)
    show([record], _COLUMNS)
    write([record], asked.json)
    if record["kept"] >= KEPT_BAR:
        return 0
    print(f"kept {record['kept']:.3f}, at least {KEPT_BAR} was asked", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
