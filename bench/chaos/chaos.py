"""Kill processes at random while consumers stream; check that no sample is lost, repeated or changed.

    python -m bench chaos --videos DIR --minutes 20 --json chaos.json

One server, or with ``--brokers 2`` two that share one pool of workers; consumers with different specs, seeds and speeds
(:mod:`bench.chaos.consumer`), and faults of many kinds (:mod:`bench.chaos.faults`). Then all processes are stopped,
leftovers are counted, and the consumers' logs are compared with the schedule and with samples made here
(:mod:`tests.oracles.stream`).

    recovery        from a kill to the next batch of the killed consumer, else of all consumers; after a kill of the
                    server only batches after its restart count
    mismatched      samples at another place than the schedule gives, different from an earlier sighting, or different
                    from the sample made here
    condemned       quarantined videos without a planted SIGSEGV: good videos
    leftovers       processes, zombies, listening ports, temporary files, shared memory, and processes that ignored
                    SIGTERM

Bars: each of lost, duplicated, mismatched, condemned, out_of_order, leftovers, broken_lives, stalled, failures and
unrecovered is 0.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from bench.chaos.consumer import LARGE, log_path, profile
from bench.chaos.faults import WEIGHTS, Chaos, Fault
from bench.chaos.fleet import Fleet
from bench.corpus import add_source, run_folder
from bench.frame import Column, Record, Report, add_positive, add_whole, beyond, chosen, key_values
from tests.leftovers import abandoned_memory, shared_memory
from tests.oracles.stream import check
from tests.oracles.stream_log import BatchLine, Kill, read_log, recovery_seconds
from v2v_client.loadtest import percentile
from v2v_protocol.command import Parser
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.registry import VIDEOS
from v2v_server.quarantine import quarantine_path, read_quarantine

_POLL_SECONDS = 0.05
_LAST_BATCH_SECONDS = 120.0
LEASE_SECONDS = 10.0
FAILING = (
    *("lost", "duplicated", "mismatched", "condemned", "out_of_order"),
    *("leftovers", "broken_lives", "stalled", "failures", "unrecovered"),
)
"""Keys of the record that must be 0."""
_FAULTS: tuple[Column, ...] = (
    ("fault", "fault", "{}", 1),
    ("times", "times", "{}", 1),
    ("recovery_p50_seconds", "recovery p50 s", "{:.2f}", 1),
    ("recovery_p99_seconds", "p99 s", "{:.2f}", 1),
    ("recovery_most_seconds", "most s", "{:.2f}", 1),
)


def torment(fleet: Fleet, chaos: Chaos, seconds: float) -> int:
    """Run the fleet under faults, then wait until every consumer has another batch; return how many have none."""
    began = time.monotonic()
    while (now := time.monotonic()) < began + seconds:
        fleet.restart(now)
        chaos.act(now)
        time.sleep(_POLL_SECONDS)
    chaos.end()
    # Two more batches, because a consumer may hold the first already.
    wanted = [count + 2 for count in fleet.committed()]
    deadline = time.monotonic() + _LAST_BATCH_SECONDS
    while (behind := sum(map(int.__lt__, fleet.committed(), wanted))) and (now := time.monotonic()) < deadline:
        fleet.restart(now)
        time.sleep(_POLL_SECONDS)
    return behind


def kills(faults: Sequence[Fault], ready_at: Sequence[float]) -> list[Kill]:
    """Return the faults that ended a process, each with the time at which the server was ready again."""

    def ready(fault: Fault) -> float:
        back = (at for at in ready_at if at > fault.at)
        return next(back, float("inf")) if fault.kind.startswith("server") else fault.at

    return [Kill(fault.kind, fault.at, fault.consumer, ready(fault)) for fault in faults if fault.is_kill]


def checked(fleet: Fleet, remakes: int, seed: int) -> dict[str, Any]:
    """Compare the consumers' logs with the schedule and with samples made here; return the counts."""
    with closing(open_catalogue(fleet.videos, cache_dir=fleet.cache)) as catalogue:
        logs = [(profile(number), read_log(log_path(place.folder))) for number, place in enumerate(fleet.crowd)]
        return check(catalogue, logs, remakes=remakes, seed=seed).to_dict()


def record_of(
    fleet: Fleet, done: Sequence[Fault], seconds: float, verdict: dict[str, Any]
) -> tuple[dict[str, Any], list[Record]]:
    """Return the record of a run of that many seconds, and one record for each kind of fault."""
    logs = [[line for line in read_log(log_path(place.folder)) if isinstance(line, BatchLine)] for place in fleet.crowd]
    batches = [[line.at for line in log] for log in logs]
    recoveries: dict[str, list[float]] = {}
    ended = kills(done, fleet.ready_at)
    for kill in ended:
        if (recovery := recovery_seconds(kill, batches)) is not None:
            recoveries.setdefault(kill.kind, []).append(recovery)
    counts = Counter(fault.kind for fault in done)
    faults: list[Record] = [
        {"fault": kind, "times": counts[kind], **_percentiles(recoveries.get(kind, []))} for kind in WEIGHTS
    ]
    every = [recovery for of_kind in recoveries.values() for recovery in of_kind]
    quarantined = read_quarantine(quarantine_path(fleet.videos, fleet.cache)).lines
    record: dict[str, Any] = {
        "kills": len(ended),
        **verdict,
        "condemned": sum("SIGSEGV" not in line.reason for line in quarantined),
        **_percentiles(every),
        "unrecovered": len(ended) - len(every),
        "longest_wait_seconds": max((line.wait for log in logs for line in log), default=None),
        "failures": len(fleet.failures),
        "seconds": seconds,
        "workers": fleet.workers,
        "brokers": fleet.brokers,
        "consumers": fleet.consumers,
        "samples_per_second": verdict["sightings"] / seconds,
    }
    return record | {f"faults_{kind.replace('-', '_')}": counts[kind] for kind in WEIGHTS}, faults


def _percentiles(seconds: list[float]) -> dict[str, float | None]:
    return {
        f"recovery_{name}_seconds": percentile(seconds, share) if seconds else None
        for name, share in (("p50", 0.5), ("p99", 0.99), ("most", 1.0))
    }


def run_fleet(fleet: Fleet, chaos: Chaos, asked: argparse.Namespace) -> Report:
    """Start a fleet, run it under faults for ``asked.minutes``, stop it, check what it delivered.

    Raises:
        UsageError: the fleet does not start.
    """
    shared, seconds = shared_memory(), 60.0 * asked.minutes
    try:
        fleet.start()
        stalled = torment(fleet, chaos, seconds)
        left = fleet.stop()
    finally:
        fleet.kill()
    left += [f"shared memory {name}" for name in abandoned_memory(shared)]
    record, faults = record_of(fleet, chaos.done, seconds, checked(fleet, asked.remakes, asked.seed))
    record |= {"leftovers": len(left), "stalled": stalled}
    shown = {key: value for key, value in record.items() if not key.startswith("faults_")}
    missed = beyond("run", record, most=dict.fromkeys(FAILING, 0))
    missed += [f"left over: {text}" for text in left[:20]]
    missed += fleet.failures[:20]
    return Report([record], [(faults, _FAULTS), key_values(shown)], missed=missed)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_source(parser)
    add_positive(parser, "--minutes", 2.0, "duration, minutes")
    add_whole(parser, "--workers", 2, "workers of the server, or of the pool that several brokers share")
    add_whole(parser, "--brokers", 1, "servers; with several, consumers take turns with them")
    add_whole(parser, "--consumers", 3, "consumers")
    add_positive(parser, "--every", 3.5, "mean time between faults, seconds")
    parser.add_argument("--faults", metavar="KIND,KIND", help=f"only these kinds, of {', '.join(WEIGHTS)}")
    parser.add_argument("--cache", action="store_true", help="keep decoded clips, and damage them")
    parser.add_argument("--share", action="store_true", help="make equal samples once for all consumers")
    parser.add_argument("--keys", action="store_true", help="require keys: all connections are encrypted")
    parser.add_argument(
        "--large", action="store_true", help="also clips that the further workers, of 1 GiB, cannot hold"
    )
    add_whole(parser, "--remakes", 300, "samples to make again and compare")
    add_whole(parser, "--seed", 0, "of the faults", least=0)


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench."""
    kinds = chosen(asked.faults, WEIGHTS, "--faults")
    with run_folder(asked) as (folder, videos):
        cache = folder / "decoded" if asked.cache else None
        consumers = max(asked.consumers, LARGE + 1) if asked.large else asked.consumers
        fleet = Fleet(
            folder / "run", videos, asked.workers, consumers, LEASE_SECONDS, clip_cache=cache,
            keyed=asked.keys, server_flags=("--share-gib", "0.25") if asked.share else (),
            further_bytes=1 << 30 if asked.large else 0, brokers=asked.brokers,
        )  # fmt: skip
        if asked.large:
            fleet.add_worker()  # it waits for the server
        # Two SIGSEGVs quarantine a video: one video must remain.
        most_segv = sum(bool(VIDEOS.id_of(path.name)) for path in videos.rglob("*")) - 1
        return run_fleet(fleet, Chaos(fleet, asked.every, asked.seed, most_segv, kinds), asked)
