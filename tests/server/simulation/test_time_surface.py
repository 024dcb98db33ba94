"""The time surface: pixels whose events are known, its laws over any clip, and where its values end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.server.simulation.test_pixel import moving_frames
from tests.server.simulation.test_times import ALL, CONTRAST, FPS, again
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_server.simulation import simulate, simulate_clip, simulate_log
from v2v_server.simulation.kernels import Voxels
from v2v_server.simulation.representations import NAMES

NONE = np.inf


def surface(made: Voxels, **changes: Any) -> np.ndarray:
    """Return the surface of a clip, [grids, 2, bins, H, W]."""
    return np.asarray(again(made, "time_surface", **changes)["time_surface"], np.float64)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_pixel_with_known_crossings(precision: str) -> None:
    """It rises by 1 in 2 s from half a threshold: events every 0.4 s from 0.2 s on; it rests; it falls as fast."""
    frames = np.array([0, 255, 255, 0], np.uint8)[:, None, None]  # log intensities would take another kernel
    made = simulate(
        frames, threshold_pos=0.2 * CONTRAST, start_residual=0.1 * CONTRAST, bins=1, dtype="float32",
        precision=precision,
    )  # fmt: skip
    ages = surface(made, step_seconds=np.full(3, 2.0))
    # The last positive event is at 1.8 s. Falling events are due 0.3 after the turn: at 4.6, 5.0, 5.4, 5.8 s.
    np.testing.assert_allclose(ages[:, :, 0, 0, 0], [[NONE, 0.2], [NONE, 2.2], [0.2, 4.2]], atol=1e-5)


def test_bins_end_at_their_own_times() -> None:
    """Two grids of three bins in a step of 0.6 s: they end every 0.1 s. Events come every 0.12 s from 0.06 s on."""
    made = simulate_log(
        np.array([0.0, 1.0])[:, None, None], threshold_pos=0.2, start_residual=0.1, bins=3, grids_per_frame=2,
        dtype="float32",
    )  # fmt: skip
    ages = surface(made, step_seconds=np.array([0.6]))
    assert ages.shape == (2, 2, 3, 1, 1)
    events = np.array([0.06, 0.18, 0.30, 0.42, 0.54])
    expected = [end - events[events < end + 1e-9].max() for end in np.arange(1, 7) / 10]
    np.testing.assert_allclose(ages[:, 1].ravel(), expected, atol=1e-6)
    assert np.isinf(ages[:, 0]).all()


def test_uneven_steps_last_as_long_as_they_do() -> None:
    made = simulate_log(
        np.array([0.0, 0.3, 0.3, 0.3])[:, None, None], threshold_pos=0.2, start_residual=0.0, bins=3, dtype="float32"
    )
    ages = surface(made, step_seconds=np.array([0.3, 1.0, 0.05]))
    np.testing.assert_allclose(ages[0, 1].ravel(), [0.1, 1.1, 1.15], atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    effects=st.sampled_from([{}, ALL]), grids=st.sampled_from([0, 2]), size=st.sampled_from([(1, 1), (5, 9), (3, 513)]),
    seed=st.integers(0, 2**32),
)  # fmt: skip
def test_it_is_made_of_the_events_that_are_listed(effects: Any, grids: int, size: tuple[int, int], seed: int) -> None:
    """From the event list, whose times are whole microseconds; and other arrays do not change beside it."""
    made = simulate(
        moving_frames(13, *size, seed % 256), threshold_pos=0.2, threshold_neg=0.25, noise_sigma=0.1, bins=3,
        grids_per_frame=grids, seed=seed, dtype="float32", frames_per_second=FPS, **effects,
    )  # fmt: skip
    bins = 12 * grids * 3 if grids else 12
    bin_us = 12e6 / FPS / bins
    events, ages = made.to_events(bin_us), surface(made)
    latest, expected = np.full((2, *size), -np.inf), np.empty((bins, 2, *size))
    bin_of = np.minimum((events.t / bin_us).astype(int), bins - 1)
    for number in range(bins):
        here = bin_of == number
        np.maximum.at(latest, (events.p[here].astype(int), events.y[here], events.x[here]), events.t[here])
        expected[number] = (number + 1) * bin_us - latest
    got = ages.transpose(0, 2, 1, 3, 4).reshape(expected.shape)
    np.testing.assert_allclose(got * 1e6, expected, atol=2.1)
    assert (got >= 0).all()
    together = again(made, *NAMES)
    np.testing.assert_array_equal(together["voxels"], made.voxels)
    np.testing.assert_array_equal(together["time_surface"], surface(made))


def test_ages_grow_by_a_bin_where_nothing_fires() -> None:
    made = simulate(
        moving_frames(31, 9, 12, 4), threshold_pos=0.2, bins=5, dtype="float32", seed=3, frames_per_second=FPS
    )
    counts, ages = (
        made.array(name).transpose(0, 2, 1, 3, 4).reshape(30, 2, 9, 12) for name in ("event_counts", "time_surface")
    )
    is_quiet = counts[1:] == 0
    np.testing.assert_allclose(ages[1:][is_quiet], ages[:-1][is_quiet] + 1 / FPS, atol=1e-6)
    assert (ages[1:][~is_quiet] <= 1 / FPS + 1e-6).all()
    assert np.isinf(ages[0][counts[0] == 0]).all()
    assert 0 < is_quiet.mean() < 1


def test_float16_holds_what_ages_are_for() -> None:
    """int8 voxels come with ages in float16: a relative error below 2**-11 from 61 microseconds on."""
    made = simulate(moving_frames(31, 9, 12, 4), threshold_pos=0.2, bins=5, seed=3, frames_per_second=FPS)
    ages, exact = made.array("time_surface"), surface(made, dtype="float32")
    assert ages.dtype == np.float16
    assert (np.isinf(ages) == np.isinf(exact)).all()
    fired = np.isfinite(exact)
    np.testing.assert_allclose(ages[fired], exact[fired], rtol=2.0**-11, atol=2.0**-24)


def test_ages_beyond_float16_are_clipped_and_counted() -> None:
    """Steps of a day: the event of the first is older than 65504 s at the end of the second."""
    frames = np.array([0, 255, 255, 255], np.uint8)[:, None, None]
    made = simulate(frames, threshold_pos=5.0, bins=1, start_residual=0.0, frames_per_second=1 / 86_400)
    voxels = again(made, "time_surface")["time_surface"][:, :, 0, 0, 0]
    assert voxels[:, 0].tolist() == [NONE] * 3
    assert voxels[0, 1] < 65504
    assert voxels[1:, 1].tolist() == [65504.0, 65504.0]
    assert Voxels.of(made.given, made.real, {"time_surface": voxels.reshape(3, 2, 1, 1, 1).copy()}).saturated == {
        "time_surface": 2
    }


def test_a_clip_needs_the_durations_of_its_steps_for_it() -> None:
    recipe = Recipe(voxels_per_clip=2, bins=5, crop_height_px=6, crop_width_px=7, hot_pixel_share=0.0, noise_sigma=0.0)
    frames = (np.arange(11 * 6 * 7) * 37 % 256).astype(np.uint8).reshape(11, 6, 7)
    given = simulate(frames, threshold_pos=0.2).given
    out = {"time_surface": np.empty((2, 2, 5, 6, 7), np.float16)}
    with pytest.raises(UsageError, match="step_seconds is missing"):
        simulate_clip(frames, given.params, recipe, "int8", out=out)
    timed = simulate_clip(frames, given.params, recipe, "int8", np.full(10, 0.5), out | {"voxels": None})
    plain = simulate_clip(frames, given.params, recipe, "int8")
    np.testing.assert_array_equal(timed.voxels, plain.voxels)
