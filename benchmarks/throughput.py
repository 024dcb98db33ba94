"""End to end: the stream against an in-process loader in the released style, and both against decoding alone.

    python -m benchmarks.throughput --videos DIR --workers 2 --seconds 20 --repeat 3 --json throughput.json

All contenders take 12 samples of the paper's recipe a batch from the same clips, with the same number of processes, in
turn, several times over; a ratio is the median of the ratios within a turn, so that a drift of the machine cancels. The
named baseline is ``released``: `benchmarks/released.py` in a torch DataLoader. ``decode`` decodes the frames that the
stream's own jobs need (open, seek and crop included) and does nothing else: nothing that decodes can be faster.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import psutil
from torch.utils.data import DataLoader

from benchmarks.plots import bars, panels
from benchmarks.released import ReleasedStyleDataset
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.spec import StreamSpec
from v2v_server.jobs import describe
from v2v_server.leases import Task
from v2v_server.produce import decode_for
from v2v_server.schedule import Schedule
from v2v_server.sequences import SequenceTable
from v2v_server.video.catalogue import open_catalogue
from v2v_server.video.rows import Rows

BASELINE = "released"
LIMIT = "decode"
BARS = {"exact": 3.0}
"""Least batches/s of a contender, as a multiple of the baseline's."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What is the same for all contenders."""

    videos: Path
    rows: str
    workers: int
    batch_size: int
    seconds: float
    warmup_batches: int


@dataclass(frozen=True, slots=True)
class Measured:
    """One contender in one turn."""

    batches: float
    seconds: float
    cpu_seconds: float

    @property
    def batches_per_second(self) -> float:
        return self.batches / self.seconds

    @property
    def cpu_seconds_per_batch(self) -> float:
        return self.cpu_seconds / self.batches


def released(setting: Setting) -> Measured:
    """The released style: a torch DataLoader whose workers read with OpenCV and simulate in numpy float64."""
    dataset = ReleasedStyleDataset(setting.videos, rows=setting.rows)
    loader = DataLoader(dataset, batch_size=setting.batch_size, num_workers=setting.workers)
    return _measure(setting, lambda: iter(loader), _own_cpu_seconds)


def exact(setting: Setting) -> Measured:
    """The stream, every frame decoded exactly."""
    with LocalServer(setting.videos, workers=setting.workers, flags=["--rows", setting.rows]) as server:

        def batches() -> Iterator[object]:
            dataset = V2VStreamDataset(server.address, batch_size=setting.batch_size, recipe="paper")
            while True:
                yield from dataset

        def cpu_seconds() -> float:
            return sum(server.cpu_seconds().values()) + _cpu_seconds(psutil.Process())

        return _measure(setting, batches, cpu_seconds)


def decode(setting: Setting) -> Measured:
    """Processes that only decode what the stream's jobs need."""
    context = multiprocessing.get_context("spawn")
    counts = [context.Value("q", 0) for _ in range(setting.workers)]
    stop = context.Event()
    processes = [
        context.Process(target=_decode_jobs, args=(setting, number, count, stop)) for number, count in enumerate(counts)
    ]
    for process in processes:
        process.start()

    def batches() -> Iterator[object]:
        given = 0
        while True:
            while sum(count.value for count in counts) < (given + 1) * setting.batch_size:
                if not all(process.is_alive() for process in processes):
                    raise RuntimeError("a decoding process died, see above")
                time.sleep(0.002)
            given += 1
            yield given

    try:
        return _measure(setting, batches, _own_cpu_seconds)
    finally:
        stop.set()
        for process in processes:
            process.join()


def _decode_jobs(setting: Setting, number: int, count: Any, stop: Event) -> None:
    spec = StreamSpec()
    with _catalogue(setting) as catalogue:
        schedule = Schedule.of(SequenceTable(catalogue.videos, catalogue.rows, spec), spec)
        for turn in itertools.count(number, setting.workers):
            if stop.is_set():
                return
            epoch, index = divmod(turn, schedule.count)
            lease = describe(
                Task(b"", epoch, index), number=1, sequence=schedule.candidate(0, epoch, index, 0), quarantine=0,
                catalogue=catalogue, spec=spec, seed=0, arrays=("voxels",), deadline_seconds=60.0,
            )  # fmt: skip
            decode_for(lease, lease.indices, catalogue.root)
            count.value += 1


@contextmanager
def _catalogue(setting: Setting) -> Iterator[Any]:
    catalogue = open_catalogue(setting.videos, rows=Rows.parse(setting.rows), processes=0)
    try:
        yield catalogue
    finally:
        catalogue.close()


def _measure(setting: Setting, batches: Callable[[], Iterator[object]], cpu_seconds: Callable[[], float]) -> Measured:
    """Counts whole batches after the warm-up until the time is over."""
    stream = batches()
    for _ in range(setting.warmup_batches):
        next(stream)
    cpu, started, taken = cpu_seconds(), time.perf_counter(), 0
    while time.perf_counter() - started < setting.seconds:
        next(stream)
        taken += 1
    return Measured(taken, time.perf_counter() - started, cpu_seconds() - cpu)


def _own_cpu_seconds() -> float:
    """Of this process and its children that are alive."""
    own = psutil.Process()
    return sum(_cpu_seconds(process) for process in [own, *own.children(recursive=True)])


def _cpu_seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


CONTENDERS: dict[str, Callable[[Setting], Measured]] = {BASELINE: released, "exact": exact, LIMIT: decode}


def compare(setting: Setting, repeat: int, corpus: str) -> list[dict[str, Any]]:
    """Runs every contender in turn, ``repeat`` times.

    Returns:
        One flat record a contender, medians over the turns.
    """
    turns: list[dict[str, Measured]] = []
    for turn in range(repeat):
        measured = {}
        for name, run in CONTENDERS.items():
            measured[name] = run(setting)
            print(
                f"turn {turn + 1}/{repeat}  {name:9s} {measured[name].batches_per_second:6.3f} batches/s  "
                f"{measured[name].cpu_seconds_per_batch:6.3f} CPU s a batch",
                file=sys.stderr,
                flush=True,
            )
        turns.append(measured)

    def median(of: Callable[[dict[str, Measured]], float]) -> float:
        return statistics.median(of(turn) for turn in turns)

    def record(name: str) -> dict[str, Any]:
        return {
            "name": name,
            "preset": "paper",
            "corpus": corpus,
            "samples_per_decode": 1,
            "workers": setting.workers,
            "batch_size": setting.batch_size,
            "batches_per_second": median(lambda t: t[name].batches_per_second),
            "cpu_seconds_per_batch": median(lambda t: t[name].cpu_seconds_per_batch),
            "ratio_to_baseline": median(lambda t: t[name].batches_per_second / t[BASELINE].batches_per_second),
            "cpu_ratio_to_baseline": median(
                lambda t: t[BASELINE].cpu_seconds_per_batch / t[name].cpu_seconds_per_batch
            ),
            "ratio_to_decode_limit": median(lambda t: t[name].batches_per_second / t[LIMIT].batches_per_second),
            "turns": repeat,
            "seconds": setting.seconds,
            "warmup_batches": setting.warmup_batches,
        }

    return [record(name) for name in CONTENDERS]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--videos", required=True, type=Path, help="clips of at least 201 frames (benchmarks.corpus)")
    parser.add_argument("--corpus", default="source", help="what the clips are, for the records (source / prepared)")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--batch-size", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each contender in each turn")
    parser.add_argument("--repeat", type=int, default=3, help="turns")
    parser.add_argument("--warmup-batches", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the medians")
    arguments = parser.parse_args()
    setting = Setting(
        arguments.videos, arguments.rows, arguments.workers, arguments.batch_size, arguments.seconds,
        arguments.warmup_batches,
    )  # fmt: skip
    records = compare(setting, arguments.repeat, arguments.corpus)
    print(f"{'':10s}{'batches/s':>10s}{'x released':>11s}{'CPU s/batch':>12s}{'CPU x':>8s}{'of decode':>10s}")
    for record in records:
        print(
            f"{record['name']:10s}{record['batches_per_second']:10.3f}{record['ratio_to_baseline']:11.2f}"
            f"{record['cpu_seconds_per_batch']:12.3f}{record['cpu_ratio_to_baseline']:8.2f}"
            f"{record['ratio_to_decode_limit']:10.2f}"
        )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    if arguments.plot is not None:
        with panels(arguments.plot, 2, height_inches=3.0) as (speed, cost):
            bars(speed, {record["name"]: record["batches_per_second"] for record in records}, "batches/s")
            bars(cost, {record["name"]: record["cpu_seconds_per_batch"] for record in records}, "CPU seconds a batch")
    missed = [record for record in records if record["ratio_to_baseline"] < BARS.get(record["name"], 0.0)]
    for record in missed:
        print(
            f"bar missed: {record['name']} {record['ratio_to_baseline']:.2f} < {BARS[record['name']]}", file=sys.stderr
        )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
