"""Where the limits lie: each part of the way from a video to a batch, alone and at full speed.

    python -m bench.limits --videos CLIPS --json limits.json --plot limits.png

    decode      the frames that the stream's own jobs need: open, seek, decode, crop; one thread
    kernel      view, simulation and frame gathering on clips that are decoded already; one thread
    sample      whole samples as a server worker makes them; one thread. What it takes beyond decode and kernel is
                the worker's own: drawing, checking, wrapping
    wire        real samples from one process to another, without a server in between
    broker      null workers, the server and a V2VStreamDataset: everything but decode and kernel
    copy        copying a batch from memory to memory, the least that any transport does; one thread

The parts run one after the other. Processor time is what to compare; batches a second by the clock are those of a
machine with whatever else it was doing, and of as many processes as the part has.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bench import plots
from bench.leases import open_leases, whole_sample
from bench.records import at_least, parser_of, recipe_of, run, server_flags, show, write
from bench.speed.null_service import null_service
from bench.speed.routes import Route, travel
from bench.usage import consume
from v2v_client.dataset import V2VStreamDataset
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.variants import warm_up
from v2v_server.simulation.view import apply_view
from v2v_server.worker.produce import Decoded, decode_for

_COLUMNS = (
    ("part", "", "{}", 1),
    ("cpu_seconds_per_batch", "CPU ms/batch", "{:.1f}", 1e3),
    ("batches_per_cpu_second", "batches/CPU s", "{:.2f}", 1),
    ("bytes_per_cpu_second", "GB/CPU s", "{:.3f}", 1e-9),
    ("batches_per_second", "batches/s", "{:.2f}", 1),
    ("processes", "processes", "{}", 1),
)


def repeated(work: Iterator[object] | Callable[[], object], seconds: float) -> tuple[int, float, float]:
    """Does it over and over for that long, at least once: (times, seconds, CPU seconds of this process)."""
    step = work if callable(work) else lambda: next(work)
    began, cpu, times = time.perf_counter(), time.process_time(), 0
    while not times or time.perf_counter() - began < seconds:
        step()
        times += 1
    return times, time.perf_counter() - began, time.process_time() - cpu


def kernel(decoded: Decoded) -> object:
    """What a server worker does with a decoded clip (``v2v_server.worker.produce.make_sample``)."""
    plan = decoded.plan
    params, recipe = plan.params, plan.spec.recipe
    view = apply_view(decoded.clip.frames, params, recipe)
    voxels = simulate_clip(view, params, recipe, plan.spec.voxel_dtype)
    return voxels, view[plan.source[list(recipe.target_steps)], None]


def made_alone(
    videos: Path, rows: str, recipe: Recipe, batch_size: int, seconds: float
) -> tuple[list[dict[str, Any]], list[Sample]]:
    """Records of decode, kernel and sample, and some samples. Each starts with the same jobs."""
    warm_up()
    times: dict[str, tuple[int, float, float]] = {}
    spec = StreamSpec(recipe=recipe)
    with open_leases(videos, rows, spec) as (root, leases):
        times["decode"] = repeated((decode_for(lease, lease.indices, root) for lease in leases), seconds)
    with open_leases(videos, rows, spec) as (root, leases):
        clips = [decode_for(lease, lease.indices, root)[0] for lease in islice(leases, batch_size)]
    turns = (kernel(clips[number % batch_size]) for number in range(sys.maxsize))
    times["kernel"] = repeated(turns, seconds)
    with open_leases(videos, rows, spec) as (root, leases):
        samples = [whole_sample(lease, root) for lease in islice(leases, batch_size)]
    with open_leases(videos, rows, spec) as (root, leases):
        times["sample"] = repeated((whole_sample(lease, root) for lease in leases), seconds)
    nbytes = batch_size * sum(array.nbytes for array in samples[0].arrays.values())
    return [
        _record(part, count / batch_size, elapsed, cpu, nbytes, processes=1)
        for part, (count, elapsed, cpu) in times.items()
    ], samples


def copied(nbytes: int, seconds: float) -> dict[str, Any]:
    """The record of copying a batch, both sides larger than a cache."""
    source, target = np.ones(nbytes, np.uint8), np.zeros(nbytes, np.uint8)
    count, elapsed, cpu = repeated(lambda: np.copyto(target, source), seconds)
    return _record("copy", count, elapsed, cpu, nbytes, processes=1)


def brokered(recipe: Recipe, flags: Sequence[str], batch_size: int, seconds: float) -> dict[str, Any]:
    """The record of the whole product but for decode and kernel."""
    with null_service(recipe, workers=2, flags=flags) as service:
        dataset = V2VStreamDataset(service.server.address, batch_size=batch_size, rank=0, world_size=1)
        done = consume(dataset, service.roles, seconds=seconds, warmup_batches=2)
    cpu, nbytes = sum(done.cpu_seconds.values()), done.nbytes // done.batches
    return _record("broker", done.batches, done.seconds, cpu, nbytes, processes=3) | {
        f"{role}_cpu_seconds_per_batch": done.cpu_seconds_per_batch(role) for role in done.cpu_seconds
    }


def _record(part: str, batches: float, seconds: float, cpu: float, nbytes: int, processes: int) -> dict[str, Any]:
    return {
        "part": part,
        "cpu_seconds_per_batch": cpu / batches,
        "batches_per_cpu_second": batches / cpu,
        "bytes_per_cpu_second": nbytes * batches / cpu,
        "batches_per_second": batches / seconds,
        "bytes_per_batch": nbytes,
        "batches": batches,
        "seconds": seconds,
        "processes": processes,
    }


def work(asked: argparse.Namespace) -> int:
    """Measures, prints, writes; returns the exit status.

    Raises:
        V2VError: wrong usage, or a process that died.
    """
    at_least(asked, batch_size=1)
    recipe, size = recipe_of(asked.changes), asked.batch_size
    records, samples = made_alone(asked.videos, asked.rows, recipe, size, asked.seconds)
    nbytes = records[0]["bytes_per_batch"]
    direct = travel(Route("wire", relay=False), samples, batch_size=size, seconds=asked.seconds)
    records.append(
        _record("wire", direct.batches, direct.seconds, sum(direct.cpu_seconds.values()), nbytes, processes=2)
    )
    records.append(brokered(recipe, server_flags(asked.changes), size, asked.seconds))
    records.append(copied(nbytes, asked.seconds))
    records = [record | {"batch_size": size} for record in records]
    show(records, _COLUMNS)
    cost = {record["part"]: record["cpu_seconds_per_batch"] for record in records}
    rest = cost["sample"] - cost["decode"] - cost["kernel"]
    print(
        f"of a sample: decode {cost['decode'] / cost['sample']:.1%}, kernel {cost['kernel'] / cost['sample']:.1%}, "
        f"the rest {rest / cost['sample']:.1%}; moving it costs {cost['broker'] / cost['sample']:.1%} of making it"
    )
    write(records, asked.json)
    if asked.plot is not None:
        values = {record["part"]: record["batches_per_cpu_second"] for record in records}
        with plots.panels(asked.plot, title="Upper limits of speed") as (axes,):
            plots.bars(axes, values, f"batches of {size} a second of processor time", log=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "limits", seconds=5.0, what="each part")
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR")
    parser.add_argument("--rows", default="top:0.54")
    parser.add_argument("--batch-size", type=int, default=12)
    return run(parser, work, arguments)


if __name__ == "__main__":
    sys.exit(main())
