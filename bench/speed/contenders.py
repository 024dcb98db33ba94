"""Who takes part in the throughput benchmark, and how one of them is measured for some seconds.

All make batches of the paper's recipe from one corpus with the same number of processes:

    released    a torch DataLoader in the released style (`bench/speed/released.py`)
    decode      decodes the frames that the stream's own jobs need (open, seek and crop included) and nothing else:
                nothing that decodes each sample's frames for itself can be faster
    a preset    the stream of `v2v_protocol.spec.SPEED_PRESETS`, from server to batch
"""

from __future__ import annotations

import itertools
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import psutil
from torch.utils.data import DataLoader

from bench.leases import open_leases
from bench.speed.released import ReleasedStyleDataset
from v2v_client import Batch, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.spec import SPEED_PRESETS, StreamSpec
from v2v_server.worker.produce import decode_for

BASELINE = "released"
LIMIT = "decode"


@dataclass(frozen=True, slots=True)
class Corpus:
    """Clips of one form.

    Attributes:
        name: "source", or how it was prepared.
        videos: the folder.
        rows: rows to use; "full" for a prepared folder, whose rows were cut already.
    """

    name: str
    videos: Path
    rows: str


@dataclass(frozen=True, slots=True)
class Setting:
    """What is the same for all contenders."""

    workers: int
    batch_size: int
    seconds: float
    warmup_batches: int


@dataclass(frozen=True, slots=True)
class Measured:
    """One contender in one turn.

    Attributes:
        batches, seconds, cpu_seconds: after the warm-up; the processor time is that of all processes.
        samples_per_decode: achieved.
    """

    batches: int
    seconds: float
    cpu_seconds: float
    samples_per_decode: float = 1.0

    @property
    def batches_per_second(self) -> float:
        """By the clock."""
        return self.batches / self.seconds

    @property
    def cpu_seconds_per_batch(self) -> float:
        """Of all processes together."""
        return self.cpu_seconds / self.batches


@dataclass(frozen=True, slots=True)
class Contender:
    """One line of the table: released, decode or a preset, on one corpus."""

    name: str
    corpus: Corpus

    @property
    def label(self) -> str:
        """``exact, prepared h264``."""
        return f"{self.name}, {self.corpus.name}"

    def measure(self, setting: Setting) -> Measured:
        """One turn."""
        if self.name == BASELINE:
            return _released(self.corpus, setting)
        return _decode(self.corpus, setting) if self.name == LIMIT else _preset(self.name, self.corpus, setting)


def line_up(source: Corpus, prepared: list[Corpus], presets: list[str]) -> list[Contender]:
    """All contenders; each corpus has its own decode limit."""
    names = [LIMIT, *(name for name in SPEED_PRESETS if name in presets)]
    return [Contender(BASELINE, source)] + [Contender(name, corpus) for corpus in (source, *prepared) for name in names]


def _released(corpus: Corpus, setting: Setting) -> Measured:
    dataset = ReleasedStyleDataset(corpus.videos, rows=corpus.rows)
    loader = DataLoader(dataset, batch_size=setting.batch_size, num_workers=setting.workers)
    return _measure(setting, iter(loader), _own_cpu_seconds, burst=setting.workers)


def _preset(name: str, corpus: Corpus, setting: Setting) -> Measured:
    options: dict[str, Any] = {"recipe": "paper", "preset": name}
    with LocalServer(corpus.videos, workers=setting.workers, flags=["--rows", corpus.rows]) as server:
        made = {"samples": 0, "decodes": 0}

        def batches() -> Iterator[Batch]:
            dataset = V2VStreamDataset(server.address, setting.batch_size, **options)
            for batch in itertools.chain.from_iterable(itertools.repeat(dataset)):
                made["samples"] += len(batch)
                made["decodes"] += batch.decodes
                yield batch

        def cpu_seconds() -> float:
            return sum(server.cpu_seconds().values()) + _cpu_seconds(psutil.Process())

        views = int(SPEED_PRESETS[name]["samples_per_decode"])
        measured = _measure(setting, batches(), cpu_seconds, burst=views)
    achieved = made["samples"] / made["decodes"]
    return Measured(measured.batches, measured.seconds, measured.cpu_seconds, achieved)


def _decode(corpus: Corpus, setting: Setting) -> Measured:
    context = multiprocessing.get_context("spawn")
    counts = [context.Value("q", 0) for _ in range(setting.workers)]
    stop = context.Event()
    processes = [
        context.Process(target=_decode_jobs, args=(corpus, setting.workers, number, count, stop), daemon=True)
        for number, count in enumerate(counts)
    ]
    for process in processes:
        process.start()

    def batches() -> Iterator[int]:
        for given in itertools.count(1):
            while sum(count.value for count in counts) < given * setting.batch_size:
                if not all(process.is_alive() for process in processes):
                    raise RuntimeError("a decoding process died, see above")
                time.sleep(0.002)
            yield given

    try:
        return _measure(setting, batches(), _own_cpu_seconds)
    finally:
        stop.set()
        for process in processes:
            process.join()


def _decode_jobs(corpus: Corpus, workers: int, number: int, count: Any, stop: Event) -> None:
    with open_leases(corpus.videos, corpus.rows, StreamSpec()) as (root, leases):
        for lease in itertools.islice(leases, number, None, workers):
            if stop.is_set():
                return
            decode_for(lease, lease.indices, root)
            count.value += 1


def _measure(setting: Setting, stream: Iterator[object], cpu_seconds: Callable[[], float], burst: int = 1) -> Measured:
    """Counts whole batches after the warm-up until the time is over.

    Args:
        burst: batches come so many at a time (each loader process makes one; siblings finish K batches together), so
            that only whole bursts are counted: a window that ended within one would be off by half of it.
    """
    for _ in range(-(-setting.warmup_batches // burst) * burst):
        next(stream)
    cpu, started, taken = cpu_seconds(), time.perf_counter(), 0
    while time.perf_counter() - started < setting.seconds or taken % burst:
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
