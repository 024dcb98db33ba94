"""What moving samples costs beside making them, and what other ways of moving them would cost.

    python -m bench.speed.transport --videos CLIPS --fast-videos PREPARED --json transport.json --plot transport.png

The first rows are the product at work: workers, the server, a V2VStreamDataset, over whole epochs, so that nothing is
under way at either end. What the workers say that a sample took to make is making it; all other processor time of
all processes is moving it. The preset "exact" is run on ``--videos``, "fast" on ``--fast-videos`` (a prepared folder).

Then the product with workers that make nothing, with and without shared memory, and prototypes
(:mod:`bench.speed.routes`) over a bare relay, so they are to be compared with "message", and what the server's own
bookkeeping costs is the difference between that and "null workers, messages". Figures are processor time, which a busy
machine changes less than the clock.

Exit status: 0 moving is at most 5 % of all in exact mode and 10 % at the fastest; 1 it is more; 2 wrong usage.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench import plots
from bench.leases import open_leases
from bench.records import parser_of, recipe_of, run, say_missed, server_flags, show, write
from bench.speed.null_service import null_service
from bench.speed.routes import Route, missing, travel
from bench.usage import Meter, consume, roles_of
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import SpeedPreset, StreamSpec
from v2v_server.simulation.variants import warm_up
from v2v_server.worker.decode_cache import Clips
from v2v_server.worker.produce import make_sample

NULL_SHARED, NULL_MESSAGES = "null workers, shared memory", "null workers, messages"
MOST = {"exact": 0.05, "fast": 0.10}
"""Bars: what is not making samples, as a share of all processor time, by preset."""
WORKERS = 2
_SETTLE_SECONDS = 0.3

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
    ("making_cpu_seconds_per_batch", "making ms", "{:.0f}", 1e3),
    ("sender_cpu_seconds_per_batch", "sender ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("receiver_cpu_seconds_per_batch", "receiver ms", "{:.1f}", 1e3),
    ("cpu_seconds_per_batch", "moving ms", "{:.1f}", 1e3),
    ("share", "of all", "{:.1%}", 1),
    ("wire_bytes_per_batch", "wire MB", "{:.1f}", 1e-6),
    ("batches_per_second", "batches/s", "{:.1f}", 1),
    ("skipped", "skipped", "{}", 1),
)


def some_samples(videos: Path, rows: str, recipe: Recipe, count: int) -> list[Sample]:
    """Samples as the server makes them, at most as many as an epoch has."""
    warm_up()
    with open_leases(videos, rows, StreamSpec(recipe=recipe)) as (root, leases):
        clips = Clips(root)
        return [make_sample(lease, clips.take(lease)[0]) for lease in itertools.islice(leases, count)]


def at_work(
    preset: SpeedPreset, videos: Path, rows: str, flags: Sequence[str], batch_size: int, seconds: float
) -> dict[str, Any]:
    """The record of the product: whole epochs, after one that warms it up, until that much time is over."""
    with LocalServer(videos, workers=WORKERS, flags=["--rows", rows, *flags]) as server:
        dataset = V2VStreamDataset(server.address, batch_size, rank=0, world_size=1, preset=preset)
        for _ in dataset:
            pass
        meter, began, batches, making = Meter(roles_of(server)), time.perf_counter(), 0, 0.0
        while not batches or time.perf_counter() - began < seconds:
            for batch in dataset:
                batches, making = batches + 1, making + batch.cpu_seconds
        elapsed = time.perf_counter() - began
        time.sleep(_SETTLE_SECONDS)  # the goodbye, and what the server does about it
        used = meter.used()
    moving = sum(used.values()) - making
    return {
        "name": f"{preset}, at work",
        "preset": preset,
        "making_cpu_seconds_per_batch": making / batches,
        "sender_cpu_seconds_per_batch": (used["workers"] - making) / batches,
        "broker_cpu_seconds_per_batch": used["broker"] / batches,
        "receiver_cpu_seconds_per_batch": used["client"] / batches,
        "cpu_seconds_per_batch": moving / batches,
        "share": moving / (moving + making),
        "batches_per_second": batches / elapsed,
    }


def with_null_workers(
    recipe: Recipe, flags: Sequence[str], batch_size: int, seconds: float, *, shared_memory: bool
) -> dict[str, Any]:
    """The record of the product with workers that make nothing."""
    with null_service(recipe, workers=WORKERS, flags=flags) as service:
        dataset = V2VStreamDataset(
            service.server.address, batch_size=batch_size, rank=0, world_size=1, shared_memory=shared_memory
        )
        consumed = consume(dataset, service.roles, seconds=seconds, warmup_batches=2)
    return {
        "name": NULL_SHARED if shared_memory else NULL_MESSAGES,
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


def missed_bars(records: Sequence[dict[str, Any]]) -> list[str]:
    """The bars that the product does not keep."""
    return [
        f"moving samples takes {record['share']:.1%} of all processor time under preset {record['preset']}; "
        f"the bar is {MOST[record['preset']]:.0%}"
        for record in records
        if "share" in record and record["share"] > MOST[record["preset"]]
    ]


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or a process that died.
    """
    recipe, size, flags = recipe_of(asked.changes), asked.batch_size, server_flags(asked.changes)
    runs: list[tuple[SpeedPreset, Path, str]] = [("exact", asked.videos, asked.rows)]
    if asked.fast_videos is not None:
        runs.append(("fast", asked.fast_videos, asked.fast_rows))
    records = [at_work(*of, flags, size, asked.seconds) for of in runs]
    records += [with_null_workers(recipe, flags, size, asked.seconds, shared_memory=shared) for shared in (True, False)]
    samples = some_samples(asked.videos, asked.rows, recipe, size)
    records += [prototype(route, samples, size, asked.seconds) for route in ROUTES]
    for record in records:
        record["batch_size"] = size
    show(records, _COLUMNS)
    write(records, asked.json)
    if asked.plot is not None:
        plot(asked.plot, records)
    return say_missed(missed_bars(records))


def plot(file: Path, records: Sequence[dict[str, Any]]) -> None:
    """Processor time by role, with the bars."""
    roles = ("sender", "broker", "receiver")
    parts = {
        record["name"]: {role: 1e3 * record[f"{role}_cpu_seconds_per_batch"] for role in roles}
        for record in records
        if "skipped" not in record
    }
    limits = {}
    for record in records:
        if "share" in record:
            most = MOST[record["preset"]]
            # Of the whole, so that moving may take most / (1 - most) of what making takes.
            limits[f"{most:.0%} of {record['preset']}"] = (
                1e3 * record["making_cpu_seconds_per_batch"] * most / (1 - most)
            )
    with plots.panels(file, 1, title="What moving a batch costs", height_inches=5.0) as (axes,):
        plots.stacked_bars(axes, parts, "processor time of moving a batch, ms", limits=limits)


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
