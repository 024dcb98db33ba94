"""Scaling: when a bar is missed."""

from __future__ import annotations

from typing import Any

import pytest

from bench.speed import scaling

MB = 1_000_000


def workers(count: int, **ratios: float) -> dict[str, Any]:
    return {"measure": "workers", "workers": count, **ratios}


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
    workers(1, ratio_to_1_worker=1.0, ratio_to_2_workers=0.57),
    workers(2, ratio_to_1_worker=1.75, ratio_to_2_workers=1.0),
    workers(8, ratio_to_1_worker=1.76, ratio_to_2_workers=1.0),
    broker(1, 0.5e9),
    broker(8, 1e9),
]


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (
            workers(2, ratio_to_1_worker=1.74, ratio_to_2_workers=1.0),
            "workers, 2: ratio_to_1_worker 1.74; the bar is at least 1.75",
        ),
        (
            workers(8, ratio_to_1_worker=1.8, ratio_to_2_workers=0.99),
            "workers, 8: ratio_to_2_workers 0.99; the bar is at least 1",
        ),
        (broker(8, 0.99e9), "broker: bytes_per_second 9.9e+08; the bar is at least 1e+09"),
        (broker(8, 1e9, peak=201 * MB), "broker, 8: broker_peak_rss_bytes 2.01e+08; the bar is at most 2e+08"),
    ],
)
def test_each_bar_is_missed_by_itself(record: dict[str, Any], words: str) -> None:
    same = (record["measure"], record["workers"])
    others = [item for item in GOOD if (item["measure"], item["workers"]) != same]
    (text,) = scaling.missed([*others, record], cores=2)
    assert words in text


def test_eight_workers_are_held_to_two_only_where_cores_are_few() -> None:
    slow = [*GOOD[:2], workers(8, ratio_to_1_worker=1.9, ratio_to_2_workers=0.95), *GOOD[3:]]
    assert scaling.missed(slow, cores=2)
    assert not scaling.missed(slow, cores=16)
