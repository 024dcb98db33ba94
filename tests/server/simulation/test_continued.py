"""A clip in pieces has the events of the clip in one run, and events are listed in order."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.server.simulation.test_pixel import moving_frames
from v2v_protocol.events import EventList
from v2v_server.simulation import simulate
from v2v_server.simulation.continued import ContinuedClip
from v2v_server.simulation.kernels import KernelInput, list_events
from v2v_server.simulation.representations.listing import columns_in_order
from v2v_server.simulation.voxel import Levels, Moments

STEPS = 12
EFFECTS = {
    "threshold_mismatch_sigma": 0.15, "shot_noise_hz": 20.0, "leak_hz": 3.0, "refractory_seconds": 0.005,
    "photoreceptor_hz": 20.0, "dead_pixel_share": 0.02, "noise_band_share": 0.3,
}  # fmt: skip
STEP_US = np.tile([40_000.0, 33_333.25, 20_000.5], STEPS // 3)
SINCE_US = np.concatenate(([0.0], np.cumsum(STEP_US)))


def clip_of(effects: Any, *, has_levels: bool = False) -> KernelInput:
    """Return 12 steps of noisy moving pictures, of more than a block of pixels."""
    frames = moving_frames(STEPS + 1, 31, 33, seed=3)
    made = simulate(
        frames, threshold_pos=0.2, threshold_neg=0.25, noise_sigma=0.05, hot_pixel_count=5, hot_pixel_sigma=0.5,
        bins=1, seed=7, frames_per_second=25.0, **effects,
    )  # fmt: skip
    levels = None
    if has_levels:
        at = Moments(np.array([0, 0, 3, 4, 11]), np.array([0.25, 0.75, 0.5, 0.125, 0.5]))
        levels = Levels(at, np.random.default_rng(5).integers(0, 4081, (5, 31, 33), np.uint16))
    return dataclasses.replace(made.given, levels=levels, step_seconds=STEP_US / 1e6)


def columns(*events: EventList) -> list[Any]:
    """Return x, y, t and p of event lists, one after the other."""
    return [np.concatenate([getattr(each, name) for each in events]) for name in "xytp"]


@pytest.mark.parametrize("real", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@settings(max_examples=40, deadline=None)
@given(
    names=st.sets(st.sampled_from(sorted(EFFECTS))),
    cuts=st.sets(st.integers(1, STEPS - 1)),
    most=st.integers(1, 20_000),
    has_levels=st.booleans(),
)
def test_pieces_have_the_events_of_one_run(
    real: Any, names: set[str], cuts: set[int], most: int, has_levels: bool
) -> None:
    effects = {name: EFFECTS[name] for name in names}
    if "noise_band_share" in names:
        effects["noise_band_hz"] = 30.0 if has_levels else 90.0  # both forms of its law; steps that it divides
    given = clip_of(effects, has_levels=has_levels)
    clip = ContinuedClip(real, most)
    found = list[EventList]()
    for first, last in zip((0, *sorted(cuts)), (*sorted(cuts), STEPS), strict=True):
        levels = given.levels
        if levels is not None:
            inside = (levels.at.step >= first) & (levels.at.step < last)
            at = Moments(levels.at.step[inside] - first, levels.at.share[inside])
            levels = Levels(at, levels.grey[inside])
        part = dataclasses.replace(
            given, frames=given.frames[first : last + 1], source_index=np.arange(last - first + 1),
            noise_durations=given.noise_durations[first:last], step_seconds=given.step_seconds[first:last],
            levels=levels,
        )  # fmt: skip
        found += clip.events(part, SINCE_US[first : last + 1])
    whole = list_events(given, real, STEP_US)
    assert len(whole) > 1000
    for found_column, column in zip(columns(*found), columns(whole), strict=True):
        np.testing.assert_array_equal(found_column, column)


def test_after_a_restart_pixels_forget_what_they_saw() -> None:
    quiet = clip_of({})
    quiet = dataclasses.replace(quiet, params=dataclasses.replace(quiet.params, noise_sigma=0.0, hot_pixel_count=0))
    again = dataclasses.replace(quiet, frames=quiet.frames[::-1])
    clip = ContinuedClip(np.float32)
    first = columns(*clip.events(quiet, SINCE_US))
    assert len(first[0]) > 1000
    carried_on = columns(*clip.events(quiet, SINCE_US))
    clip.restart()
    restarted = columns(*clip.events(quiet, SINCE_US))
    list(clip.events(again, SINCE_US))
    assert not all(np.array_equal(one, other) for one, other in zip(first, carried_on, strict=True))
    for one, other in zip(first, restarted, strict=True):
        np.testing.assert_array_equal(one, other)


@given(
    data=st.data(),
    count=st.integers(0, 200),
    start=st.sampled_from([0, 2**40]),
    span=st.sampled_from([0, 3, 2**17, 2**61]),
)
def test_events_are_sorted_by_time_and_pixel_and_equal_ones_stay(data: Any, count: int, start: int, span: int) -> None:
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    rows = np.empty((count, 2), np.int64)
    rows[:, 0] = start + random.integers(0, span, count, endpoint=True)
    rows[:, 1] = random.integers(0, 2 * 7 * 3, count)
    t, code = rows.T.copy()
    order = np.lexsort((code >> 1, t))
    x, y, found_t, p = columns_in_order(rows, 7)
    np.testing.assert_array_equal(found_t, t[order])
    np.testing.assert_array_equal(x + 7 * y.astype(np.int64), code[order] >> 1)
    np.testing.assert_array_equal(p, code[order] % 2 == 1)
