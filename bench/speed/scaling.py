"""Measure how the stream grows with its workers, and what one broker carries.

    python -m bench scaling --videos CLIPS --workers 1,2,8 --repeat 3 --json scaling.json

    workers   the stream end to end with each number of server workers, in turns; medians. Client and broker share the
              cores with the workers
    broker    null workers, which cost nothing: the traffic of one broker and one client, the broker's processor time a
              batch, and its peak memory beside the credit window

Bars: two workers make at least 1.75 times as much as one; eight make at least as much as two (on at most four cores),
both within a turn; the broker carries at least 1 GB/s, in at most 150 MB plus its credit window.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from bench.frame import Column, Record, Report, add_positive, add_videos, add_whole, beyond, medians, whole_numbers
from bench.processes import Roles, consume, peak_rss_bytes, roles_of
from bench.speed.null_workers import null_service
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.command import Parser
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import DEFAULT_ARRAYS, array_layout, layout_bytes
from v2v_server.broker.admission import MOST_CREDIT, suggested_credit
from v2v_server.system.process import usable_cores

LEAST_GAIN_OF_TWO = 1.75
LEAST_BYTES_PER_SECOND = 1e9
MOST_BROKER_BYTES = 150e6  # Beside the credit window
_FEW_CORES = 4
_COLUMNS: tuple[Column, ...] = (
    ("measure", "", "{}", 1),
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s", "{:.2f}", 1),
    ("ratio_to_1_worker", "x one", "{:.2f}", 1),
    ("ratio_to_2_workers", "x two", "{:.2f}", 1),
    ("bytes_per_second", "GB/s", "{:.3f}", 1e-9),
    ("workers_cpu_seconds_per_batch", "workers ms", "{:.1f}", 1e3),
    ("broker_cpu_seconds_per_batch", "broker ms", "{:.1f}", 1e3),
    ("client_cpu_seconds_per_batch", "client ms", "{:.1f}", 1e3),
    ("broker_peak_rss_bytes", "broker MB", "{:.0f}", 1e-6),
    ("credit_window_bytes", "window MB", "{:.0f}", 1e-6),
)


def _consumed(asked: argparse.Namespace, server: LocalServer, roles: Roles, warmup_batches: int) -> dict[str, float]:
    dataset = V2VStreamDataset(server.address, batch_size=asked.batch_size, rank=0, world_size=1)
    done = consume(dataset, roles, seconds=asked.seconds, warmup_batches=warmup_batches)
    return done | {"broker_peak_rss_bytes": peak_rss_bytes(server.pid)}


def end_to_end(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Return one record for each number of workers: medians over the turns, of ratios within a turn too."""
    turns: list[dict[int, dict[str, float]]] = []
    flags = ["--rows", asked.rows]
    for turn in range(asked.repeat):
        found: dict[int, dict[str, float]] = {}
        # Every other turn goes backwards, so that a drift of the machine cancels.
        for workers in asked.workers[:: 1 if turn % 2 == 0 else -1]:
            with LocalServer(asked.videos, workers=workers, flags=flags) as server:
                # After the warm-up every worker has finished a sample, on average.
                found[workers] = _consumed(asked, server, roles_of(server), 1 + workers // asked.batch_size)
        for few in {1, 2} & set(found):
            for one in found.values():
                one[f"ratio_to_{few}_worker{'s' * (few > 1)}"] = (
                    one["batches_per_second"] / found[few]["batches_per_second"]
                )
        turns.append(found)
    return [
        {"measure": "workers", "workers": workers, "turns": asked.repeat} | medians([turn[workers] for turn in turns])
        for workers in asked.workers
    ]


def broker_alone(asked: argparse.Namespace, workers: int) -> dict[str, Any]:
    """Return the record of one number of null workers."""
    recipe = Recipe()
    with null_service(recipe, workers=workers) as service:
        found = _consumed(asked, service.server, service.roles, 2)
    samples = min(suggested_credit(asked.batch_size, workers, 1), MOST_CREDIT)
    window = samples * layout_bytes(array_layout(recipe, "int8", DEFAULT_ARRAYS))
    return {"measure": "broker", "workers": workers, "credit_window_bytes": window, **found}


def missed(records: Sequence[Record], cores: int) -> list[str]:
    """Return the bars that these records miss."""
    texts = []
    for record in records:
        name = f"{record['measure']}, {record['workers']}"
        if record["measure"] == "broker":
            texts += beyond(
                name, record, most={"broker_peak_rss_bytes": MOST_BROKER_BYTES + record["credit_window_bytes"]}
            )
        elif record["workers"] == 2:
            texts += beyond(name, record, least={"ratio_to_1_worker": LEAST_GAIN_OF_TWO})
        elif record["workers"] == 8 and cores <= _FEW_CORES:
            texts += beyond(name, record, least={"ratio_to_2_workers": 1.0})
    best = max(record["bytes_per_second"] for record in records if record["measure"] == "broker")
    return texts + beyond("broker", {"bytes_per_second": best}, least={"bytes_per_second": LEAST_BYTES_PER_SECOND})


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, rows="top:0.54")
    add_positive(parser, "--seconds", 10.0, "of each run")
    for flag, default in (("--workers", "1,2,8"), ("--null-workers", "1,2,8,64")):
        parser.add_argument(flag, type=whole_numbers, default=default, metavar="N,N", help=f"default {default}")
    add_whole(parser, "--repeat", 3, "turns of the workers part")
    add_whole(parser, "--batch-size", 12, "samples of a batch")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    records = end_to_end(asked) + [broker_alone(asked, workers) for workers in asked.null_workers]
    records = [record | {"batch_size": asked.batch_size, "cores": usable_cores()} for record in records]
    return Report(records, [(records, _COLUMNS)], missed=missed(records, usable_cores()))
