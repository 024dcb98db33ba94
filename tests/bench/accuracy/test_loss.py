"""The predicted loss on kinds of scenes that it was not calibrated on."""

from __future__ import annotations

import argparse

import pytest

from bench.accuracy.loss import is_inside, measure, scenes, summary


@pytest.mark.slow
def test_shapes_lie_in_their_intervals() -> None:
    records = list(scenes("held out", "plain shapes"))
    assert all(is_inside(record, name) for record in records for name in ("linear", "divided"))
    found = summary("held out", records)
    assert found["scenes"] == len(records) == 4
    assert found["rms_linear"] < 0.12


@pytest.mark.slow
def test_nine_of_ten_scenes_of_other_kinds_lie_in_their_intervals() -> None:
    found = measure(argparse.Namespace())
    assert found.missed == []
