"""Run ``v2v-loadtest``: measure how fast a server feeds one trainer, and whether samples are lost or repeated.

It starts a server for each number of workers (``--videos``), or measures a running one (``--connect``). The first
``--warmup-batches`` are received and checked, but not timed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer, server_flags
from v2v_protocol.command import INTERRUPTED, Parser, run_command
from v2v_protocol.errors import UsageError
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import DEFAULT_ARRAYS
from v2v_protocol.spec_flags import add_spec, asked_recipe, recipe_changes, recipe_setting, spec_fields
from v2v_protocol.write_aside import JSON, write_json

_RSS_EVERY_SECONDS = 0.5
_LEAST_WIDTH = 110
"""Minimum width of a terminal, in characters, for a table with one line per record."""

_COLUMNS = (
    ("workers", "workers", "{}"),
    ("batches_per_second", "batch/s", "{:.2f}"),
    ("samples_per_second", "sample/s", "{:.1f}"),
    ("p50_ms", "p50 ms", "{:.1f}"),
    ("p99_ms", "p99 ms", "{:.1f}"),
    ("cpu_seconds_per_batch", "CPU s/batch", "{:.3f}"),
    ("bytes_per_second", "MB/s", "{:.1f}"),
    ("client_stall_fraction", "stalled", "{:.0%}"),
    ("accelerator_utilisation", "accel.", "{:.0%}"),
    ("peak_rss_bytes", "RSS MB", "{:.0f}"),
    ("lost", "lost", "{}"),
    ("duplicated", "twice", "{}"),
)


class Usage:
    """Measure processor time and memory of this process and, if it started the server, of the server's processes."""

    def __init__(self, server: LocalServer | None) -> None:
        self._server = server
        self._self = psutil.Process()
        self._sampled = -_RSS_EVERY_SECONDS
        self.peak_rss_bytes = 0

    def cpu_seconds(self) -> float:
        mine = self._self.cpu_times()
        theirs = 0.0 if self._server is None else sum(self._server.cpu_seconds().values())
        return mine.user + mine.system + theirs

    def sample(self, now: float) -> None:
        """Record the memory in use, at most every 0.5 s."""
        if now - self._sampled < _RSS_EVERY_SECONDS:
            return
        self._sampled = now
        theirs = 0 if self._server is None else sum(self._server.rss_bytes().values())
        self.peak_rss_bytes = max(self.peak_rss_bytes, self._self.memory_info().rss + theirs)


def percentile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least ``share`` of the values do not exceed (nearest rank)."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def _show(progress: Callable[[float, float, str], object], measured: float, seconds: float, batches: int) -> None:
    rate = f"{batches / measured:.1f} batches/s" if measured > 0 and batches else "warm-up"
    progress(min(measured, seconds), seconds, rate)


def measure(
    dataset: V2VStreamDataset,
    *,
    address: str,
    workers: int | None,
    server: LocalServer | None,
    batch_size: int,
    seconds: float,
    warmup_batches: int,
    trainer_seconds: float,
    progress: Callable[[float, float, str], object] | None = None,
) -> tuple[dict[str, Any], ScheduleCheck]:
    """Consume the dataset for ``seconds`` after warm-up, over as many epochs as needed.

    Ctrl-C ends it early. The record then covers the time until then, and its field ``interrupted`` is True.

    Returns:
        one flat record, and the check of the received samples against the schedule.
    """
    first_epoch = dataset.epoch
    usage = Usage(server)
    check: ScheduleCheck | None = None
    waits: list[float] = []  # of the batches after warm-up
    sums = np.zeros(4)  # of these batches: samples, bytes, decodes, seconds of the workers
    received = epochs = 0
    interrupted = False
    batches = iter(dataset)
    began = ended = time.perf_counter()
    cpu_began = usage.cpu_seconds()
    while not waits or ended - began < seconds:
        asked = time.perf_counter()
        try:
            batch = next(batches, None)
            if batch is None:
                epochs += 1
                batches = iter(dataset)
                batch = next(batches)
        except KeyboardInterrupt:
            if not waits:
                raise
            interrupted = True
            break
        wait = time.perf_counter() - asked
        if check is None:
            stream = dataset.stream
            check = ScheduleCheck(0 if stream is None else stream.sequences, batch_size, first_epoch)
        check.observe(batch.epoch, batch.indices)
        received += 1
        if trainer_seconds:
            time.sleep(trainer_seconds)  # emulates a busy accelerator: the processor is free meanwhile
        ended = time.perf_counter()
        if received <= warmup_batches:
            began, cpu_began = ended, usage.cpu_seconds()
            continue
        usage.sample(ended)
        waits.append(wait)
        sums += len(batch), batch.nbytes, batch.decodes, batch.cpu_seconds
        if progress is not None:
            _show(progress, ended - began, seconds, len(waits))
    samples, nbytes, decodes, worker_seconds = sums.tolist()
    cpu = usage.cpu_seconds() - cpu_began + (worker_seconds if server is None else 0.0)
    elapsed = ended - began
    count = len(waits)
    assert check is not None  # the loop ends after a batch
    record = {
        "workers": workers,
        "batches_per_second": count / elapsed,
        "samples_per_second": samples / elapsed,
        "p50_ms": 1e3 * percentile(waits, 0.5),
        "p99_ms": 1e3 * percentile(waits, 0.99),
        "cpu_seconds_per_batch": cpu / count,
        "bytes_per_second": nbytes / elapsed,
        "client_stall_fraction": sum(waits) / elapsed,
        "peak_rss_bytes": usage.peak_rss_bytes,
        "samples_per_decode": samples / max(decodes, 1),
        "lost": check.lost,
        "duplicated": check.duplicated,
        "foreign": check.foreign,
        "out_of_order": check.out_of_order,
        "accelerator_utilisation": count * trainer_seconds / elapsed if trainer_seconds else None,
        "batches": count,
        "seconds": elapsed,
        "warmup_batches": warmup_batches,
        "batch_size": batch_size,
        "epochs": epochs,
        "interrupted": interrupted,
        "address": address,
    }
    return record, check


def table(records: Sequence[dict[str, Any]], width: int) -> Table:
    """Format the records as a table: one line per record, or one column if ``width`` characters are too few."""
    rows = [[title for _, title, _ in _COLUMNS]]
    for record in records:
        values = {**record, "bytes_per_second": record["bytes_per_second"] / 1e6}
        values["peak_rss_bytes"] = record["peak_rss_bytes"] / 1e6
        rows.append(["-" if values[key] is None else form.format(values[key]) for key, _, form in _COLUMNS])
    if width < _LEAST_WIDTH:
        rows = [list(column) for column in zip(*rows, strict=True)]
    shown = Table(box=None, pad_edge=False, show_header=False)
    for row in rows:
        shown.add_row(*row)
    for column in shown.columns:
        column.justify, column.no_wrap = "right", True
    return shown


def _parser() -> Parser:
    parser = Parser(
        "v2v-loadtest", "(--videos DIR | --connect ADDRESS) [flags]",
        "Measure how fast a server feeds one trainer, and whether samples are lost or repeated.",
        ["v2v-loadtest --videos clips/ --workers 1,2,4", "v2v-loadtest --connect tcp://127.0.0.1:5555 --seconds 60"],
        "Exit status: 0 each sample came once and in order, 1 some did not, 2 wrong usage or no server.",
    )  # fmt: skip
    server, stream, measuring = parser.group("Server"), parser.group("Stream"), parser.group("Measuring")
    source = server.add_mutually_exclusive_group(required=True)
    source.add_argument("--videos", metavar="DIR", help="start a local server on these videos")
    source.add_argument(
        "--connect", metavar="ADDRESS", help="measure a running server, tcp://host:port, or several, comma-separated"
    )
    server.add_argument(
        "--insecure", action="store_true", help="with --connect: without a key, also measure another user's server"
    )
    server.add_argument(
        "--workers", type=_counts, metavar="N,N", help="with --videos: server workers, one run each (default 1,2)"
    )
    server.add_argument("--rows", help="with --videos: rows of the pictures to use, as for v2v-serve")
    stream.add_argument("--batch-size", type=int, default=12, metavar="N", help="samples in a batch (default 12)")
    measuring.add_argument(
        "--seconds", type=float, default=20.0, metavar="S", help="seconds to measure, after warm-up (default 20)"
    )
    measuring.add_argument(
        "--warmup-batches", type=int, default=4, metavar="N", help="batches received first and not timed (default 4)"
    )
    measuring.add_argument(
        "--trainer-ms",
        type=float,
        default=0.0,
        metavar="MS",
        help="emulate a training step of this length, ms (default 0)",
    )
    stream.add_argument(
        "--arrays",
        default=",".join(DEFAULT_ARRAYS),
        metavar="NAME,NAME",
        help="arrays to receive (default %(default)s)",
    )
    stream.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the stream (default 0)")
    measuring.add_argument(
        "--timeout-seconds",
        type=float,
        default=60.0,
        metavar="S",
        help="seconds of silence after which the server counts as lost (default 60)",
    )
    parser.add_output("Measuring", "--json", JSON, "write the records to this file")
    add_spec(parser)
    return parser


def _counts(text: str) -> list[int]:
    counts = [int(part) for part in text.split(",")]
    if min(counts) < 1:
        raise ValueError
    return counts


def _dataset(arguments: argparse.Namespace, address: str) -> V2VStreamDataset:
    return V2VStreamDataset(
        address,
        batch_size=arguments.batch_size,
        arrays=tuple(arguments.arrays.split(",")),
        recipe=recipe_changes(arguments.recipe, arguments.set),
        seed=arguments.seed,
        rank=0,
        world_size=1,
        timeout_seconds=arguments.timeout_seconds,
        keys=None if arguments.connect else "",  # a local server needs no key
        insecure=arguments.insecure,
        **spec_fields(arguments),
    )


def run(arguments: argparse.Namespace) -> int:
    """Measure, print and write the records; return the exit status.

    Raises:
        V2VError: wrong usage, or no server.
    """
    if not (arguments.seconds > 0 and arguments.warmup_batches >= 0 and 0 <= arguments.trainer_ms < math.inf):
        raise UsageError(
            f"--seconds {arguments.seconds:g}, --warmup-batches {arguments.warmup_batches}, --trainer-ms "
            f"{arguments.trainer_ms:g}: give --seconds above 0, and 0 or more of the others"
        )
    if arguments.connect and (arguments.workers or arguments.rows):
        raise UsageError("--workers and --rows need a local server: use them with --videos")
    options = {
        "batch_size": arguments.batch_size,
        "seconds": arguments.seconds,
        "warmup_batches": arguments.warmup_batches,
        "trainer_seconds": arguments.trainer_ms / 1e3,
    }
    results = []
    if not arguments.connect:
        _dataset(arguments, "tcp://127.0.0.1:0")  # report wrong options before a server is started
        # The server checks with its own recipe which videos are long enough, so it gets the stream's.
        recipe = recipe_setting(asked_recipe(arguments), arguments.set) or Recipe()
        flags = server_flags(recipe, vars(arguments), *(("--rows", arguments.rows) if arguments.rows else ()))
    for workers in (None,) if arguments.connect else arguments.workers or (1, 2):
        local = None if workers is None else LocalServer(arguments.videos, workers=workers, flags=flags)
        title = arguments.connect if workers is None else counted(workers, "worker")
        with local or nullcontext() as server, Progress(title, "%") as progress:
            address = arguments.connect if server is None else server.address
            dataset = _dataset(arguments, address)
            results.append(
                measure(dataset, address=address, workers=workers, server=server, progress=progress, **options)
            )
        if results[-1][0]["interrupted"]:
            break
    records = [record for record, _ in results]
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    console.print(table(records, console.width))
    print(
        f"batch size {arguments.batch_size}; {arguments.warmup_batches} warm-up batches not timed; p50 and p99: time "
        "between requesting and receiving a batch; CPU: this process, "
        + ("and what the workers report of each sample (no broker)" if arguments.connect else "server and workers")
    )
    if arguments.json:
        write_json(arguments.json, records)
    if records[-1]["interrupted"]:
        print(f"interrupted after {records[-1]['seconds']:.1f} of {arguments.seconds:g} s", file=sys.stderr)
        return INTERRUPTED
    return 0 if all(check.faultless for _, check in results) else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return run_command(_parser(), run, argv)


if __name__ == "__main__":
    sys.exit(main())


class ScheduleCheck:
    """Count lost, repeated, unexpected and misplaced samples.

    Args:
        sequences: N, the sequences of an epoch.
        batch_size: b, the samples of a batch.
        first_epoch: the epoch consumed first, from its beginning.

    Attributes:
        duplicated: number of samples that came again.
        foreign: number of samples that are not in the schedule.
        out_of_order: number of samples that did not follow their predecessor.
    """

    def __init__(self, sequences: int, batch_size: int, first_epoch: int) -> None:
        self._per_epoch = sequences // batch_size * batch_size
        self._first_epoch = first_epoch
        self._complete = 0  # every ordinal below was seen
        self._beyond: set[int] = set()  # ordinals seen above the first gap
        self._previous = -1
        self._highest = -1
        self.duplicated = 0
        self.foreign = 0
        self.out_of_order = 0

    @property
    def lost(self) -> int:
        """Return the number of missing samples before the last one received."""
        return self._highest + 1 - self._complete - len(self._beyond)

    @property
    def faultless(self) -> bool:
        """Return whether each sample came once and in order."""
        return not (self.lost or self.duplicated or self.foreign or self.out_of_order)

    def observe(self, epoch: int, indices: Iterable[int]) -> None:
        """Record a received batch."""
        for index in indices:
            if epoch < self._first_epoch or not 0 <= index < self._per_epoch:
                self.foreign += 1
                continue
            ordinal = (epoch - self._first_epoch) * self._per_epoch + index
            self.out_of_order += ordinal != self._previous + 1
            self._previous = ordinal
            if ordinal < self._complete or ordinal in self._beyond:
                self.duplicated += 1
                continue
            self._highest = max(self._highest, ordinal)
            self._beyond.add(ordinal)
            while self._complete in self._beyond:
                self._beyond.remove(self._complete)
                self._complete += 1
