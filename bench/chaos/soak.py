"""Stream at full speed for a long time; check that no process grows.

    python -m bench soak --videos DIR --minutes 15 --json soak.json

Resident memory of the broker (the server's main process), of each worker and of the client (this process) is recorded
once a second. A line is fitted to each after the warm-up, a fifth of the time and at most 60 s
(:mod:`bench.processes`). A process grows when its slope exceeds
``--most-mib-per-hour`` by more than three standard errors.

Bars: no process grows; no sample is lost, duplicated or out of order.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

from bench.frame import (
    Column,
    Report,
    add_changes,
    add_positive,
    add_videos,
    add_whole,
    recipe_of,
    server_flags,
    whole,
)  # fmt: skip
from bench.processes import Fit, endless, fit, roles_of, rss_mib
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_client.tools.schedule_check import ScheduleCheck
from v2v_protocol.command import Parser

_POINT_SECONDS = 1.0
_WARM_UP_SHARE = 0.2
_MOST_WARM_UP_SECONDS = 60.0
_STANDARD_ERRORS = 3.0
_COLUMNS: tuple[Column, ...] = (
    ("process", "process", "{}", 1),
    ("rss_slope_mib_per_minute", "MiB/min", "{:+.3f}", 1),
    ("rss_slope_standard_error_mib_per_minute", "+-", "{:.3f}", 1),
    ("rss_first_mib", "first MiB", "{:.1f}", 1),
    ("rss_last_mib", "last MiB", "{:.1f}", 1),
    ("rss_most_mib", "most MiB", "{:.1f}", 1),
    ("points", "points", "{}", 1),
)


@dataclass(slots=True)
class Soak:
    """What was observed.

    Attributes:
        memory: (seconds, MiB) of each process, by name: "broker", "worker 0", "client".
        samples, seconds: of the stream.
        check: of its order.
    """

    memory: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    samples: int = 0
    seconds: float = 0.0
    check: ScheduleCheck = field(default_factory=lambda: ScheduleCheck(0, 1, 0))


def soak(dataset: V2VStreamDataset, server: LocalServer, *, seconds: float, samples: int | None) -> Soak:
    """Consume as fast as samples come: for that time, or that number of samples if it is given."""
    seen = Soak()
    first_epoch = dataset.epoch
    began = next_point = time.monotonic()
    with closing(endless(dataset)) as batches:
        for batch in batches:
            if not seen.samples and dataset.stream is not None:
                seen.check = ScheduleCheck(dataset.stream.sequences, len(batch), first_epoch)
            seen.check.observe(batch.epoch, batch.indices)
            seen.samples += len(batch)
            seen.seconds = time.monotonic() - began
            over = seen.samples >= samples if samples is not None else seen.seconds >= seconds
            if began + seen.seconds >= next_point or over:
                next_point = began + seen.seconds + _POINT_SECONDS
                _note(seen, server)
            if over:
                break
    return seen


def _note(seen: Soak, server: LocalServer) -> None:
    workers = roles_of(server)["workers"]
    pids = {"broker": server.pid, **{f"worker {number}": pid for number, pid in enumerate(workers)}}
    for name, pid in {**pids, "client": os.getpid()}.items():
        if (resident := rss_mib(pid)) is not None:
            seen.memory.setdefault(name, []).append((seen.seconds, resident))


def grows(line: Fit, most_mib_per_hour: float) -> bool:
    """Return whether the slope is above the limit by more than three standard errors."""
    return line.slope - most_mib_per_hour / 60.0 > _STANDARD_ERRORS * line.standard_error


def records_of(seen: Soak, fits: dict[str, Fit]) -> list[dict[str, Any]]:
    """Return one record for each process."""
    return [
        {
            "process": name,
            "rss_slope_mib_per_minute": line.slope,
            "rss_slope_standard_error_mib_per_minute": line.standard_error,
            "rss_first_mib": line.first,
            "rss_last_mib": line.last,
            "rss_most_mib": line.most,
            "points": line.points,
            "samples": seen.samples,
            "seconds": seen.seconds,
            "samples_per_second": seen.samples / seen.seconds,
            **{name: getattr(seen.check, name) for name in ("lost", "duplicated", "out_of_order")},
        }
        for name, line in fits.items()
    ]


def missed(seen: Soak, growing: Iterable[str]) -> list[str]:
    """Return the bars that were missed."""
    counts = {name: getattr(seen.check, name) for name in ("lost", "duplicated", "out_of_order")}
    texts = [f"{count} samples {name.replace('_', ' ')}; the bar is 0" for name, count in counts.items() if count]
    return texts + [f"{name} grows" for name in growing]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser)
    add_positive(parser, "--minutes", 15.0, "duration, minutes")
    parser.add_argument("--samples", type=whole(1), metavar="N", help="stop after this many samples instead")
    add_whole(parser, "--workers", 2, "workers of the server")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_changes(parser)
    add_positive(parser, "--most-mib-per-hour", 16.0, "allowed growth, MiB an hour")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    recipe = recipe_of(asked.changes)
    with LocalServer(asked.videos, workers=asked.workers, flags=server_flags(asked.changes)) as server:
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, recipe=recipe, rank=0, world_size=1)
        seen = soak(dataset, server, seconds=60.0 * asked.minutes, samples=asked.samples)
    warm_up = min(_MOST_WARM_UP_SECONDS, _WARM_UP_SHARE * seen.seconds)
    fits = {name: fit([series], skip_seconds=warm_up) for name, series in seen.memory.items()}
    growing = [name for name, line in fits.items() if grows(line, asked.most_mib_per_hour)]
    records = records_of(seen, fits)
    line = f"{seen.samples} samples in {seen.seconds:.0f} s; {warm_up:.0f} s of warm-up excluded from the fit"
    return Report(records, [(records, _COLUMNS)], lines=[line], missed=missed(seen, growing))
