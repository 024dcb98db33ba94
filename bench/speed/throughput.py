"""Compare the stream, end to end, with a loader in the style of the released one, and with decoding alone.

    python -m bench throughput --videos DIR --prepared dense=DIR --prepared fast=DIR --seconds 20 --turns 3 --json FILE

All contenders make batches of the paper's recipe with the same number of processes, in turns. A ratio is the median of
the ratios within a turn, so that a drift of the machine cancels. Bars are on ratios, by the clock and by CPU time.

    released    the baseline: a torch DataLoader written in the style of the released one (`bench/speed/released.py`),
                on the source clips
    decode      decodes the frames that the stream's samples need (open, seek and crop included) and nothing else: the
                limit of every loader that decodes each sample by itself; each corpus has its own
    a preset    the stream under one of `v2v_protocol.recipe.STREAM_PRESETS`, from server to batch
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from bench.frame import (
    Column,
    Record,
    Report,
    add_positive,
    add_videos,
    add_whole,
    beyond,
    chosen,
    medians,
    progress,
    ratios,
)
from bench.processes import cpu_seconds
from bench.speed.released import ReleasedStyleDataset
from tests.oracles.leases import open_leases
from v2v_client import V2VStreamDataset, loadtest
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser
from v2v_protocol.recipe import STREAM_PRESETS
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.folder import Folder
from v2v_server.system.process import usable_cores
from v2v_server.worker.job import ClipJob
from v2v_server.worker.making.read import decode_for

BASELINE, LIMIT = "released", "decode"
# Least multiple of the baseline, by the clock and by processor time, as docs/performance.md reports it, on clips with a
# keyframe every 250 frames; of
# `dense-12`, every 12. A label without a bar of its own has that of its part before the dash.
BARS = {
    "exact, source": 1.9,
    "exact, dense": 25.0,
    "exact, dense-12": 20.0,
    "exact, fast": 25.0,
}
LIMIT_BARS = {"exact, source": 0.9}  # Least share of the decode limit of the same corpus, by the clock

_COLUMNS: tuple[Column, ...] = (
    ("label", "", "{}", 1.0),
    ("batches_per_second", "batches/s", "{:.3f}", 1.0),
    ("ratio_to_baseline", "x released", "{:.2f}", 1.0),
    ("ratio_to_baseline_lowest", "lowest", "{:.2f}", 1.0),
    ("ratio_to_baseline_highest", "highest", "{:.2f}", 1.0),
    ("cpu_seconds_per_batch", "CPU s/batch", "{:.3f}", 1.0),
    ("cpu_ratio_to_baseline", "CPU x", "{:.2f}", 1.0),
    ("ratio_to_decode_limit", "of decode", "{:.2f}", 1.0),
    ("samples_per_decode", "a decode", "{:.1f}", 1.0),
)


@dataclass(frozen=True, slots=True)
class Corpus:
    """Clips of one form.

    Attributes:
        name: "source", or how it was prepared.
        videos: the folder.
        rows: rows to use; "full" for a prepared folder, which holds only the rows in use.
    """

    name: str
    videos: Path
    rows: str


class Measured(NamedTuple):
    """One contender in one turn: the rates after the warm-up, with the processor time of all processes."""

    batches_per_second: float
    cpu_seconds_per_batch: float
    samples_per_decode: float = 1.0


@dataclass(frozen=True, slots=True)
class Contender:
    """One line of the table: released, decode or a preset, on one corpus."""

    name: str
    corpus: Corpus

    @property
    def label(self) -> str:
        """Return the name for tables, for example ``exact, dense``."""
        return f"{self.name}, {self.corpus.name}"

    def measure(self, asked: argparse.Namespace) -> Measured:
        """Run one turn."""
        if self.name == BASELINE:
            return _loaded(ReleasedStyleDataset(self.corpus.videos, rows=self.corpus.rows), asked)
        return (
            _loaded(_Decoding(self.corpus), asked, "spawn")
            if self.name == LIMIT
            else _preset(self.name, self.corpus, asked)
        )


def line_up(source: Corpus, prepared: list[Corpus], presets: Sequence[str]) -> list[Contender]:
    """Return all contenders, the baseline first; each corpus has its own decode limit."""
    names = [LIMIT, *(name for name in STREAM_PRESETS if name in presets)]
    return [Contender(BASELINE, source)] + [Contender(name, corpus) for corpus in (source, *prepared) for name in names]


class _Decoding(IterableDataset[int]):
    """Decode the frames of one sample after the other, shared among the loader's workers; yield a zero for each."""

    def __init__(self, corpus: Corpus) -> None:
        self._corpus = corpus

    def __iter__(self) -> Iterator[int]:
        worker = get_worker_info()
        assert worker is not None  # a contender has at least one
        with open_leases(self._corpus.videos, self._corpus.rows, StreamSpec()) as (root, leases):
            for lease in itertools.islice(leases, worker.id, None, worker.num_workers):
                decode_for(ClipJob.of(lease), lease.indices, Folder(root))
                yield 0


def _preset(name: str, corpus: Corpus, asked: argparse.Namespace) -> Measured:
    options: dict[str, Any] = {"recipe": "paper", "preset": name}
    with LocalServer(corpus.videos, workers=asked.workers, flags=["--rows", corpus.rows]) as server:
        dataset = V2VStreamDataset(server.address, asked.batch_size, **options)
        record, _ = loadtest.measure(
            dataset, address=server.address, workers=asked.workers, server=server, batch_size=asked.batch_size,
            seconds=asked.seconds, warmup_batches=asked.warmup_batches, trainer_seconds=0.0,
        )  # fmt: skip
    if record["interrupted"]:
        raise KeyboardInterrupt  # v2v-loadtest shows what it has; here the other contenders would follow
    return Measured(*(record[key] for key in Measured._fields))


def _loaded(dataset: Dataset[Any], asked: argparse.Namespace, context: str | None = None) -> Measured:
    """Count the batches of a loader after the warm-up until the time is over.

    Only whole rounds of its workers count, because their batches arrive together.
    """
    stream = iter(DataLoader(dataset, asked.batch_size, num_workers=asked.workers, multiprocessing_context=context))
    for _ in range(-(-asked.warmup_batches // asked.workers) * asked.workers):
        next(stream)
    cpu, started, taken = _own_cpu_seconds(), time.perf_counter(), 0
    while time.perf_counter() - started < asked.seconds or taken % asked.workers:
        next(stream)
        taken += 1
    return Measured(taken / (time.perf_counter() - started), (_own_cpu_seconds() - cpu) / taken)


def _own_cpu_seconds() -> float:
    """Return the processor time of this process and its living children."""
    own = psutil.Process()
    return sum(cpu_seconds(process.pid) for process in [own, *own.children(recursive=True)])


def compare(contenders: Sequence[Contender], asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all contenders in turns; return one record for each, medians over the turns."""
    found: list[dict[Contender, Measured]] = []
    for turn in range(asked.turns):
        found.append({})
        for contender in contenders:
            found[-1][contender] = one = contender.measure(asked)
            cost = f"{one.batches_per_second:.3f} batches/s, {one.cpu_seconds_per_batch:.3f} CPU s a batch"
            progress(f"turn {turn + 1}/{asked.turns}  {contender.label}: {cost}")
    baseline = contenders[0]
    limits = {contender.corpus: contender for contender in contenders if contender.name == LIMIT}

    def each(of: Contender, key: str) -> list[float]:
        return [getattr(turn[of], key) for turn in found]

    def record(of: Contender) -> dict[str, Any]:
        rates, cpu = each(of, "batches_per_second"), each(of, "cpu_seconds_per_batch")
        limit = each(limits[of.corpus], "batches_per_second")
        return {
            "label": of.label,
            "workers": asked.workers,
            "batch_size": asked.batch_size,
            **medians([turn[of]._asdict() for turn in found]),
            **ratios("ratio_to_baseline", rates, each(baseline, "batches_per_second")),
            "cpu_ratio_to_baseline": ratios("cpu", each(baseline, "cpu_seconds_per_batch"), cpu)["cpu"],
            "ratio_to_decode_limit": ratios("limit", rates, limit)["limit"],
            "turns": asked.turns,
            "seconds": asked.seconds,
        }

    return [record(contender) for contender in contenders]


def missed(records: Sequence[Record]) -> list[str]:
    """Return the bars that these records miss."""
    found = []
    for record in records:
        label = record["label"]
        form = label.partition("-")[0]
        least_ratio = BARS.get(label, BARS.get(form, 0.0))
        least = {"ratio_to_baseline": least_ratio, "cpu_ratio_to_baseline": least_ratio}
        found += beyond(label, record, least=least | {"ratio_to_decode_limit": LIMIT_BARS.get(form, 0.0)})
    return found


def _prepared(text: str) -> Corpus:
    name, equals, folder = text.partition("=")
    if not equals or not name or not folder:
        raise argparse.ArgumentTypeError(f"{text}: write NAME=DIR, for example dense=prepared/")
    return Corpus(name, Path(folder), "full")


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "clips of at least 201 frames (python -m bench corpus)", rows="top:0.54")
    parser.add_argument(
        "--prepared", action="append", default=[], type=_prepared, metavar="NAME=DIR",
        help="the same clips, prepared; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--presets", default=",".join(STREAM_PRESETS), metavar="A,B", help="of the stream (default all)"
    )
    add_positive(parser, "--seconds", 20.0, "of each contender in each turn")
    add_whole(parser, "--workers", min(2, usable_cores()), "processes of each contender")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_whole(parser, "--turns", 3, "turns of each contender")
    add_whole(parser, "--warmup-batches", 4, "batches that are not timed", least=0)


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: an unknown preset.
    """
    presets = chosen(asked.presets, STREAM_PRESETS, "--presets")
    contenders = line_up(Corpus("source", asked.videos, asked.rows), asked.prepared, presets)
    records = compare(contenders, asked)
    return Report(records, [(records, _COLUMNS)], missed=missed(records))
