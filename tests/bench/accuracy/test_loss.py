"""The predicted loss on kinds of scenes that it was not calibrated on."""

from __future__ import annotations

import argparse

import pytest

from bench.accuracy.loss import measure


@pytest.mark.slow
def test_nine_of_ten_scenes_of_other_kinds_lie_in_their_intervals() -> None:
    found = measure(argparse.Namespace())
    assert found.missed == []
