"""The simulated fleet, where arithmetic knows the answer."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.fleet import fleet
from bench.fleet.model import Costs, Fleet, Outcome, Run

PLAIN = Costs(worker_seconds=0.25, crowded_seconds=0.25)
ONE = Fleet(batch_size=1, step_seconds=0.0, workers=1, cores=1, workers_per_host=1)


def outcome(there: Fleet, costs: Costs = PLAIN, seconds: float = 200.0, seed: int = 0) -> Outcome:
    return Run(there, costs, seed).outcome(seconds, 20.0)


@pytest.mark.parametrize(
    ("there", "costs", "rate"),
    [
        (ONE, PLAIN, 4.0),
        (replace(ONE, workers=8, cores=8, workers_per_host=8), PLAIN, 32.0),
        (replace(ONE, workers=8, cores=2, workers_per_host=8), PLAIN, 8.0),  # two cores, whoever shares them
        (replace(ONE, workers=8, cores=2, workers_per_host=8), replace(PLAIN, crowded_seconds=0.5), 4.0),
        (replace(ONE, workers=8, step_seconds=2.0, batch_size=4), PLAIN, 2.0),  # the GPU bounds
        (replace(ONE, workers=8, cores=8, workers_per_host=8), replace(PLAIN, broker_seconds=0.1), 10.0),
        (
            replace(ONE, workers=8, cores=8, workers_per_host=8, nic_bytes_per_second=50.0),
            replace(PLAIN, sample_bytes=10.0),
            5.0,
        ),
        (
            replace(ONE, trainers=2, workers=8, cores=8, workers_per_host=8, storage_bytes_per_second=60.0),
            replace(PLAIN, video_bytes=10.0),
            6.0,  # of all trainers together
        ),
        (replace(ONE, one_host=True), replace(PLAIN, client_seconds=0.25), 2.0),  # one core makes and receives
        (replace(ONE, workers=2, slow_share=0.5, slow_factor=5.0), PLAIN, 4.0 + 0.8),
    ],
)
def test_what_bounds_the_rate(there: Fleet, costs: Costs, rate: float) -> None:
    assert outcome(there, costs).samples_per_second == pytest.approx(rate, rel=0.02)


def test_a_gpu_waits_for_the_share_that_is_missing() -> None:
    half = outcome(replace(ONE, workers=1, step_seconds=0.125))
    assert half.waiting_share == pytest.approx(0.5, abs=0.02)
    assert outcome(replace(ONE, workers=4, cores=4, workers_per_host=4, step_seconds=0.125)).waiting_share < 0.01


def test_dying_workers_cost_the_time_they_are_away_and_no_sample() -> None:
    # A death every 16 samples on average, that is every 4 s of work, and 4 s away: half the rate.
    end = outcome(replace(ONE, mean_life_seconds=4.0, restart_seconds=4.0), seconds=4000.0)
    assert end.samples_per_second == pytest.approx(2.0, rel=0.1)
    assert end.deaths > 300


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 4), st.integers(1, 12), st.integers(1, 5), st.floats(0.5, 20.0), st.integers(0, 99))
def test_nothing_is_lost_and_nothing_comes_twice(gpus: int, workers: int, batch: int, life: float, seed: int) -> None:
    there = Fleet(gpus=gpus, workers=workers, batch_size=batch, step_seconds=0.1, mean_life_seconds=life)
    run = Run(there, PLAIN, seed)
    end = run.outcome(30.0, 5.0)
    assert end.asked == end.arrived + end.under_way
    assert run.taken <= end.arrived
    ahead = gpus * max(2 * batch, 2 * -(-workers // gpus))
    assert end.under_way <= ahead
    assert end.asked - run.taken == ahead
    assert all(0.0 <= share <= 1.001 for share in end.busy.values())


def records(**changes: Any) -> list[dict[str, Any]]:
    made = {"measure": "workers", "cores": 2, "batch_size": 4, "bytes_per_second": 4e6}
    made |= {"broker_cpu_seconds_per_batch": 0.0, "client_cpu_seconds_per_batch": 0.0}
    made |= {"workers_cpu_seconds_per_batch": 1.0}
    rates = {1: 1.0, 2: 2.0, 8: 2.0} | changes.get("rates", {})
    return [
        made | {"workers": workers, "batches_per_second": rate, "ratio_to_two_workers": rate / rates.get(2, 1.0)}
        for workers, rate in rates.items()
    ]


def test_the_check_passes_where_it_agrees_and_says_where_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "scaling.json"
    file.write_text(json.dumps(records()), encoding="utf-8")
    assert fleet.main(["--costs", str(file), "--check"]) == 0
    file.write_text(json.dumps(records(rates={8: 3.0})), encoding="utf-8")
    assert fleet.main(["--costs", str(file), "--check"]) == 1
    assert "8 workers: simulated 1.00 times two, measured 1.50" in capsys.readouterr().err


def test_sizes_are_rate_times_cost() -> None:
    costs = fleet.costs_of({item["workers"]: item for item in records()})
    step = next(item for item in fleet.sizes(costs) if item["step_seconds"] == 0.5)
    assert (step["samples_per_second"], step["cores"]) == (24.0, 6.0)
    assert step["nic_bytes_per_second"] == pytest.approx(24.0 * 500_000)


def test_costs_that_are_not_there_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scaling.json"
    file.write_text(json.dumps(records()[:1]), encoding="utf-8")
    assert fleet.main(["--costs", str(file)]) == 2
    assert "[1, 2] are needed" in capsys.readouterr().err
    file.write_text("{", encoding="utf-8")
    assert fleet.main(["--costs", str(file)]) == 2
