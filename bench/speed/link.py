"""Compare compressed samples with raw ones for a consumer behind a slow link.

    python -m bench link --videos CLIPS --mbit 1000 --turns 3

The consumer runs in its own network namespace behind an emulated cable (`bench/cable.py`). Null workers send samples of
the paper's recipe that were made and compressed ahead, so that the link is the limit.

    link busy     bytes over the cable, as a share of its rate; below 90 % something else is the limit
    x raw         batches/s of compressed samples over those of raw ones within a turn; median of the turns
    CPU busy      processor time of all processes, the cable included, as a share of all cores

Bar: 5 times raw. Where processors are the limit, give a slower link.
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bench.cable import NEAR, Cable
from bench.frame import Column, Report, add_positive, add_videos, add_whole, beyond, medians, ratios
from bench.processes import consume
from bench.speed.null_workers import NullService, null_service
from tests.oracles.leases import open_leases, whole_sample
from v2v_client.dataset import V2VStreamDataset
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.forms import warm_up
from v2v_server.system.process import usable_cores

BAR = 5.0
IN_OWN_NETWORK = True
_MTU_BYTES = 9000  # As in clusters; it also saves work of the cable's process
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


def make_samples(folder: Path, videos: Path, rows: str, count: int = 24) -> None:
    """Write the samples that null workers send: ``NAME.npy``, [count, ...] of each array."""
    warm_up()
    with open_leases(videos, rows, StreamSpec()) as (root, leases):
        samples = [whole_sample(lease, root) for lease in islice(leases, count)]
    for name in samples[0].arrays:
        np.save(folder / f"{name}.npy", np.stack([sample.arrays[name] for sample in samples]))


def stretch(service: NullService, cable: Cable, asked: argparse.Namespace, *, compress: bool) -> dict[str, float]:
    """Return the rates of one stretch of a consumer on the far host."""
    roles = {**service.roles, "cable": [cable.pid]}
    with cable.on_far_host():
        dataset = V2VStreamDataset(
            service.server.address, batch_size=asked.batch_size, rank=0, world_size=1, compress=compress,
            shared_memory=False,
        )  # fmt: skip
        before = cable.bytes_received()
        done = consume(dataset, roles, seconds=asked.seconds, warmup_batches=2)
        came = cable.bytes_received() - before
    bytes_per_batch = came / (done["batches"] + 2 + 1)  # the warm-up, and about one batch in flight at the end
    cores = done["batches_per_second"] * sum(done[f"{role}_cpu_seconds_per_batch"] for role in roles)
    return done | {
        "wire_bytes_per_batch": bytes_per_batch,
        "link_busy": bytes_per_batch * done["batches_per_second"] / (asked.mbit * 125e3),
        "cpu_busy": cores / usable_cores(),
    }


def compare(asked: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Return the records of raw and of compressed samples: medians over the turns.

    Raises:
        UsageError: raw samples do not fill the link, or come faster than it.
    """
    flags = ["--bind", f"tcp://{NEAR}:*", "--insecure"]
    found: dict[str, list[dict[str, float]]] = {"raw": [], "compressed": []}
    with (
        Cable(asked.mbit, delay_ms=0.2, mtu=_MTU_BYTES) as cable,
        null_service(Recipe(), workers=2, flags=flags, samples=folder) as service,
    ):
        for _ in range(asked.turns):
            for name, stretches in found.items():
                stretches.append(stretch(service, cable, asked, compress=name == "compressed"))
    records: list[dict[str, Any]] = [
        {
            "samples": name,
            "link_bits_per_second": 1e6 * asked.mbit,
            "batch_size": asked.batch_size,
            **medians(stretches),
        }
        for name, stretches in found.items()
    ]
    if not 0.8 <= (busy := records[0]["link_busy"]) <= 1.05:
        raise UsageError(f"raw samples fill {busy:.0%} of {asked.mbit:g} Mbit/s; 80 to 105 % is usable: lower --mbit")
    compressed, raw = ([each["batches_per_second"] for each in found[name]] for name in ("compressed", "raw"))
    records[1] |= ratios("ratio_to_raw", compressed, raw)
    return records


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "videos to make the samples from", rows="full")
    add_positive(parser, "--seconds", 8.0, "of each stretch")
    add_positive(parser, "--mbit", 1000.0, "rate of the link, Mbit/s")
    add_whole(parser, "--batch-size", 12, "samples of a batch")
    add_whole(parser, "--turns", 3, "stretches of each kind")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    with tempfile.TemporaryDirectory(prefix="v2v-link-") as name:
        make_samples(Path(name), asked.videos, asked.rows)
        records = compare(asked, Path(name))
    return Report(records, [(records, _COLUMNS)], missed=beyond("compressed", records[1], least={"ratio_to_raw": BAR}))
