"""What a fleet of thousands of workers would do, by a simulation with measured costs, and what bounds it.

    v2v-bench scaling --videos CLIPS --workers 1,2,4,8 --null-workers 1 --repeat 3 --json scaling.json
    v2v-bench fleet --costs scaling.json --check
    v2v-bench fleet --costs scaling.json --trainers 125 --gpus 8 --workers 80 --mean-life-seconds 3600
    v2v-bench fleet --costs scaling.json --sizes

--check   simulates the runs of the file on its machine's cores and holds them against what was measured, as ratios to
          two workers within a turn. Costs come of the runs with one worker and with as many as the machine has cores;
          the others are predictions. Status 1 where one is off by more than 15 %.
--sizes   what a trainer needs for a step of so long: arithmetic on the costs, no simulation.

`--workers` and `--gpus` are those of each trainer. Read :mod:`bench.fleet.model` for what is simulated.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.fleet.model import Costs, Fleet, Run
from bench.records import plain_parser, run, say_missed, show, write
from v2v_protocol.errors import UsageError

MOST_ERROR = 0.15
_BATCH = 12
_STEPS_SECONDS = (0.1, 0.25, 0.5, 1.0)
_CHECK_COLUMNS = (
    ("workers", "workers", "{}", 1),
    ("batches_per_second", "batches/s, measured", "{:.2f}", 1),
    ("simulated_batches_per_second", "simulated", "{:.2f}", 1),
    ("measured", "x two workers, measured", "{:.2f}", 1),
    ("simulated", "simulated", "{:.2f}", 1),
    ("error", "off by", "{:+.0%}", 1),
    ("use", "", "{}", 1),
)
_FLEET_COLUMNS = (
    ("samples_per_second", "samples/s", "{:.0f}", 1),
    ("waiting_share", "GPUs wait", "{:.1%}", 1),
    ("cores", "cores busy", "{:.0%}", 1),
    ("broker", "brokers", "{:.0%}", 1),
    ("nic", "NICs", "{:.0%}", 1),
    ("storage", "storage", "{:.0%}", 1),
    ("deaths", "deaths", "{}", 1),
    ("under_way", "under way", "{}", 1),
)
_SIZE_COLUMNS = (
    ("step_seconds", "step of 12 samples, s", "{:g}", 1),
    ("samples_per_second", "samples/s", "{:.0f}", 1),
    ("cores", "cores", "{:.1f}", 1),
    ("nic_bytes_per_second", "network, Gbit/s", "{:.2f}", 8e-9),
    ("broker", "of a broker's core", "{:.1%}", 1),
)


def costs_of(runs: Mapping[int, Mapping[str, Any]]) -> Costs:
    """The costs of a sample.

    Args:
        runs: records of `v2v-bench scaling`, by their number of workers.

    Raises:
        UsageError: the runs with one worker, two, and as many as there were cores are not among them.
    """
    cores = next((item["cores"] for item in runs.values()), 1)
    needed = sorted({1, 2, cores})
    if not runs.keys() >= set(needed):
        raise UsageError(f"--costs: it has runs of {sorted(runs)} workers; {needed} are needed: one, two, all cores")
    alone, crowded = runs[1], runs[cores]
    batch = alone["batch_size"]
    return Costs(
        worker_seconds=alone["workers_cpu_seconds_per_batch"] / batch,
        crowded_seconds=crowded["workers_cpu_seconds_per_batch"] / batch,
        broker_seconds=crowded["broker_cpu_seconds_per_batch"] / batch,
        client_seconds=crowded["client_cpu_seconds_per_batch"] / batch,
        sample_bytes=crowded["bytes_per_second"] / crowded["batches_per_second"] / batch,
    )


def checked(runs: Mapping[int, Mapping[str, Any]], costs: Costs) -> list[dict[str, Any]]:
    """Measured and simulated runs on one machine, of each number of workers.

    They are compared as ratios to two workers, the measured ones within a turn: the machine changes between turns.
    """
    cores, batch = runs[1]["cores"], runs[1]["batch_size"]
    seconds = 500 * costs.worker_seconds

    def rate(workers: int) -> float:
        there = Fleet(
            batch_size=batch, step_seconds=0.0, workers=workers, cores=cores, workers_per_host=workers, one_host=True
        )
        return float(Run(there, costs).outcome(seconds, seconds / 5).samples_per_second / batch)

    found = []
    for workers, item in runs.items():
        simulated, measured = rate(workers) / rate(2), item["ratio_to_two_workers"]
        found.append(
            {
                "workers": workers,
                "batches_per_second": item["batches_per_second"],
                "simulated_batches_per_second": rate(workers),
                "measured": measured,
                "simulated": simulated,
                "error": simulated / measured - 1.0,
                "use": "costs come of it" if workers in (1, cores) else "predicted",
            }
        )
    return found


def sizes(costs: Costs) -> list[dict[str, Any]]:
    """What one GPU needs, for a few lengths of its step."""
    return [
        {
            "step_seconds": step,
            "samples_per_second": (rate := _BATCH / step),
            "cores": rate * costs.crowded_seconds,
            "nic_bytes_per_second": rate * costs.sample_bytes,
            "broker": rate * costs.broker_seconds,
        }
        for step in _STEPS_SECONDS
    ]


def simulated(asked: argparse.Namespace, costs: Costs) -> dict[str, Any]:
    """The record of the fleet that was asked for."""
    fleet = Fleet(
        trainers=asked.trainers,
        gpus=asked.gpus,
        batch_size=asked.batch_size,
        step_seconds=asked.step_seconds,
        workers=asked.workers,
        cores=asked.cores_per_host,
        workers_per_host=asked.cores_per_host,
        nic_bytes_per_second=asked.nic_gbit * 1e9 / 8,
        storage_bytes_per_second=asked.storage_gbyte * 1e9,
        mean_life_seconds=asked.mean_life_seconds,
        slow_share=asked.slow_share,
        slow_factor=3.0,
    )
    end = Run(fleet, costs, asked.seed).outcome(asked.seconds, asked.warm_up_seconds)
    return {
        "samples_per_second": end.samples_per_second,
        "waiting_share": end.waiting_share,
        **end.busy,
        "deaths": end.deaths,
        "under_way": end.under_way,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = plain_parser(__doc__, "fleet")
    parser.add_argument("--costs", type=Path, required=True, metavar="FILE", help="records of v2v-bench scaling")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--check", action="store_true", help="hold simulated runs against the measured ones")
    what.add_argument("--sizes", action="store_true", help="what a trainer needs")
    parser.add_argument("--trainers", type=int, default=1, help="hosts with GPUs and a broker (default 1)")
    parser.add_argument("--gpus", type=int, default=1, help="of each (default 1)")
    parser.add_argument("--batch-size", type=int, default=_BATCH, help="of a GPU (default 12)")
    parser.add_argument("--step-seconds", type=float, default=0.5, help="for a batch (default 0.5)")
    parser.add_argument("--workers", type=int, default=8, help="of each trainer (default 8)")
    parser.add_argument(
        "--cores-per-host", type=int, default=64, help="of workers' hosts, full of workers (default 64)"
    )
    parser.add_argument("--nic-gbit", type=float, default=25.0, help="of a trainer (default 25)")
    parser.add_argument("--storage-gbyte", type=float, default=math.inf, help="a second, of all (default no limit)")
    parser.add_argument("--video-mbyte", type=float, default=0.0, help="read for a sample (default 0)")
    parser.add_argument("--mean-life-seconds", type=float, default=math.inf, help="of a worker (default: none dies)")
    parser.add_argument("--slow-share", type=float, default=0.0, help="of the hosts, three times as slow (default 0)")
    parser.add_argument("--seconds", type=float, default=30.0, help="simulated (default 30)")
    parser.add_argument("--warm-up-seconds", type=float, default=10.0, help="before them (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of deaths")
    return run(parser, _work, arguments)


def _work(asked: argparse.Namespace) -> int:
    try:
        records = json.loads(asked.costs.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UsageError(f"--costs {asked.costs}: no JSON: {error}") from error
    runs = {item["workers"]: item for item in records if item.get("measure") == "workers"}
    costs = costs_of(runs)
    missed: list[str] = []
    if asked.check:
        found = checked(runs, costs)
        show(found, _CHECK_COLUMNS)
        missed = [
            f"{item['workers']} workers: simulated {item['simulated']:.2f} times two, measured {item['measured']:.2f}; "
            f"{MOST_ERROR:.0%} is the bar"
            for item in found
            if abs(item["error"]) > MOST_ERROR
        ]
    elif asked.sizes:
        found = sizes(costs)
        show(found, _SIZE_COLUMNS)
    else:
        found = [simulated(asked, replace(costs, video_bytes=asked.video_mbyte * 1e6))]
        show(found, _FLEET_COLUMNS)
    write(found, asked.json)
    return say_missed(missed)


if __name__ == "__main__":
    sys.exit(main())
