"""End to end: the stream under each preset against an in-process loader in the released style, and against decoding.

    v2v-bench throughput --videos DIR --prepared dense=DIR --prepared fast=DIR --seconds 20 --turns 3 --json FILE

All contenders (`bench/speed/contenders.py`) take 12 samples of the paper's recipe a batch, with the same number of
processes, in turn, several times over; a ratio is the median of the ratios within a turn, so that a drift of the
machine cancels. The named baseline is the released style on the source clips; each corpus has its own decode limit,
which a preset with several samples of a decode exceeds. Bars are on ratios, by the clock and by processor time.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.plots import bars, panels
from bench.records import Column, at_least, parser_of, run, say_missed, show, write
from bench.speed.contenders import BASELINE, LIMIT, Contender, Corpus, Measured, Setting, line_up
from v2v_protocol.errors import UsageError
from v2v_protocol.spec import SPEED_PRESETS
from v2v_server.system.process import usable_cores

BARS = {
    "exact, source": 3.3,
    "exact, dense": 25.0,
    "exact, dense-12": 20.0,
    "exact, fast": 25.0,
    "exact, h264": 11.0,
    "fast, h264": 20.0,
}
"""Least multiple of the baseline, by the clock and by processor time, on clips with a keyframe every 250 frames; of
`dense-12`, every 12. `dense` and `fast` are the sizes of a lossless corpus. A name's own bar counts, else that of its
part before the dash."""
LIMIT_BARS = {"exact, source": 0.9}
"""Least share of the decode limit of the same corpus, by the clock."""

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


def compare(contenders: Sequence[Contender], setting: Setting, turns: int) -> list[dict[str, Any]]:
    """Runs every contender in turn, ``turns`` times.

    Returns:
        One flat record a contender, medians over the turns.
    """
    found: list[dict[Contender, Measured]] = []
    for turn in range(turns):
        measured = {}
        for contender in contenders:
            measured[contender] = one = contender.measure(setting)
            print(
                f"turn {turn + 1}/{turns}  {contender.label:18s} {one.batches_per_second:7.3f} batches/s  "
                f"{one.cpu_seconds_per_batch:6.3f} CPU s a batch",
                file=sys.stderr,
                flush=True,
            )
        found.append(measured)
    baseline = contenders[0]
    limits = {contender.corpus: contender for contender in contenders if contender.name == LIMIT}

    def record(of: Contender) -> dict[str, Any]:
        def each(value: Callable[[Measured, Measured, Measured], float]) -> list[float]:
            limit = limits[of.corpus]
            return [value(turn[of], turn[baseline], turn[limit]) for turn in found]

        def median(value: Callable[[Measured, Measured, Measured], float]) -> float:
            return statistics.median(each(value))

        ratios = each(lambda mine, base, limit: mine.batches_per_second / base.batches_per_second)
        return {
            "label": of.label,
            "name": of.name,
            "preset": of.name if of.name in SPEED_PRESETS else None,
            "corpus": of.corpus.name,
            "samples_per_decode": median(lambda mine, base, limit: mine.samples_per_decode),
            "workers": setting.workers,
            "batch_size": setting.batch_size,
            "batches_per_second": median(lambda mine, base, limit: mine.batches_per_second),
            "cpu_seconds_per_batch": median(lambda mine, base, limit: mine.cpu_seconds_per_batch),
            "ratio_to_baseline": statistics.median(ratios),
            "ratio_to_baseline_lowest": min(ratios),
            "ratio_to_baseline_highest": max(ratios),
            "cpu_ratio_to_baseline": median(
                lambda mine, base, limit: base.cpu_seconds_per_batch / mine.cpu_seconds_per_batch
            ),
            "ratio_to_decode_limit": median(
                lambda mine, base, limit: mine.batches_per_second / limit.batches_per_second
            ),
            "turns": turns,
            "seconds": setting.seconds,
            "warmup_batches": setting.warmup_batches,
        }

    return [record(contender) for contender in contenders]


def missed(records: Sequence[dict[str, Any]]) -> list[str]:
    """The bars that these records miss, in words."""
    found = []
    for record in records:
        label = record["label"]
        form = label.partition("-")[0]
        for key, least in (
            ("ratio_to_baseline", BARS.get(label, BARS.get(form, 0.0))),
            ("cpu_ratio_to_baseline", BARS.get(label, BARS.get(form, 0.0))),
            ("ratio_to_decode_limit", LIMIT_BARS.get(form, 0.0)),
        ):
            if record[key] < least:
                found.append(f"{label}: {key} {record[key]:.2f}, at least {least:g} was asked")
    return found


def _prepared(text: str) -> Corpus:
    name, equals, folder = text.partition("=")
    if not equals or not name or not folder:
        raise UsageError(f"--prepared {text}: write NAME=DIR, for instance h264=prepared/")
    return Corpus(name, Path(folder), "full")


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, workers=1, batch_size=1, turns=1, warmup_batches=0)
    unknown = set(asked.presets.split(",")) - set(SPEED_PRESETS)
    if unknown:
        raise UsageError(f"--presets {asked.presets}: choose of {', '.join(SPEED_PRESETS)}")
    source = Corpus("source", asked.videos, asked.rows)
    setting = Setting(asked.workers, asked.batch_size, asked.seconds, asked.warmup_batches)
    contenders = line_up(source, [_prepared(text) for text in asked.prepared], asked.presets.split(","))
    records = compare(contenders, setting, asked.turns)
    show(records, _COLUMNS)
    write(records, asked.json)
    if asked.plot is not None:
        with panels(asked.plot, 2, title="Speed and cost of batches", height_inches=1.4 + 0.3 * len(records)) as (
            speed,
            cost,
        ):
            ratios = {record["label"]: record["ratio_to_baseline"] for record in records}
            bars(speed, ratios, f"batches/s, multiple of {BASELINE}")
            bars(cost, {record["label"]: record["cpu_seconds_per_batch"] for record in records}, "CPU seconds a batch")
    return say_missed(missed(records))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = parser_of(__doc__, "throughput", seconds=20.0, what="each contender in each turn")
    parser.add_argument("--videos", required=True, type=Path, help="clips of at least 201 frames (bench.corpus)")
    parser.add_argument(
        "--prepared", action="append", default=[], metavar="NAME=DIR", help="the same, prepared; several times"
    )
    parser.add_argument("--presets", default=",".join(SPEED_PRESETS), metavar="A,B", help="default: all")
    parser.add_argument("--rows", default="top:0.54", help="of --videos")
    parser.add_argument("--workers", type=int, default=min(2, usable_cores()))
    parser.add_argument("--batch-size", type=int, default=12)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--warmup-batches", type=int, default=4)
    return run(parser, _work, arguments)


if __name__ == "__main__":
    sys.exit(main())
