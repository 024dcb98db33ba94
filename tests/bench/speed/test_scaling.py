"""Scaling: when a bar is missed, what is extrapolated, and one short run for real."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bench.speed import scaling
from tests.bench.small import FLAGS, RECIPE, clips, is_picture, one_line, records

MB = 1_000_000


def workers(count: int, speed: float, ratio: float | None = None, of_two: float | None = None) -> dict[str, Any]:
    return {
        "measure": "workers",
        "workers": count,
        "batches_per_second": speed,
        "ratio_to_one_worker": ratio,
        "ratio_to_two_workers": of_two,
        "workers_cpu_seconds_per_batch": 2.0,
        "broker_peak_rss_bytes": 100 * MB,
    }


def broker(count: int, bytes_per_second: float, peak: int = 100 * MB, window: int = 50 * MB) -> dict[str, Any]:
    return {
        "measure": "broker",
        "workers": count,
        "bytes_per_second": bytes_per_second,
        "broker_cpu_seconds_per_batch": 0.04,
        "client_cpu_seconds_per_batch": 0.02,
        "broker_peak_rss_bytes": peak,
        "credit_window_bytes": window,
    }


GOOD = [
    workers(1, 1.0, 1.0, 0.57),
    workers(2, 1.75, 1.75, 1.0),
    workers(8, 1.74, 1.76, 1.0),  # a median of turns, and one of ratios within them
    broker(1, 0.5e9),
    broker(8, 1e9),
]


def test_bars_that_are_kept_are_not_mentioned() -> None:
    assert scaling.missed_bars(GOOD, cores=2) == []


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (workers(2, 1.75, 1.74), "1.74 times as fast"),
        (workers(8, 1.8, 1.8, 0.99), "8 workers are 0.990 times as fast as 2"),
        (broker(8, 0.99e9), "0.99 GB/s"),
        (broker(8, 1e9, peak=201 * MB), "the broker had 201 MB; the bar is 200"),
    ],
)
def test_each_bar_is_missed_by_itself(record: dict[str, Any], words: str) -> None:
    same = (record["measure"], record["workers"])
    others = [item for item in GOOD if (item["measure"], item["workers"]) != same]
    (text,) = scaling.missed_bars([*others, record], cores=2)
    assert words in text


def test_eight_workers_are_held_to_two_only_where_cores_are_few() -> None:
    slow = [workers(1, 1.0, 1.0, 0.5), workers(2, 2.0, 2.0, 1.0), workers(8, 1.9, 1.9, 0.95)]
    assert scaling.missed_bars(slow, cores=2)
    assert not scaling.missed_bars(slow, cores=16)


def test_the_stalled_broker_is_held_to_its_window_too() -> None:
    stalled = {"measure": "stalled", "workers": 64, "broker_peak_rss_bytes": 700 * MB, "credit_window_bytes": 500 * MB}
    (text,) = scaling.missed_bars([stalled], cores=2)
    assert "700 MB; the bar is 650" in text


def test_extrapolation_is_arithmetic_and_says_so() -> None:
    of_broker, of_client = scaling.extrapolated(GOOD)
    assert of_broker.startswith("extrapolated, not measured")
    assert "so 50 workers" in of_broker  # 2 s / 0.04 s
    assert "1000 workers need 20.0 such cores" in of_broker
    assert "so 100 workers" in of_client
    assert scaling.extrapolated(GOOD[:3]) == []


@pytest.mark.slow
def test_a_short_run(tmp_path: Path) -> None:
    out, picture = tmp_path / "scaling.json", tmp_path / "scaling.png"
    flags = ["--videos", str(clips(tmp_path / "clips")), "--rows", "full", "--batch-size", "3", "--seconds", "0.3"]
    flags += ["--workers", "1,2", "--null-workers", "1,3", "--repeat", "1"]
    assert scaling.main([*flags, *FLAGS, "--json", str(out), "--plot", str(picture)]) in (0, 1)
    found = records(out)
    assert [(item["measure"], item["workers"]) for item in found] == [
        ("workers", 1), ("workers", 2), ("broker", 1), ("broker", 3), ("stalled", 3)
    ]  # fmt: skip
    sample = (4 * 5 + 4) * 32 * 40
    assert scaling.sample_bytes(RECIPE) == sample
    assert found[-1]["credit_window_bytes"] == 6 * sample
    one, two = found[:2]
    assert one["ratio_to_one_worker"] == two["ratio_to_two_workers"] == 1.0
    assert two["batches_per_second_by_turn"] == [two["batches_per_second"]]
    assert two["ratio_to_one_worker"] == two["batches_per_second"] / one["batches_per_second"]
    assert is_picture(picture)


@pytest.mark.parametrize("flags", [["--repeat", "0"], ["--seconds", "-1"]])
def test_wrong_usage_is_status_2(tmp_path: Path, flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert scaling.main(["--videos", str(tmp_path), *flags]) == 2
    assert one_line(capsys, "scaling")


def test_numbers_that_are_none_are_refused_by_the_parser(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        scaling.main(["--videos", str(tmp_path), "--workers", "1,0"])
    assert stopped.value.code == 2
