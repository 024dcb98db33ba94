"""What moving samples costs, by way of moving them, against what making them costs.

    python -m benchmarks.transport --videos CLIPS --fast-videos PREPARED --json transport.json --plot transport.png

The first row is the product as it stands: null workers, the server, a V2VStreamDataset; the second the same without
shared memory. The others are prototypes (:mod:`benchmarks.routes`) over a bare relay, so they are to be compared with
"message", and what the server's own bookkeeping costs is the difference between that and the second row. Figures are
processor time, which a busy machine changes less than the clock.

Production is exact mode on ``--videos``, and the fastest preset on ``--fast-videos`` (a prepared folder).

Exit status: 0 what stands costs at most 5 % of production in exact mode and 10 % at the fastest; 1 it costs more;
2 wrong usage.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import plots
from benchmarks.jobs import open_jobs
from benchmarks.null_service import null_service
from benchmarks.records import parser_of, recipe_of, run, say_missed, server_flags, show, write
from benchmarks.routes import Route, missing, travel
from benchmarks.usage import consume
from v2v_client.dataset import V2VStreamDataset
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import SPEED_PRESETS, StreamSpec
from v2v_server.clips import Clips
from v2v_server.produce import make_sample
from v2v_server.simulation.clip import warm_up

STANDING = "as it stands"
IN_MESSAGES = "as it stands, in messages"
MOST_OF_EXACT, MOST_OF_FASTEST = 0.05, 0.10
"""Bars: processor time of the transport, as shares of production."""

ROUTES = (
    Route("message, memory not kept", keep=False),
    Route("message"),
    Route("message, no relay", relay=False),
    Route("shared memory", "shared"),
    Route("shared memory, in place", "in place"),
    Route("zstd-1", codec="zstd-1"),
    Route("lz4", codec="lz4"),
    Route("blosc2", codec="blosc2"),
    Route("CURVE", curve=True),
    Route("zstd-1, CURVE", codec="zstd-1", curve=True),
)
_COLUMNS = (
    ("name", "", "{}", 1),
    ("sender_cpu_seconds_per_batch", "sender ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("receiver_cpu_seconds_per_batch", "receiver ms", "{:.1f}", 1e3),
    ("cpu_seconds_per_batch", "CPU ms/batch", "{:.1f}", 1e3),
    ("share_of_exact", "of exact", "{:.1%}", 1),
    ("share_of_fastest", "of fastest", "{:.1%}", 1),
    ("wire_bytes_per_batch", "wire MB", "{:.1f}", 1e-6),
    ("batches_per_second", "batches/s", "{:.1f}", 1),
    ("skipped", "skipped", "{}", 1),
)


def production(
    videos: Path, rows: str, recipe: Recipe, seconds: float, keep: int, samples_per_decode: int = 1
) -> tuple[float, list[Sample]]:
    """CPU seconds of one sample, made in this process for that long, and the first ``keep`` (so many at least)."""
    warm_up()
    samples: list[Sample] = []
    # Siblings one after the other: each clip is decoded, then all its samples are made.
    spec = StreamSpec(recipe=recipe, samples_per_decode=samples_per_decode, sibling_spacing=int(samples_per_decode > 1))
    with open_jobs(videos, rows, spec) as (root, leases):
        clips = Clips(root)
        made, began, cpu = 0, time.perf_counter(), time.process_time()
        for lease in leases:
            sample = make_sample(lease, clips.take(lease)[0])
            made += 1
            if made <= keep:
                samples.append(sample)
            elif time.perf_counter() - began >= seconds and made % samples_per_decode == 0:
                break
        return (time.process_time() - cpu) / made, samples


def standing(
    recipe: Recipe, flags: Sequence[str], batch_size: int, seconds: float, *, shared_memory: bool
) -> dict[str, Any]:
    """The record of the product as it is."""
    with null_service(recipe, workers=2, flags=flags) as service:
        dataset = V2VStreamDataset(
            service.server.address, batch_size=batch_size, rank=0, world_size=1, shared_memory=shared_memory
        )
        consumed = consume(dataset, service.roles, seconds=seconds, warmup_batches=2)
    return {
        "name": STANDING if shared_memory else IN_MESSAGES,
        "sender_cpu_seconds_per_batch": consumed.cpu_seconds_per_batch("workers"),
        "broker_cpu_seconds_per_batch": consumed.cpu_seconds_per_batch("broker"),
        "receiver_cpu_seconds_per_batch": consumed.cpu_seconds_per_batch("client"),
        "cpu_seconds_per_batch": consumed.cpu_seconds_per_batch(),
        "batches_per_second": consumed.batches_per_second,
    }


def prototype(route: Route, samples: Sequence[Sample], batch_size: int, seconds: float) -> dict[str, Any]:
    """The record of a route; with a reason instead of figures where it cannot be had here."""
    why = missing(route.codec) if route.codec else None
    if why is not None:
        return {"name": route.name, "skipped": why}
    travelled = travel(route, samples, batch_size=batch_size, seconds=seconds)
    each = {f"{role}_cpu_seconds_per_batch": used / travelled.batches for role, used in travelled.cpu_seconds.items()}
    return {
        "name": route.name,
        **each,
        "cpu_seconds_per_batch": sum(each.values()),
        "wire_bytes_per_batch": travelled.wire_bytes / travelled.batches,
        "batches_per_second": travelled.batches / travelled.seconds,
    }


def missed_bars(record: dict[str, Any]) -> list[str]:
    """The bars that what stands does not keep."""
    bars = (("share_of_exact", "exact mode", MOST_OF_EXACT), ("share_of_fastest", "the fastest", MOST_OF_FASTEST))
    return [
        f"transport costs {record[key]:.1%} of production in {name}; the bar is {most:.0%}"
        for key, name, most in bars
        if record.get(key) is not None and record[key] > most
    ]


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or a process that died.
    """
    recipe, size = recipe_of(asked.changes), asked.batch_size
    exact, samples = production(asked.videos, asked.rows, recipe, asked.seconds, keep=size)
    fastest = None
    if asked.fast_videos is not None:
        views = int(SPEED_PRESETS["fast"]["samples_per_decode"])
        fastest, _ = production(asked.fast_videos, asked.fast_rows, recipe, asked.seconds, 1, views)
    flags = server_flags(asked.changes)
    records = [standing(recipe, flags, size, asked.seconds, shared_memory=shared) for shared in (True, False)]
    records += [prototype(route, samples, size, asked.seconds) for route in ROUTES]
    for record in records:
        record |= {
            "batch_size": size,
            "exact_cpu_seconds_per_batch": exact * size,
            "fastest_cpu_seconds_per_batch": None if fastest is None else fastest * size,
        }
        if "skipped" not in record:
            record["share_of_exact"] = record["cpu_seconds_per_batch"] / (exact * size)
            record["share_of_fastest"] = None if fastest is None else record["cpu_seconds_per_batch"] / (fastest * size)
    show(records, _COLUMNS)
    also = "" if fastest is None else f", at the fastest {fastest * size * 1e3:.0f} ms"
    print(f"production of a batch of {size}: exact {exact * size * 1e3:.0f} ms of processor time{also}")
    write(records, asked.json)
    if asked.plot is not None:
        plot(asked.plot, records)
    return say_missed(missed_bars(records[0]))


def plot(file: Path, records: Sequence[dict[str, Any]]) -> None:
    """Processor time by role, with the bars."""
    roles = ("sender", "broker", "receiver")
    parts = {
        record["name"]: {role: 1e3 * record[f"{role}_cpu_seconds_per_batch"] for role in roles}
        for record in records
        if "skipped" not in record
    }
    first = records[0]
    limits = {"5 % of exact mode": 1e3 * MOST_OF_EXACT * first["exact_cpu_seconds_per_batch"]}
    if first["fastest_cpu_seconds_per_batch"] is not None:
        limits["10 % of the fastest"] = 1e3 * MOST_OF_FASTEST * first["fastest_cpu_seconds_per_batch"]
    with plots.panels(file, 1, height_inches=5.0) as (axes,):
        plots.stacked_bars(axes, parts, "processor time, ms a batch", limits=limits)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "transport", seconds=5.0, what="each row")
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR", help="clips of exact mode")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument(
        "--fast-videos", type=Path, metavar="DIR", help="clips of the fastest preset (a prepared folder)"
    )
    parser.add_argument("--fast-rows", default="full")
    parser.add_argument("--batch-size", type=int, default=12)
    return run(parser, work, arguments)


if __name__ == "__main__":
    sys.exit(main())
