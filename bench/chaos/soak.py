"""Stream at full speed for a long time; check that no process grows.

    python -m bench soak --videos DIR --minutes 15 --json soak.json

Resident memory of the broker (the server's main process), of each worker and of the client (this process) is recorded
once a second. A line is fitted to each after the warm-up, a fifth of the time and at most 60 s
(:mod:`bench.processes`). A process grows when its slope exceeds
16 MiB an hour by more than three standard errors.

Bars: no process grows; no sample is lost, duplicated or out of order.
"""

from __future__ import annotations

import argparse
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from bench.frame import Column, Record, Report, add_positive, add_videos, add_whole, beyond
from bench.processes import Fit, fit, roles_of, rss_mib
from v2v_client import loadtest
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser

_POINT_SECONDS = 1.0
_WARM_UP_SHARE = 0.2
_MOST_WARM_UP_SECONDS = 60.0
_STANDARD_ERRORS, MOST_MIB_PER_HOUR = 3.0, 16.0
_ORDER = ("lost", "duplicated", "out_of_order")
_COLUMNS: tuple[Column, ...] = (
    ("process", "process", "{}", 1),
    ("rss_slope_mib_per_minute", "MiB/min", "{:+.3f}", 1),
    ("rss_slope_standard_error_mib_per_minute", "+-", "{:.3f}", 1),
    ("rss_first_mib", "first MiB", "{:.1f}", 1),
    ("rss_last_mib", "last MiB", "{:.1f}", 1),
    ("rss_most_mib", "most MiB", "{:.1f}", 1),
    ("points", "points", "{}", 1),
)
Memory = Mapping[str, Sequence[tuple[float, float]]]
"""(seconds, MiB) of each process, by name: "broker", "worker 0", "client"."""


def soak(dataset: V2VStreamDataset, server: LocalServer, asked: argparse.Namespace) -> tuple[Record, Memory]:
    """Consume as fast as samples come; return the record of the stream and the memory of each process."""
    memory = defaultdict[str, list[tuple[float, float]]](list)

    def note(seconds: float, total: float, text: str) -> None:
        if memory["client"] and seconds < memory["client"][-1][0] + _POINT_SECONDS:
            return
        workers = {f"worker {number}": pid for number, pid in enumerate(roles_of(server)["workers"])}
        for name, pid in {"broker": server.pid, **workers, "client": os.getpid()}.items():
            if (resident := rss_mib(pid)) is not None:
                memory[name].append((seconds, resident))

    record, _ = loadtest.measure(
        dataset, address=server.address, workers=asked.workers, server=server, batch_size=asked.batch_size,
        seconds=60.0 * asked.minutes, warmup_batches=0, trainer_seconds=0.0, progress=note,
    )  # fmt: skip
    return record, memory


def after(memory: Memory, warm_up_seconds: float) -> Memory:
    """Return the memory of each process after the warm-up."""
    return {
        name: [point for point in points if point[0] >= points[0][0] + warm_up_seconds]
        for name, points in memory.items()
    }


def grows(line: Fit, most_mib_per_hour: float) -> bool:
    """Return whether the slope is above the limit by more than three standard errors."""
    return line.slope - most_mib_per_hour / 60.0 > _STANDARD_ERRORS * line.standard_error


def records_of(stream: Record, memory: Memory, fits: Mapping[str, Fit]) -> list[dict[str, Any]]:
    """Return one record for each process, of its memory after the warm-up."""
    return [
        {
            "process": name,
            "rss_slope_mib_per_minute": fits[name].slope,
            "rss_slope_standard_error_mib_per_minute": fits[name].standard_error,
            "rss_first_mib": points[0][1],
            "rss_last_mib": points[-1][1],
            "rss_most_mib": max(mib for _, mib in points),
            "points": len(points),
            "samples": round(stream["samples_per_second"] * stream["seconds"]),
            **{key: stream[key] for key in ("seconds", "samples_per_second", *_ORDER)},
        }
        for name, points in memory.items()
    ]


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser)
    add_positive(parser, "--minutes", 15.0, "duration, minutes")
    add_whole(parser, "--workers", 2, "workers of the server")
    add_whole(parser, "--batch-size", 12, "samples of a batch")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with LocalServer(asked.videos, workers=asked.workers) as server:
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, rank=0, world_size=1)
        stream, memory = soak(dataset, server, asked)
    warm_up = min(_MOST_WARM_UP_SECONDS, _WARM_UP_SHARE * stream["seconds"])
    memory = after(memory, warm_up)
    fits = {name: fit(points) for name, points in memory.items()}
    missed = beyond("stream", stream, most=dict.fromkeys(_ORDER, 0))
    missed += [f"{name} grows" for name, line in fits.items() if grows(line, MOST_MIB_PER_HOUR)]
    records = records_of(stream, memory, fits)
    line = f"{records[0]['samples']} samples in {stream['seconds']:.0f} s; {warm_up:.0f} s of warm-up excluded"
    return Report(records, [(records, _COLUMNS)], lines=[line], missed=missed)
