"""Measure what hostile peers cost an honest consumer and the server.

    python -m bench siege --footage FILE ... --turns 3 --json FILE

One server with one worker, and one honest consumer of the paper's samples. Each kind of :mod:`bench.chaos.hostile`
attacks in turn, eight peers at a time, between two calm stretches.

    kept        batches/s under attack over those of the calm stretches before and after, median of the turns
    came/s      raw connections and refused handshakes of the attackers a second, median of the turns
    server CPU  cores that the server uses above the calm stretch before, median of the turns
    peak MiB    most memory of the server's main process above its start, under attack
    after MiB   the same at most 30 s after the attack, once the allocator has returned what is free

The attackers have the lowest priority: on the same cores they would otherwise take time from the honest consumer, which
peers on other hosts cannot do. ``--urgent`` gives them normal priority; then the server CPU counts, not the rate.

Bars: kept at least 0.8; peak at most 300 MiB above the credit windows; after at most 20 MiB.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from bench.chaos.fleet import Fleet
from bench.chaos.hostile import KEYED_KINDS, KINDS, PEERS
from bench.chaos.trimming_server import MODULE, settled_mib
from bench.corpus import add_source, run_folder
from bench.frame import Column, Record, Report, add_positive, add_whole, beyond, chosen, progress
from bench.processes import cpu_seconds, rss_mib
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError

KEPT_BAR, PEAK_BAR_MIB, AFTER_BAR_MIB = 0.8, 300.0, 20.0
CREDIT_MIB = 32
CREDIT_FLAGS = ("--max-credit-bytes", str(CREDIT_MIB << 20))
_COLUMNS: tuple[Column, ...] = (
    ("kind", "kind", "{}", 1),
    ("kept", "kept", "{:.2f}", 1),
    ("kept_lowest", "lowest", "{:.2f}", 1),
    ("came_per_second", "came/s", "{:.0f}", 1),
    ("server_cpu_cores", "server CPU", "{:+.3f}", 1),
    ("peak_mib", "peak MiB", "{:.0f}", 1),
    ("after_mib", "after MiB", "{:.0f}", 1),
)


class Stretch(NamedTuple):
    """Batches/s of the honest consumer, cores that the server used, connections of peers a second, and peak MiB."""

    rate: float
    cpu: float
    came: float
    peak_mib: float


def _totals(fleet: Fleet) -> tuple[float, float, float]:
    """Return the honest consumer's batches, the server's CPU seconds, and the hostile peers' connections, so far."""
    used = 0.0 if fleet.server.pid is None else cpu_seconds(fleet.server.pid)
    return fleet.committed()[0], used, fleet.tally.stat().st_size if fleet.tally.exists() else 0


def stretch(fleet: Fleet, seconds: float) -> Stretch:
    """Watch the honest consumer and the server for that long.

    Raises:
        UsageError: the server or the consumer ended.
    """
    began, before, peak = time.monotonic(), _totals(fleet), 0.0
    while (now := time.monotonic()) < began + seconds:
        fleet.restart(now)
        if fleet.failures:
            raise UsageError(fleet.failures[0])
        peak = max(peak, rss_mib(fleet.server.pid or 0) or 0.0)
        time.sleep(0.05)
    rate, cpu, came = ((new - old) / (now - began) for new, old in zip(_totals(fleet), before, strict=True))
    return Stretch(rate, cpu, came, peak)


def besiege(
    fleet: Fleet, kinds: Sequence[str], turns: int, seconds: float, *, urgent: bool = False
) -> list[dict[str, Any]]:
    """Attack with all kinds in turns; return one record for each kind."""
    found: dict[str, list[dict[str, float]]] = {kind: [] for kind in kinds}
    start = settled_mib(fleet.server.pid or 0)
    for turn in range(turns):
        for kind in kinds:
            before = stretch(fleet, seconds / 2)
            with fleet.attacked(kind, last=not urgent):
                time.sleep(2.0)  # the peers start
                under = stretch(fleet, seconds)
            after = settled_mib(fleet.server.pid or 0, start + AFTER_BAR_MIB) - start
            calm = (before.rate + stretch(fleet, seconds / 2).rate) / 2
            one = {
                "kept": under.rate / calm if calm else 0.0,
                "came_per_second": under.came,
                "server_cpu_cores": under.cpu - before.cpu,
                "peak_mib": under.peak_mib - start,
                "after_mib": after,
            }
            found[kind].append(one)
            progress(
                f"turn {turn + 1}/{turns}  {kind}: " + ", ".join(f"{key} {value:.3g}" for key, value in one.items())
            )
    return [
        {"kind": kind, "kept_lowest": min(row["kept"] for row in rows)}
        | {key: (max if key.endswith("_mib") else statistics.median)(row[key] for row in rows) for key in rows[0]}
        for kind, rows in found.items()
    ]


def missed(record: Record) -> list[str]:
    """Return the bars that a kind misses."""
    return beyond(
        record["kind"], record, least={"kept": KEPT_BAR},
        most={"peak_mib": PEAK_BAR_MIB + CREDIT_MIB * (PEERS + 1), "after_mib": AFTER_BAR_MIB},
    )  # fmt: skip


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_source(parser)
    more = " and ".join(KEYED_KINDS)
    parser.add_argument("--kinds", metavar="KIND,KIND", help=f"default {','.join(KINDS)}; with --keys {more} too")
    parser.add_argument("--keys", action="store_true", help="require keys: all connections are encrypted")
    parser.add_argument("--urgent", action="store_true", help="give the attackers normal priority")
    add_whole(parser, "--turns", 3, "attacks of each kind")
    add_positive(parser, "--seconds", 8.0, "of each stretch")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: an unknown kind, or a process that ended.
    """
    kinds = chosen(asked.kinds, (*KINDS, *KEYED_KINDS) if asked.keys else tuple(KINDS), "--kinds")
    with run_folder(asked) as (folder, videos):
        fleet = Fleet(
            folder / "run", videos, 1, 2, 60.0, server_module=MODULE, server_flags=CREDIT_FLAGS, keyed=asked.keys
        )
        del fleet.crowd[0]  # the consumer of small samples; that of the paper's samples stays
        try:
            fleet.start()
            records = besiege(fleet, kinds, asked.turns, asked.seconds, urgent=asked.urgent)
        finally:
            fleet.kill()
    return Report(records, [(records, _COLUMNS)], missed=[text for record in records for text in missed(record)])
