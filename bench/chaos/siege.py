"""What hostile peers cost an honest consumer and the server: its rate and the memory, with them and without.

    v2v-bench siege --footage FILE ... --turns 3 --json FILE

One server with one worker and one honest consumer of the paper's samples. Each kind of
:mod:`bench.chaos.hostile` comes in turn, eight peers at a time, between two calm spells.

    kept        batches per second under attack over those of the calm spells before and after, median of the turns
    peak MiB    the most that the server's main process held above its start, while attacked
    came        connections that they made, or handshakes that they were refused, a second (those of raw peers and of
                wrong keys are counted), median of the turns
    server CPU  its processor time, seconds a second, above that of the calm spell before, median of the turns
    after MiB   what it held above its start at most 30 s after the attack

The attackers run at the lowest priority: on the same cores they would otherwise take from the honest consumer what
hostile peers on other hosts could not. On busy cores few of them come at all: ``--urgent`` gives them a share like all
others, and then the server's processor time is what counts, not the rate. Bars: kept at least 0.8; peak at most 300 MiB
above the credit windows; after at most 20 MiB. ``slow`` is no attack: it takes its share of the one worker, and no bar
is on its rate.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from bench.chaos.fleet import Fleet
from bench.chaos.hostile import KEYED_KINDS, KINDS, PEERS
from bench.corpus import webvid_like
from bench.speed.memory import rss_mib
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.records import write_json

KEPT_BAR, PEAK_BAR_MIB, AFTER_BAR_MIB, AFTER_SECONDS = 0.8, 300.0, 20.0, 30.0
CREDIT_MIB = 32


@dataclass(frozen=True, slots=True)
class Spell:
    """A stretch of time.

    Attributes:
        rate: batches a second of the honest consumer.
        peak_mib: the most that the server held.
        cpu: processor time of the server, seconds a second.
        came: connections of hostile peers a second.
    """

    rate: float
    peak_mib: float
    cpu: float
    came: float


def spell(fleet: Fleet, seconds: float) -> Spell:
    """Watches the honest consumer and the server for so long.

    Raises:
        UsageError: the server or the consumer ended.
    """
    began, before, peak, worked = time.monotonic(), fleet.committed()[0], 0.0, _worked(fleet)
    came = _came(fleet)
    while (now := time.monotonic()) < began + seconds:
        fleet.look(now)
        if fleet.failures:
            raise UsageError(f"{fleet.failures[0].name} ended: {fleet.failures[0].text}")
        peak = max(peak, _held(fleet))
        time.sleep(0.05)
    lasted = now - began
    done = fleet.committed()[0] - before
    return Spell(done / lasted, peak, (_worked(fleet) - worked) / lasted, (_came(fleet) - came) / lasted)


def attacked(fleet: Fleet, kind: str, seconds: float, *, urgent: bool = False) -> Spell:
    """The same while peers of one kind are there."""
    peers = fleet.peers(kind, last=not urgent)
    try:
        time.sleep(2.0)  # until they are there
        return spell(fleet, seconds)
    finally:
        peers.kill()
        peers.wait()


def _came(fleet: Fleet) -> int:
    return fleet.tally.stat().st_size if fleet.tally.exists() else 0


def _worked(fleet: Fleet) -> float:
    """Seconds of processor time that the server has taken."""
    if fleet.server.pid is None:
        return 0.0
    times = psutil.Process(fleet.server.pid).cpu_times()
    return float(times.user + times.system)


def _held(fleet: Fleet) -> float:
    held = None if fleet.server.pid is None else rss_mib(fleet.server.pid)
    return 0.0 if held is None else held


def settled(fleet: Fleet, start_mib: float) -> float:
    """What the server holds above its start as soon as that is within the bar, else after 30 s."""
    deadline = time.monotonic() + AFTER_SECONDS
    while (above := _held(fleet) - start_mib) > AFTER_BAR_MIB and time.monotonic() < deadline:
        fleet.look(time.monotonic())
        time.sleep(0.1)
    return above


def besiege(
    fleet: Fleet, kinds: Sequence[str], turns: int, seconds: float, *, urgent: bool = False
) -> list[dict[str, Any]]:
    """All kinds in turn, several times over; a record for each kind."""
    found: dict[str, list[tuple[float, float, float, float, float]]] = {kind: [] for kind in kinds}
    start = max(spell(fleet, seconds).peak_mib for _ in range(2))
    for turn in range(turns):
        for kind in kinds:
            before = spell(fleet, seconds / 2)
            under = attacked(fleet, kind, seconds, urgent=urgent)
            after = settled(fleet, start)
            calm = (before.rate + spell(fleet, seconds / 2).rate) / 2
            kept, cpu = under.rate / calm if calm else 0.0, under.cpu - before.cpu
            found[kind].append((kept, under.peak_mib - start, after, cpu, under.came))
            print(
                f"turn {turn + 1}/{turns}  {kind:10} kept {kept:.2f}  came {under.came:.0f}/s  server CPU {cpu:+.3f}  "
                f"peak {under.peak_mib - start:.0f} MiB  after {after:.0f} MiB"
            )
    return [
        {
            "kind": kind,
            "kept": statistics.median(kept for kept, *_ in rows),
            "kept_lowest": min(kept for kept, *_ in rows),
            "server_cpu": statistics.median(cpu for *_, cpu, _ in rows),
            "came_per_second": statistics.median(came for *_, came in rows),
            "peak_mib": max(peak for _, peak, *_ in rows),
            "after_mib": max(left for _, _, left, *_ in rows),
        }
        for kind, rows in found.items()
    ]


def missed(record: dict[str, Any]) -> list[str]:
    """The bars that a kind misses, in words."""
    window = CREDIT_MIB * (PEERS + 1)
    bars = [
        ("kept", record["kind"] == "slow" or record["kept"] >= KEPT_BAR, f"at least {KEPT_BAR}"),
        ("peak_mib", record["peak_mib"] <= PEAK_BAR_MIB + window, f"at most {PEAK_BAR_MIB + window:.0f}"),
        ("after_mib", record["after_mib"] <= AFTER_BAR_MIB, f"at most {AFTER_BAR_MIB:.0f}"),
    ]
    return [f"{record['kind']}: {name} {record[name]:.2f}, {limit} was asked" for name, held, limit in bars if not held]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    first, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="v2v-bench siege", description=first, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--footage", type=Path, nargs="+", required=True, metavar="FILE", help="clips are made of these"
    )
    parser.add_argument(
        "--kinds", metavar="KIND,KIND", help=f"default {','.join(KINDS)}; with --keys {' and '.join(KEYED_KINDS)} too"
    )
    parser.add_argument("--keys", action="store_true", help="the server takes nobody without a key: all is encrypted")
    parser.add_argument("--urgent", action="store_true", help="the attackers get a share of the processor like others")
    parser.add_argument("--turns", type=int, default=3, help="default 3")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each spell (default 8)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records there")
    asked = parser.parse_args(arguments)
    possible = (*KINDS, *KEYED_KINDS) if asked.keys else tuple(KINDS)
    kinds = asked.kinds.split(",") if asked.kinds else possible
    unknown = [kind for kind in kinds if kind not in possible]
    if unknown or asked.turns < 1 or asked.seconds <= 0:
        print(f"siege: --kinds of {', '.join(possible)}; --turns 1 or more; --seconds more than 0", file=sys.stderr)
        return 2
    try:
        with tempfile.TemporaryDirectory(prefix="v2v-siege-") as folder:
            clips = Path(folder) / "clips"
            webvid_like(asked.footage, clips, gop=12, frames=300, clips=len(asked.footage))
            credit = ("--max-credit-bytes", str(CREDIT_MIB << 20))
            fleet = Fleet(Path(folder), clips, 1, 2, 60.0, server_flags=credit, keyed=asked.keys)
            fleet.crowd[:1] = []  # the consumer of small samples; the paper's stays
            try:
                fleet.start()
                records = besiege(fleet, kinds, asked.turns, asked.seconds, urgent=asked.urgent)
            finally:
                fleet.kill()
    except (V2VError, OSError) as error:
        print(f"siege: {error}", file=sys.stderr)
        return 2
    _show(records)
    if asked.json is not None:
        write_json(asked.json, records)
    bars = [text for record in records for text in missed(record)]
    for text in bars:
        print(f"bar missed: {text}")
    return 1 if bars else 0


def _show(records: Sequence[dict[str, Any]]) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("kind", "kept", "lowest", "came/s", "server CPU", "peak MiB", "after MiB"):
        table.add_column(title, justify="left" if title == "kind" else "right")
    for record in records:
        figures = [f"{record['kept']:.2f}", f"{record['kept_lowest']:.2f}", f"{record['came_per_second']:.0f}"]
        figures.append(f"{record['server_cpu']:+.3f}")
        table.add_row(record["kind"], *figures, f"{record['peak_mib']:.0f}", f"{record['after_mib']:.0f}")
    Console(width=None if sys.stdout.isatty() else 100, highlight=False).print(table)


if __name__ == "__main__":
    sys.exit(main())
