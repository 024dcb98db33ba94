"""The predicted loss on kinds of scenes that it was not calibrated on."""

from __future__ import annotations

import pytest

from bench.accuracy.loss import LEAST_HELD, SETTINGS, scenes, summary
from tests.oracles.kinds import HELD_OUT


@pytest.mark.slow
def test_nine_of_ten_scenes_of_other_kinds_lie_in_their_intervals() -> None:
    """On every other kind: the bench renders all."""
    found = summary("held out", [record for kind in list(HELD_OUT)[::2] for record in scenes("held out", kind)])
    assert all(found[f"inside_{name}"] >= LEAST_HELD for name in SETTINGS), found
