"""The flow methods beside the exact flow of worlds."""

from __future__ import annotations

import itertools

import pytest

from bench.accuracy.flow import LENGTHS_PX, beside_worlds


@pytest.mark.slow
def test_no_flow_at_all_is_wrong_by_the_length_of_the_exact_flow() -> None:
    records = {record["where"]: record for record in beside_worlds(("zero",), 3)}
    assert abs(sum(record["share"] for record in records.values()) - 1.0) < 1e-6
    for low, high in itertools.pairwise(LENGTHS_PX[1:]):
        record = records.get(f"{low:g} to {high:g} px")
        assert record is None or low <= record["error_median_px"] < high
