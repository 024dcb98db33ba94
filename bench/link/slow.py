"""A consumer behind a slow link: batches a second of compressed samples against raw ones, in turns.

    v2v-bench link --videos CLIPS --mbit 1000 --turns 3

The consumer is in a network namespace of its own, behind a cable of that rate (`bench/link/cable.py`), which a
plain TCP connection proves first. Null workers send samples of the paper's recipe that were made from the videos, and
compressed, before: so that not making them but the link is what bounds.

    link busy     bytes that went over the cable, of what it can carry: below some 90 % something else was the bound
    x raw         batches/s of compressed samples over those of raw ones within a turn; median of the turns
    CPU busy      processor time of all that took part, the cable included, of all cores

Bar: 5 times raw. Processors may be the bound where the link is fast and cores are few: then say a slower link.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bench.leases import open_leases, whole_sample
from bench.link.cable import NEAR, Cable, apart
from bench.records import Column, at_least, parser_of, recipe_of, run, say_missed, server_flags, show, write
from bench.speed.null_service import NullService, null_service
from bench.usage import consume
from v2v_client.dataset import V2VStreamDataset
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.variants import warm_up
from v2v_server.system.process import usable_cores

BAR = 5.0
_MTU_BYTES = 9000
"""Of networks between machines of a cluster; and the cable's process has less to do."""
_COLUMNS: tuple[Column, ...] = (
    ("samples", "", "{}", 1.0),
    ("batches_per_second", "batches/s", "{:.2f}", 1.0),
    ("wire_bytes_per_batch", "MB a batch", "{:.2f}", 1e-6),
    ("link_busy", "link busy", "{:.0%}", 1.0),
    ("cpu_busy", "CPU busy", "{:.0%}", 1.0),
    ("workers_cpu_seconds_per_batch", "worker ms", "{:.0f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.0f}", 1e3),
    ("client_cpu_seconds_per_batch", "client ms", "{:.0f}", 1e3),
    ("cable_cpu_seconds_per_batch", "cable ms", "{:.0f}", 1e3),
    ("ratio_to_raw", "x raw", "{:.2f}", 1.0),
    ("ratio_to_raw_lowest", "lowest", "{:.2f}", 1.0),
    ("ratio_to_raw_highest", "highest", "{:.2f}", 1.0),
)


def make_samples(folder: Path, videos: Path, rows: str, recipe: Recipe, count: int) -> None:
    """Writes what :mod:`bench.speed.null_worker` sends: ``NAME.npy``, [count, ...] of each array."""
    warm_up()
    with open_leases(videos, rows, StreamSpec(recipe=recipe)) as (root, leases):
        samples = [whole_sample(lease, root) for lease in islice(leases, count)]
    for name in samples[0].arrays:
        np.save(folder / f"{name}.npy", np.stack([sample.arrays[name] for sample in samples]))


def stretch(service: NullService, cable: Cable, asked: argparse.Namespace, *, compress: bool) -> dict[str, float]:
    """What a consumer on the far host got in one stretch."""
    roles = {**service.roles, "cable": [cable.pid]}
    with cable.on_far_host():
        dataset = V2VStreamDataset(
            service.server.address, batch_size=asked.batch_size, rank=0, world_size=1, compress=compress,
            shared_memory=False,
        )  # fmt: skip
        before = cable.bytes_received()
        done = consume(dataset, roles, seconds=asked.seconds, warmup_batches=2)
        came = cable.bytes_received() - before
    bytes_per_batch = came / (done.batches + 2 + 1)  # the warm-up, and about what was on its way at the end
    return {
        "batches_per_second": done.batches_per_second,
        "wire_bytes_per_batch": bytes_per_batch,
        "link_busy": bytes_per_batch * done.batches_per_second / (asked.mbit * 125e3),
        "cpu_busy": sum(done.cpu_seconds.values()) / done.seconds / usable_cores(),
        **{f"{role}_cpu_seconds_per_batch": done.cpu_seconds_per_batch(role) for role in roles},
    }


def compare(asked: argparse.Namespace, recipe: Recipe, folder: Path) -> list[dict[str, Any]]:
    """Records of raw and of compressed samples: medians over the turns.

    Raises:
        UsageError: the link does not carry what it should.
    """
    flags = [*server_flags(asked.changes), "--bind", f"tcp://{NEAR}:*", "--insecure"]
    found: dict[str, list[dict[str, float]]] = {"raw": [], "compressed": []}
    with Cable(asked.mbit, asked.delay_ms, mtu=_MTU_BYTES) as cable:
        carried = cable.measured_bytes_per_second() / (asked.mbit * 125e3)
        print(f"the cable carries {carried:.0%} of {asked.mbit:g} Mbit/s of plain TCP", file=sys.stderr)
        if not 0.8 <= carried <= 1.05:
            raise UsageError(f"a cable of {asked.mbit:g} Mbit/s carries {carried:.0%} of that here: try fewer --mbit")
        with null_service(recipe, workers=2, flags=flags, samples=folder) as service:
            for _ in range(asked.turns):
                for name, stretches in found.items():
                    stretches.append(stretch(service, cable, asked, compress=name == "compressed"))
    ratios = [
        mine["batches_per_second"] / raw["batches_per_second"]
        for mine, raw in zip(found["compressed"], found["raw"], strict=True)
    ]
    records: list[dict[str, Any]] = [
        {
            "samples": name,
            "mbit": asked.mbit,
            "batch_size": asked.batch_size,
            **{key: statistics.median(each[key] for each in stretches) for key in stretches[0]},
        }
        for name, stretches in found.items()
    ]
    records[1] |= {
        "ratio_to_raw": statistics.median(ratios),
        "ratio_to_raw_lowest": min(ratios),
        "ratio_to_raw_highest": max(ratios),
    }
    return records


def _work(asked: argparse.Namespace) -> int:
    at_least(asked, batch_size=1, turns=1, samples=1)
    recipe = recipe_of(asked.changes)
    with tempfile.TemporaryDirectory(prefix="v2v-link-") as name:
        make_samples(Path(name), asked.videos, asked.rows, recipe, asked.samples)
        records = compare(asked, recipe, Path(name))
    show(records, _COLUMNS)
    write(records, asked.json)
    ratio = records[1]["ratio_to_raw"]
    return say_missed([] if ratio >= BAR else [f"compressed {ratio:.2f} times raw, at least {BAR:g} was asked"])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of(__doc__, "link", seconds=8.0, what="each stretch")
    parser.add_argument("--videos", required=True, type=Path, metavar="DIR", help="what samples are made of")
    parser.add_argument("--rows", default="full")
    parser.add_argument("--mbit", type=float, default=1000.0, help="of the link (default 1000)")
    parser.add_argument("--delay-ms", type=float, default=0.2, help="of each direction (default 0.2)")
    parser.add_argument("--samples", type=int, default=24, help="different ones (default 24)")
    parser.add_argument("--batch-size", type=int, default=12)
    parser.add_argument("--turns", type=int, default=3)
    given = sys.argv[1:] if arguments is None else list(arguments)

    def work(asked: argparse.Namespace) -> int:
        status = apart("bench.link.slow", given)
        return _work(asked) if status is None else status

    return run(parser, work, given)


if __name__ == "__main__":
    sys.exit(main())
