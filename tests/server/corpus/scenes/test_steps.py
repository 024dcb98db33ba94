"""Patterns of repeats, and stretches of frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_server.corpus.scenes.stretches import duplicated, pattern_of, runs_of

BLOCKS = 100
MOVING = 64**2 * BLOCKS
"""Sum of squares where each block changes by a grey level."""


@given(st.integers(2, 12), st.data())
def test_one_repeat_in_each_period_is_found_and_named(period: int, data: st.DataObject) -> None:
    offset = data.draw(st.integers(0, period - 1))
    changes = [
        MOVING * data.draw(st.integers(1, 3)) if at % period != offset else data.draw(st.integers(0, MOVING // 25))
        for at in range(10 * period)
    ]
    flags = duplicated(changes, BLOCKS)
    np.testing.assert_array_equal(flags, np.arange(len(changes)) % period == offset)
    special = {2: "every picture twice", 5: "24 in 30", 6: "25 in 30"}
    assert pattern_of(flags) == special.get(period, f"1 of every {period}")


def test_motion_that_comes_to_rest_or_begins_is_no_repeat() -> None:
    resting = [MOVING] * 20 + [0] * 20 + [MOVING] * 20
    assert not duplicated(resting, BLOCKS).any()


def test_a_cut_in_slow_motion_makes_no_repeats() -> None:
    assert not duplicated(([MOVING] * 10 + [900 * MOVING]) * 6, BLOCKS).any()


def test_changes_below_coder_noise_are_no_motion() -> None:
    assert not duplicated([MOVING // 30, 0] * 30, BLOCKS).any()


@pytest.mark.parametrize("repeats", [3, 4])
def test_a_few_repeats_in_a_long_video_may_be_chance(repeats: int) -> None:
    """Their step is an eighth of the others, and the next one makes up for it."""
    changes = [MOVING] * 100
    changes[10 : 10 * (repeats + 1) : 10] = [MOVING // 8] * repeats
    changes[11 : 10 * (repeats + 1) + 1 : 10] = [2 * MOVING] * repeats
    assert duplicated(changes, BLOCKS).sum() == (repeats if repeats >= 4 else 0)


@given(st.integers(0, 59), st.integers(0, MOVING // 12), st.data())
def test_a_single_repeat_amid_motion_is_found(place: int, change: int, data: st.DataObject) -> None:
    changes = [MOVING + data.draw(st.integers(0, MOVING)) for _ in range(60)]
    changes[place] = change
    expected = [place] if 4 <= place < 56 else []
    assert np.flatnonzero(duplicated(changes, BLOCKS)).tolist() == expected


def test_a_keyframe_that_a_coder_repeats_is_no_repeat() -> None:
    changes = [MOVING] * 60
    changes[29:31] = [30 * MOVING, 0]
    assert not duplicated(changes, BLOCKS).any()


@given(st.lists(st.booleans(), max_size=40), st.integers(1, 5), st.integers(0, 3))
def test_stretches_cover_what_they_say(flags: list[bool], least: int, gap: int) -> None:
    covered = {at for first, end in runs_of(np.array(flags, bool), least, gap) for at in range(first, end)}
    for first, end in runs_of(np.array(flags, bool), least, gap):
        assert end - first >= least
        assert flags[first]
        assert flags[end - 1]
    if least == 1:
        assert covered >= {at for at, flag in enumerate(flags) if flag}
    if gap == 0:
        assert all(flags[at] for at in covered)
