"""Streams at full speed for a long time and shows that no process grows.

    python -m bench.chaos.soak --videos DIR --minutes 15 --json soak.json --plot soak.png
    python -m bench.chaos.soak --videos DIR --samples 2000

Resident memory of the broker (the server's main process), of each of its workers and of the client (this process) is
noted once a second. After the warm-up a line is fitted to each (:mod:`bench.speed.memory`). A process grows when
its slope is above ``--most-mib-per-hour`` by more than three standard errors.

Exit status: 0 no process grows, 1 one does, or a sample was lost or came twice, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from bench.speed.memory import Fit, fit, rss_mib
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_client.tools.loadtest import recipe_of
from v2v_client.tools.schedule_check import ScheduleCheck
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.records import write_json

_POINT_SECONDS = 1.0
_WARM_UP_SHARE = 0.2
_MOST_WARM_UP_SECONDS = 60.0
_STANDARD_ERRORS = 3.0


@dataclass(slots=True)
class Soak:
    """What was observed.

    Attributes:
        memory: (seconds, MiB) of each process, by name: "broker", "worker 0", "client".
        progress: (seconds, samples so far).
        samples, lost, duplicated, out_of_order: of the stream.
        seconds: how long it went on.
    """

    memory: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    progress: list[tuple[float, int]] = field(default_factory=list)
    samples: int = 0
    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    seconds: float = 0.0

    @property
    def faultless(self) -> bool:
        """Every sample came once and in order."""
        return not (self.lost or self.duplicated or self.out_of_order)


def soak(dataset: V2VStreamDataset, server: LocalServer, *, seconds: float, samples: int | None) -> Soak:
    """Consumes as fast as it comes, over as many epochs as that takes.

    Args:
        dataset: to consume.
        server: whose processes are watched.
        seconds: for how long, unless ``samples`` is given.
        samples: how many instead.
    """
    seen = Soak()
    check: ScheduleCheck | None = None
    first_epoch = dataset.epoch
    began = next_point = time.monotonic()
    while True:
        for batch in dataset:
            now = time.monotonic()
            if check is None:
                stream = dataset.stream
                check = ScheduleCheck(0 if stream is None else stream.sequences, len(batch), first_epoch)
            check.observe(batch.epoch, batch.indices)
            seen.samples += len(batch)
            seen.seconds = now - began
            over = seen.samples >= samples if samples is not None else seen.seconds >= seconds
            if now >= next_point or over:
                next_point = now + _POINT_SECONDS
                _note(seen, server, now - began)
            if over:
                seen.lost, seen.duplicated = check.lost, check.duplicated
                seen.out_of_order = check.out_of_order
                return seen


def _note(seen: Soak, server: LocalServer, now: float) -> None:
    workers = [
        child for child in psutil.Process(server.pid).children() if "v2v_server.commands.worker" in child.cmdline()
    ]
    pids = {"broker": server.pid, **{f"worker {number}": child.pid for number, child in enumerate(workers)}}
    for name, pid in {**pids, "client": os.getpid()}.items():
        resident = rss_mib(pid)
        if resident is not None:
            seen.memory.setdefault(name, []).append((now, resident))
    seen.progress.append((now, seen.samples))


def grows(line: Fit, most_mib_per_hour: float) -> bool:
    """Whether the slope is above the limit beyond doubt."""
    return line.slope - most_mib_per_hour / 60.0 > _STANDARD_ERRORS * line.standard_error


def records_of(seen: Soak, fits: dict[str, Fit], asked: argparse.Namespace) -> list[dict[str, Any]]:
    """One flat record for each process."""
    whole = {
        "samples": seen.samples,
        "seconds": seen.seconds,
        "samples_per_second": seen.samples / seen.seconds,
        "lost": seen.lost,
        "duplicated": seen.duplicated,
        "workers": asked.workers,
        "batch_size": asked.batch_size,
    }
    return [
        {
            "process": name,
            "rss_slope_mib_per_minute": line.slope,
            "rss_slope_standard_error_mib_per_minute": line.standard_error,
            "rss_first_mib": line.first,
            "rss_last_mib": line.last,
            "rss_most_mib": line.most,
            "residual_mib": line.residual,
            "autocorrelation": line.autocorrelation,
            "points": line.points,
            "grows": grows(line, asked.most_mib_per_hour),
            **whole,
        }
        for name, line in fits.items()
    ]


def plot(file: Path, memory: dict[str, list[tuple[float, float]]], fits: dict[str, Fit], warm_up: float) -> None:
    """Memory over time, each process relative to its own mean after warm-up, with the lines that were fitted."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 5))
    for name, series in memory.items():
        after = [(at, mib) for at, mib in series if at - series[0][0] >= warm_up]
        mean_at = sum(at for at, _ in after) / len(after)
        mean = sum(mib for _, mib in after) / len(after)
        label = f"{name}: {mean:.0f} MiB"
        drawn = axes.plot([at / 60 for at, _ in series], [mib - mean for _, mib in series], label=label)
        line = [(at / 60, fits[name].slope * (at - mean_at) / 60) for at, _ in after]
        axes.plot([at for at, _ in line], [mib for _, mib in line], "--", color=drawn[0].get_color())
    axes.axvline(warm_up / 60, color="grey", linewidth=0.8)
    axes.set_title("Memory of each process over the soak, and the slope fitted to it")
    axes.set_xlabel("minutes")
    axes.set_ylabel("resident memory less its mean after warm-up, MiB")
    axes.legend()
    figure.tight_layout()
    figure.savefig(file)
    pyplot.close(figure)


def _warm_up(asked: argparse.Namespace, seen: Soak) -> float:
    if asked.warmup_seconds is not None:
        return float(asked.warmup_seconds)
    return min(_MOST_WARM_UP_SECONDS, _WARM_UP_SHARE * seen.seconds)


def run(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or no server.
    """
    counts = [asked.workers, asked.batch_size, *([] if asked.samples is None else [asked.samples])]
    if asked.minutes <= 0 or min(counts) < 1:
        raise UsageError("--minutes is more than 0; --samples, --workers and --batch-size are 1 or more")
    recipe = recipe_of(asked.recipe, asked.changes)
    flags = [flag for change in asked.changes for flag in ("--set", change)]
    flags += [] if asked.recipe is None else ["--recipe", asked.recipe]
    with LocalServer(asked.videos, workers=asked.workers, flags=flags) as server:
        dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, recipe=recipe, rank=0, world_size=1)
        seen = soak(dataset, server, seconds=60.0 * asked.minutes, samples=asked.samples)
    warm_up = _warm_up(asked, seen)
    fits = {name: fit([series], skip_seconds=warm_up) for name, series in seen.memory.items()}
    records = records_of(seen, fits, asked)
    _show(records, fits, seen, warm_up)
    if asked.json is not None:
        write_json(asked.json, records)
    if asked.plot is not None:
        plot(asked.plot, seen.memory, fits, warm_up)
    return 1 if not seen.faultless or any(record["grows"] for record in records) else 0


def _show(records: list[dict[str, Any]], fits: dict[str, Fit], seen: Soak, warm_up: float) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("process", "MiB/min", "+-", "first MiB", "last MiB", "most MiB", "points", "grows"):
        table.add_column(title, justify="left" if title == "process" else "right")
    for record in records:
        line = fits[record["process"]]
        figures = (line.slope, line.standard_error, line.first, line.last, line.most)
        shown = [f"{figure:+.3f}" if place == 0 else f"{figure:.3f}" for place, figure in enumerate(figures[:2])]
        shown += [f"{figure:.1f}" for figure in figures[2:]]
        table.add_row(record["process"], *shown, str(line.points), "yes" if record["grows"] else "no")
    Console(width=None if sys.stdout.isatty() else 120, highlight=False).print(table)
    print(
        f"{seen.samples} samples in {seen.seconds:.0f} s, {seen.samples / seen.seconds:.1f} samples/s; lost "
        f"{seen.lost}, twice {seen.duplicated}, out of order {seen.out_of_order}; {warm_up:.0f} s of warm-up not fitted"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="python -m bench.chaos.soak",
        description=first,
        epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR")
    parser.add_argument("--minutes", type=float, default=15.0, help="how long (default 15)")
    parser.add_argument("--samples", type=int, metavar="N", help="stop after so many instead")
    parser.add_argument("--workers", type=int, default=2, help="server workers (default 2)")
    parser.add_argument("--batch-size", type=int, default=12, help="default 12")
    parser.add_argument("--recipe", metavar="PRESET", help="default: paper")
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="recipe field")
    parser.add_argument("--warmup-seconds", type=float, metavar="S", help="left out of the fit (a fifth, at most 60)")
    parser.add_argument(
        "--most-mib-per-hour", type=float, default=16.0, metavar="MIB", help="allowed growth (default 16)"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw memory over time")
    asked = parser.parse_args(arguments)
    try:
        return run(asked)
    except (V2VError, OSError) as error:
        print(f"soak: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
