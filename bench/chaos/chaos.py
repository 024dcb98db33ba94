"""Kills processes at random while several consumers stream, and shows that nothing is lost, nothing comes twice, and
every byte is what it should be.

    python -m bench.chaos.chaos --videos DIR --minutes 20 --json chaos.json

One server, consumers with different specs, seeds and speeds (:mod:`bench.chaos.consumer`), and faults of many
kinds (:mod:`bench.chaos.faults`). Afterwards everybody is asked to leave, what is left over is counted, and a
process of its own compares the consumers' logs with the schedule and with samples it makes itself
(:mod:`bench.chaos.check`).

    recovery        from a kill until every consumer concerned has its next batch: the killed consumer, else all. After
                    the server was killed, batches count once the new one said it was ready
    mismatched      samples that show another place than the schedule says, differ from an earlier sighting of the
                    same, or differ from what the checker makes
    condemned       lines of the quarantine that no planted SIGSEGV explains: videos that are good
    leftovers       processes, zombies, listening ports, temporary files, shared memory; processes that did not leave
                    when asked
    rss slope       of the server's main process: least squares over one point a second, one slope, an intercept for
                    each life, its first seconds left out

Exit status: 0 the promise was kept, 1 it was not, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.chaos.consumer import log_path
from bench.chaos.faults import WEIGHTS, Chaos, Fault
from bench.chaos.fleet import Fleet, abandoned_memory, shared_memory
from bench.chaos.log import BatchLine, Kill, read_log, recovery_seconds
from bench.corpus import webvid_like
from bench.speed.memory import Fit, fit, rss_mib
from v2v_client.tools.loadtest import percentile
from v2v_protocol.errors import UsageError, V2VError
from v2v_protocol.records import write_json
from v2v_server.broker.quarantine import quarantine_path, read_quarantine
from v2v_server.catalogue.files import VIDEO_SUFFIXES

_LOOK_SECONDS = 0.05
_WARM_UP_SECONDS = 8.0
_LAST_BATCH_SECONDS = 120.0
FAILING = (
    *("lost", "duplicated", "mismatched", "condemned", "out_of_order"),
    *("leftovers", "broken_lives", "stalled", "failures"),
)
"""Keys of the record that must be 0."""


@dataclass(slots=True)
class Run:
    """What was observed while the fleet ran.

    Attributes:
        faults: what was done.
        server_rss: (seconds, MiB) of each server process.
        stalled: consumers that got no batch after the last fault.
        seconds: how long the faults went on.
    """

    faults: list[Fault] = field(default_factory=list)
    server_rss: dict[int, list[tuple[float, float]]] = field(default_factory=dict)
    stalled: int = 0
    seconds: float = 0.0


def torment(fleet: Fleet, chaos: Chaos, seconds: float) -> Run:
    """Lets the fleet run under faults, then waits until every consumer got another batch."""
    run = Run(faults=chaos.done)
    began = time.monotonic()
    next_point = began
    while (now := time.monotonic()) < began + seconds:
        fleet.look(now)
        chaos.act(now)
        if now >= next_point:
            next_point += 1.0
            _note_rss(fleet, run, now)
        time.sleep(_LOOK_SECONDS)
    chaos.end()
    run.seconds = time.monotonic() - began
    before = fleet.committed()
    deadline = time.monotonic() + _LAST_BATCH_SECONDS
    behind = list(range(len(before)))
    while behind and (now := time.monotonic()) < deadline:
        fleet.look(now)
        time.sleep(_LOOK_SECONDS)
        # Two more, because the first may have been in hand already.
        behind = [number for number, count in enumerate(fleet.committed()) if count < before[number] + 2]
    run.stalled = len(behind)
    return run


def _note_rss(fleet: Fleet, run: Run, now: float) -> None:
    pid = fleet.server.pid
    if pid is not None and not fleet.server.expected:
        resident = rss_mib(pid)
        if resident is not None:
            run.server_rss.setdefault(pid, []).append((now, resident))


def kills(faults: Sequence[Fault], ready_at: Sequence[float]) -> list[Kill]:
    """The faults that ended a process, each with when its place was ready again, as far as that is known."""
    found = []
    for fault in faults:
        if fault.is_kill:
            later = [ready for ready in ready_at if ready > fault.at]
            ready = (later[0] if later else float("inf")) if fault.kind.startswith("server") else fault.at
            found.append(Kill(fault.kind, fault.at, fault.consumer, ready))
    return found


def checked(fleet: Fleet, remakes: int, seed: int) -> dict[str, Any]:
    """What the checker, a process of its own, says of the logs.

    Raises:
        UsageError: it could not check.
    """
    command = [sys.executable, "-m", "bench.chaos.check", "--videos", str(fleet.videos)]
    command += ["--cache-dir", str(fleet.cache), "--remakes", str(remakes), "--seed", str(seed)]
    command += [str(place.folder) for place in fleet.crowd]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UsageError(f"the checker could not check: {done.stderr.strip()[-2000:]}")
    verdict: dict[str, Any] = json.loads(done.stdout)
    return verdict


def condemned(fleet: Fleet) -> int:
    """Lines of the server's quarantine that speak of anything but the SIGSEGV of a worker, which is planted here."""
    file = quarantine_path(fleet.videos, fleet.cache)
    return sum("SIGSEGV" not in line.reason for line in read_quarantine(file).lines)


def record_of(
    fleet: Fleet, run: Run, verdict: dict[str, Any], left: Sequence[str], slope: Fit | None
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """The flat record of a run, and the recovery times by kind of kill."""
    lines = [list(read_log(log_path(place.folder))) for place in fleet.crowd]
    batches = [[line.at for line in log if isinstance(line, BatchLine)] for log in lines]
    waits = [line.wait for log in lines for line in log if isinstance(line, BatchLine)]
    ended = kills(run.faults, fleet.ready_at)
    recoveries: dict[str, list[float]] = {}
    for kill in ended:
        seconds = recovery_seconds(kill, batches)
        recoveries.setdefault(kill.kind, []).append(float("inf") if seconds is None else seconds)
    every = [seconds for of_kind in recoveries.values() for seconds in of_kind]
    known = [seconds for seconds in every if seconds != float("inf")]
    counts = Counter(fault.kind for fault in run.faults)
    record: dict[str, Any] = {
        "kills": len(ended),
        "samples": verdict.pop("samples"),
        "lost": verdict.pop("lost"),
        "duplicated": verdict.pop("duplicated"),
        "mismatched": verdict.pop("mismatched"),
        "condemned": condemned(fleet),
        "leftovers": len(left),
        "recovery_p50_seconds": percentile(known, 0.5) if known else None,
        "recovery_p99_seconds": percentile(known, 0.99) if known else None,
        "rss_slope_mib_per_minute": None if slope is None else slope.slope,
        "rss_slope_standard_error_mib_per_minute": None if slope is None else slope.standard_error,
        "recovery_most_seconds": max(known) if known else None,
        "unrecovered": len(every) - len(known),
        "longest_wait_seconds": max(waits, default=None),
        "stalled": run.stalled,
        "failures": len(fleet.failures),
        **verdict,
        "minutes": run.seconds / 60.0,
        "workers": fleet.workers,
        "consumers": fleet.consumers,
        "samples_per_second": verdict["sightings"] / run.seconds,
        **{f"faults_{kind.replace('-', '_')}": counts.get(kind, 0) for kind in WEIGHTS},
    }
    return record, recoveries


def show(record: dict[str, Any], recoveries: dict[str, list[float]], console: Console) -> None:
    """Prints the record and a table of the kills."""
    table = Table(box=None, pad_edge=False)
    for title in ("fault", "times", "recovery p50 s", "p99 s", "most s"):
        table.add_column(title, justify="left" if title == "fault" else "right")
    for kind in WEIGHTS:
        times = record[f"faults_{kind.replace('-', '_')}"]
        seconds = recoveries.get(kind, [])
        figures = [f"{percentile(seconds, share):.2f}" for share in (0.5, 0.99, 1.0)] if seconds else ["-"] * 3
        table.add_row(kind, str(times), *figures)
    console.print(table)
    for key, value in record.items():
        if not key.startswith("faults_"):
            console.print(f"{key:42} {value:.4g}" if isinstance(value, float) else f"{key:42} {value}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = parser_of_chaos(__doc__, "python -m bench.chaos.chaos")
    asked = parser.parse_args(arguments)
    try:
        return _run(asked)
    except (V2VError, OSError) as error:
        if asked.debug:
            raise
        print(f"chaos: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def parser_of_chaos(doc: str | None, prog: str) -> argparse.ArgumentParser:
    """Its flags, for a command of that docstring and name."""
    first, _, rest = (doc or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog=prog,
        description=first,
        epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--videos", type=Path, metavar="DIR", help="corpus to serve")
    source.add_argument("--footage", type=Path, nargs="+", metavar="FILE", help="serve small clips made of these")
    parser.add_argument("--minutes", type=float, default=2.0, help="how long (default 2)")
    parser.add_argument("--workers", type=int, default=2, help="of the server's own (default 2)")
    parser.add_argument("--consumers", type=int, default=3, help="default 3")
    parser.add_argument("--every", type=float, default=3.5, metavar="SECONDS", help="mean time between faults (3.5)")
    parser.add_argument("--faults", metavar="KIND,KIND", help=f"only these, of {', '.join(WEIGHTS)}")
    parser.add_argument(
        "--lease-deadline-seconds", type=float, default=10.0, metavar="S", help="the server's watchdog (default 10)"
    )
    parser.add_argument("--cache", action="store_true", help="the server keeps decoded clips, and they are spoiled")
    parser.add_argument("--keys", action="store_true", help="the server takes nobody without a key: all is encrypted")
    parser.add_argument("--remakes", type=int, default=300, help="samples that the checker makes again (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the faults")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the record there")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep logs and outputs in this new folder")
    parser.add_argument("--debug", action="store_true", help="show the trace of an error")
    return parser


def _run(asked: argparse.Namespace) -> int:
    kinds = tuple(asked.faults.split(",")) if asked.faults else tuple(WEIGHTS)
    unknown = [kind for kind in kinds if kind not in WEIGHTS]
    if unknown:
        raise UsageError(f"--faults {','.join(unknown)}: choose from {', '.join(WEIGHTS)}")
    if min(asked.minutes, asked.every) <= 0 or min(asked.workers, asked.consumers, asked.remakes) < 1:
        raise UsageError("--minutes and --every are more than 0; --workers, --consumers and --remakes are 1 or more")
    folder = Path(tempfile.mkdtemp(prefix="v2v-chaos-")) if asked.keep is None else asked.keep
    try:
        videos = asked.videos
        if videos is None:
            videos = folder / "clips"
            webvid_like(asked.footage, videos, gop=12, frames=300, clips=len(asked.footage))
        cache = folder / "decoded" if asked.cache else None
        counts = asked.workers, asked.consumers
        fleet = Fleet(folder, videos, *counts, asked.lease_deadline_seconds, clip_cache=cache, keyed=asked.keys)
        most_segv = sum(path.suffix.lower() in VIDEO_SUFFIXES for path in videos.rglob("*")) - 1
        return torment_and_judge(fleet, Chaos(fleet, asked.every, asked.seed, most_segv, kinds), asked)
    finally:
        if asked.keep is None:
            shutil.rmtree(folder)


def torment_and_judge(fleet: Fleet, chaos: Chaos, asked: argparse.Namespace) -> int:
    """Starts a fleet, torments it for ``asked.minutes``, prints and writes what came of it; returns the exit status.

    Raises:
        UsageError: it does not come up, or cannot be checked.
    """
    shared = shared_memory()
    try:
        fleet.start()
        run = torment(fleet, chaos, asked.minutes * 60.0)
        left = fleet.stop()
    finally:
        fleet.kill()
    left += [f"shared memory {name}" for name in abandoned_memory(shared)]
    try:
        slope = fit(list(run.server_rss.values()), skip_seconds=_WARM_UP_SECONDS)
    except UsageError:  # no server lived for long enough: the key is null, and the lines below say so
        slope = None
    record, recoveries = record_of(fleet, run, checked(fleet, asked.remakes, asked.seed), left, slope)
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    show(record, recoveries, console)
    print(f"server rss: {slope if slope is not None else 'no life of the server was long enough for a fit'}")
    for text in left[:20]:
        print(f"left over: {text}")
    for failure in fleet.failures[:20]:
        print(f"ended unasked: {failure.name}, status {failure.status}: {failure.text}")
    if asked.json is not None:
        write_json(asked.json, [record])
    return 1 if any(record[key] for key in FAILING) or record["unrecovered"] else 0


if __name__ == "__main__":
    # An exception, so that everything that was started is ended.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(main())
