"""Events of a moving pattern against the exact crossings of its light, a frame step a bin."""

from __future__ import annotations

import pytest

from tests.oracles.worlds import event_errors

GREY = (40.0, 250.0)
HZ = 60.0


@pytest.mark.parametrize("threshold", [0.1, 0.3])
@pytest.mark.parametrize(("period_px", "px_per_frame"), [(32.0, 0.5), (32.0, 2.0), (32.0, 8.0), (100.0, 8.0)])
def test_signed_events_are_off_by_at_most_two_percent(period_px: float, px_per_frame: float, threshold: float) -> None:
    """Levels between frames are rendered, not guessed; `python -m tests.oracles.worlds` prints the rest."""
    found = event_errors(GREY, period_px, px_per_frame * HZ, threshold, HZ, substep_px=1.0)
    assert found.signed <= 0.02
    assert abs(found.count) <= 0.02


def test_sub_steps_restore_what_a_fast_pattern_loses() -> None:
    """A period a frame: without them, the frames hardly differ."""
    coarse, fine = (event_errors(GREY, 8.0, 8.0 * HZ, 0.1, HZ, substep_px) for substep_px in (0.0, 0.5))
    assert coarse.count < -0.5
    assert abs(fine.count) < 0.02
    assert fine.signed <= 0.02
