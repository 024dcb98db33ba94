"""Events in time: the general kernel against events one by one and against the paper's kernel."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.decoded import decode_luma
from tests.oracles.in_time import ages_of, bilinear_of, counts_of, stacked_histogram, watch
from tests.oracles.noise import standard_normals, start_uniforms
from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from tests.server.simulation.test_pixel import moving_frames
from tests.server.video.test_real_videos import FOLDER as REAL_VIDEOS
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_server.simulation import simulate, simulate_clip
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.kernels import Voxels, fill, list_events
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.voxel import FINE_STEPS, Levels, Moments, rounding_tolerance, timeline
from v2v_server.video.probe import probe

SLOW = pytest.mark.slow  # another kernel to compile
FPS = 25.0
ALL = {
    "threshold_mismatch_sigma": 0.15, "shot_noise_hz": 20.0, "leak_hz": 3.0, "refractory_seconds": 0.005,
    "photoreceptor_hz": 20.0, "dead_pixel_share": 0.02,
}  # fmt: skip


def again(made: Voxels, *names: str, precision: Any = None, **changes: Any) -> dict[str, Any]:
    """Simulate the same clip by the general kernel."""
    return fill(dataclasses.replace(made.given, **changes), precision or made.real, dict.fromkeys(names))[0]


# --- against the paper's kernel ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "precision"),
    [("int8", "float32"), ("float32", "float32"), pytest.param("float32", "float64", marks=SLOW)],
)
@settings(max_examples=15, deadline=None)
@given(
    size=st.sampled_from([(1, 1), (6, 8), (1, 513), (31, 33)]),
    noise_sigma=st.sampled_from([0.0, 0.1]),
    hot_count=st.integers(0, 1),
    start_residual=st.none() | st.floats(-0.2, 0.2),
    seed=st.integers(0, 2**64 - 1),
)
def test_it_counts_the_events_of_the_papers_kernel(
    dtype: str, precision: str, size: Any, noise_sigma: float, hot_count: int, start_residual: float | None, seed: int
) -> None:
    made = simulate(
        moving_frames(21, *size, seed=seed % 256), threshold_pos=0.2, threshold_neg=0.25, noise_sigma=noise_sigma,
        hot_pixel_count=hot_count, hot_pixel_sigma=2.0, start_residual=start_residual, bins=5, frames_per_bin=2,
        seed=seed, dtype=dtype, precision=precision,
    )  # fmt: skip
    assert not made.given.needs_general
    found = again(made, *NAMES)
    np.testing.assert_array_equal(found["voxels"], made.voxels)
    counts = found["event_counts"].astype(np.int64)
    assert counts.min() >= 0
    if not made.saturated_bins:
        np.testing.assert_array_equal(counts[:, 1] - counts[:, 0], made.voxels)
        events = made.to_events(1000.0)
        assert len(events) == counts.sum()
        np.testing.assert_array_equal(events.voxels(2, 5, 1000.0, dtype), made.voxels)


# --- against events one by one ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("precision", "bits", "dtype"),  # the table of digests compiles both
    [("float32", 8, "float32"), ("float32", 12, "int8"), pytest.param("float64", 8, "float32", marks=SLOW)],
)
@settings(max_examples=15, deadline=None)
@given(data=st.data(), grids=st.integers(1, 4))
def test_kernel_equals_the_oracle(data: Any, grids: int, precision: str, bits: int, dtype: str) -> None:
    """Noise, hot drift, intermediate levels and a refractory period; bins that do not meet the intermediate levels."""
    seed, bins, steps, pixels = data.draw(st.integers(0, 2**32)), 3, 6, 24
    random = np.random.default_rng(seed)
    effects = {"refractory_seconds": 0.006} if data.draw(st.booleans()) else {}
    sigma = data.draw(st.sampled_from([0.0, 0.1]))
    frames, white, fine = moving_frames(steps + 1, 4, 6, seed % 256), 2**bits - 1, FINE_STEPS if bits == 8 else 1
    if bits > 8:
        frames = (frames * np.uint16(16) + random.integers(0, 16, frames.shape, np.uint16)).astype(np.uint16)
    made = simulate(
        frames, threshold_pos=0.2, threshold_neg=0.25, noise_sigma=sigma, bits=bits,
        hot_pixel_count=2, hot_pixel_sigma=0.5, bins=bins, grids_per_frame=grids, seed=seed, dtype=dtype,
        precision=precision, frames_per_second=FPS, **effects,
    )  # fmt: skip
    at = Moments(np.array([0, 0, 2, 3, 3, 3]), np.array([0.25, 0.7, 1 / 3, 0.1, 0.5, 0.9]))
    levels = Levels(at, random.integers(0, white * fine + 1, (6, 4, 6), np.uint16))
    found = again(made, *NAMES, levels=levels)
    events = list_events(dataclasses.replace(made.given, levels=levels), made.real, np.full(steps, 1e6 / FPS))

    table = np.log(1e-3 + (np.arange(white + 1) / white) ** 2.2)
    table_levels = table[made.given.frames.reshape(steps + 1, pixels)]
    between = np.interp(levels.grey.reshape(6, pixels) / fine, np.arange(white + 1), table)
    times = np.r_[np.arange(steps + 1.0), at.step + at.share]
    known = np.concatenate([table_levels, between])[np.argsort(times)]
    times = np.sort(times)
    key = made.given.params.noise_key
    added = np.zeros((steps, pixels))
    if sigma:
        added += standard_normals(key, steps, pixels) * sigma
    position, normal = hot_pixels(key, 2, pixels)
    added[:, position] += 0.5 * normal
    sums = np.concatenate([np.zeros((1, pixels)), np.cumsum(added, axis=0)])
    known += np.stack([np.interp(times, np.arange(steps + 1.0), sums[:, p]) for p in range(pixels)], axis=1)
    start = -0.25 + start_uniforms(key, pixels).astype(np.float64) * 0.45
    edges = np.linspace(0, steps, steps * grids * bins + 1)
    wrong = 0
    for p in range(pixels):
        seen = watch(
            times, known[:, p], start[p], 0.2, 0.25, tolerance=rounding_tolerance(0.2, 0.2),
            refractory=effects.get("refractory_seconds", 0.0) * FPS,
        )  # fmt: skip
        y, x = divmod(p, 6)
        got = found["event_counts"][:, :, :, y, x].astype(np.int64).transpose(1, 0, 2).reshape(2, -1)
        wrong += int(np.abs(got - counts_of(seen, edges)).sum())
        ages = found["time_surface"][:, :, :, y, x].transpose(1, 0, 2).reshape(2, -1) * FPS
        wrong += int(np.count_nonzero(~np.isclose(ages, ages_of(seen, edges), rtol=0.0, atol=3e-3)))
        here = (events.x == x) & (events.y == y)
        # An event within a rounding of the end of a bin may come a rounding later, and then shifts none of the others.
        if here.sum() == len(seen.times):
            np.testing.assert_allclose(events.t[here], np.array(seen.times) * 1e6 / FPS, atol=120)
            for grid in range(steps * grids):
                inside = (np.array(seen.times) > grid / grids) & (np.array(seen.times) <= (grid + 1) / grids)
                expected = bilinear_of(
                    np.array(seen.times)[inside], np.array(seen.signs)[inside], grid / grids, (grid + 1) / grids, bins
                )
                close = np.abs(found["voxels_bilinear"][grid, :, y, x] - expected) < 0.02 + 1e-3 * inside.sum()
                wrong += int(np.count_nonzero(~close))
    assert wrong <= 6


# --- arrays against events --------------------------------------------------------------------------------------------


def test_shot_noise_has_both_polarities_and_random_times() -> None:
    made = simulate(
        np.zeros((501, 8, 8), np.uint8), threshold_pos=0.2, bins=1, frames_per_bin=500, dtype="float32",
        frames_per_second=FPS, shot_noise_hz=40.0,
    )  # fmt: skip
    counts = made.array("event_counts").reshape(2, -1)
    for each in counts:
        assert abs(each.mean() - 400) < 4 * 20 / 8
    events = made.to_events(500e6 / FPS)
    within = (events.t % 40_000) / 40_000
    assert abs(within.mean() - 0.5) < 4 / np.sqrt(12 * len(within))
    assert abs(np.corrcoef(within[:-1], within[1:])[0, 1]) < 0.05 or len(np.unique(events.t)) > 0.9 * len(events) / 2


@pytest.mark.parametrize("dtype", ["float32", pytest.param("int16", marks=SLOW)])
@pytest.mark.parametrize("effects", [{}, ALL])
@pytest.mark.parametrize("grids", [0, 3])
def test_arrays_and_events_agree(effects: dict[str, float], grids: int, dtype: str) -> None:
    made = simulate(
        moving_frames(31, 37, 45, 5), threshold_pos=0.2, threshold_neg=0.25, noise_sigma=0.1, bins=5,
        grids_per_frame=grids, dtype=dtype, seed=9, **(effects and effects | {"frames_per_second": FPS}),
    )  # fmt: skip
    assert made.voxels.shape == ((30 * grids, 5, 37, 45) if grids else (6, 5, 37, 45))
    counts, bilinear = made.array("event_counts"), made.array("voxels_bilinear").astype(np.float64)
    assert counts.dtype == dtype
    assert bilinear.shape == made.voxels.shape
    np.testing.assert_array_equal(counts[:, 1] - counts[:, 0], made.voxels)
    # A bin's width apart from edges that do not fall on whole microseconds: 33_333.3.
    bin_us = 100_000 / 3
    events = made.to_events(bin_us)
    np.testing.assert_array_equal(events.voxels(*made.voxels.shape[:2], bin_us), made.voxels)
    assert len(events) == counts.astype(np.int64).sum()
    np.testing.assert_allclose(bilinear.sum(axis=1), made.voxels.sum(axis=1), atol=0.05)
    grid = 2
    inside = (events.t >= grid * 5 * bin_us) & (events.t < (grid + 1) * 5 * bin_us)
    here = inside & (events.x == 20) & (events.y == 11)
    expected = bilinear_of(
        events.t[here].astype(float), np.where(events.p[here], 1.0, -1.0), grid * 5 * bin_us, (grid + 1) * 5 * bin_us, 5
    )
    np.testing.assert_allclose(bilinear[grid, :, 11, 20], expected, atol=0.01)


def real_frames(name: str, count: int = 21, size: tuple[int, int] = (30, 40)) -> np.ndarray:
    """Return frames of a part of a real video, [count, *size]."""
    if not (REAL_VIDEOS / name).is_file():
        pytest.skip(f"no {name} in {REAL_VIDEOS}; set V2V_TEST_VIDEOS")
    index = probe(REAL_VIDEOS / name).index
    return decode_luma(REAL_VIDEOS / name, index.slice(0, count), 0, count, (100, 100, *size)).frames


@pytest.mark.parametrize("grids", [0, 2])
@pytest.mark.parametrize("video", ["", "gopro_hero7_walk.mp4"])
def test_the_published_stacked_histogram_of_the_events_is_the_array(video: str, grids: int) -> None:
    """Its bins reach from the first to the last event. A column beside the picture has one at either end of a grid."""
    frames = real_frames(video) if video else moving_frames(21, 30, 40, 5)
    made = simulate(frames, threshold_pos=0.1, bins=10, grids_per_frame=grids, dtype="float32", seed=4)
    counts, bin_us = made.array("event_counts"), 5000
    events = made.to_events(bin_us)
    for grid, expected in enumerate(counts):
        begin, end = grid * 10 * bin_us, (grid + 1) * 10 * bin_us
        inside = (events.t >= begin) & (events.t < end)
        columns = (events.x, 40, 40), (events.y, 0, 0), (events.t, begin, end), (events.p, 0, 0)
        x, y, t, p = (np.r_[first, column[inside].astype(np.int64), last] for column, first, last in columns)
        got = stacked_histogram(x, y, p, t, 10, 30, 41)[:, :, :40]
        np.testing.assert_array_equal(got, expected.reshape(20, 30, 40))


# --- limits -----------------------------------------------------------------------------------------------------------

# Grey levels, not log intensities: each pair of types of frames and voxels is another kernel to compile.
BLACK_WHITE_BLACK = np.array([0, 255, 0], np.uint8)[:, None, None]
CONTRAST = float(np.ptp(log_table(2.2, 1e-3)))


def test_every_array_saturates_and_counts_it() -> None:
    made = simulate(BLACK_WHITE_BLACK, threshold_pos=CONTRAST / 300.5, bins=1, frames_per_bin=2, start_residual=0.0)
    arrays, saturated = fill(made.given, made.real, dict.fromkeys(NAMES))
    assert made.voxels.ravel().tolist() == [0]
    assert arrays["event_counts"].ravel().tolist() == [127, 127]
    assert saturated == {"voxels": 0, "event_counts": 2, "voxels_bilinear": 0, "time_surface": 0}


def test_timeline_by_hand() -> None:
    """Two steps, bins of 2/3 of a step, a level at half of the first step."""
    part = timeline(
        Moments(np.array([0, 0, 1, 2]), np.array([0.0, 2 / 3, 1 / 3, 0.0])), 3, np.ones(2),
        Moments(np.array([0]), np.array([0.5])),
    )  # fmt: skip
    assert part.step.tolist() == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(part.start, [0, 1 / 2, 2 / 3, 0, 1 / 3])
    np.testing.assert_allclose(part.share, [1 / 2, 1 / 6, 1 / 3, 1 / 3, 2 / 3])
    assert part.level.tolist() == [-1, 1, 1, 2, 2]
    np.testing.assert_allclose(part.reached, [1, 1 / 3, 1, 1 / 3, 1])
    assert (part.reached[[0, 2, 4]] == 1).all()
    assert part.bin.tolist() == [0, 0, 1, 1, 2]
    np.testing.assert_allclose(part.place, [[0, 0.75, 1, 1.5, 2], [0.75, 0.25, 0.5, 0.5, 1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grids_per_frame": 2, "frames_per_bin": 3}, "frames_per_bin = 3"),
        ({"grids_per_frame": -1}, "grids_per_frame = -1"),
        ({"dtype": "uint8"}, "uint8"),
    ],
)
def test_what_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        simulate(moving_frames(7, 4, 5), threshold_pos=0.2, bins=3, **change)
    with pytest.raises(UsageError, match="1 frames of 5x4 pixels: give 2 frames or more"):
        simulate(moving_frames(1, 4, 5), threshold_pos=0.2, bins=3, grids_per_frame=2)
    with pytest.raises(UsageError, match="'counts'"):
        simulate(moving_frames(4, 4, 5), threshold_pos=0.2, bins=3).array("counts")


DIGEST = """
import dataclasses, hashlib
import numpy as np
from tests.server.simulation.test_pixel import moving_frames
from tests.server.simulation.test_times import ALL, FPS
from v2v_server.simulation import simulate
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.kernels import fill
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.voxel import FINE_STEPS, Levels, Moments

grey = np.linspace(0, 255 * FINE_STEPS, 80).astype(np.uint16).reshape(2, 5, 8)
levels = Levels(Moments(np.array([0, 2]), np.array([0.25, 1 / 3])), grey)
digest = hashlib.sha256()
for effects in ({}, ALL):
    for precision in ("float32", "float64"):
        made = simulate(
            moving_frames(9, 5, 8, 3), threshold_pos=0.2, noise_sigma=0.1, bins=3, grids_per_frame=2, dtype="float32",
            seed=5, frames_per_second=FPS, precision=precision, **effects,
        )
        for array in fill(dataclasses.replace(made.given, levels=levels), made.real, dict.fromkeys(NAMES))[0].values():
            digest.update(array.tobytes())
        digest.update(made.to_events(1000.0).t.tobytes())
print(digest.hexdigest()[:32])
"""


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS)
def test_bytes_do_not_depend_on_the_processor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exec(DIGEST)
    assert printed_on_a_generic_processor(DIGEST, tmp_path) == capsys.readouterr().out.split()


# --- the time surface -------------------------------------------------------------------------------------------------

NONE = np.inf


def surface(made: Voxels, **changes: Any) -> np.ndarray:
    """Return the surface of a clip, [grids, 2, bins, H, W]."""
    return np.asarray(again(made, "time_surface", **changes)["time_surface"], np.float64)


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=SLOW)])
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


def test_uneven_steps_last_as_long_as_they_do() -> None:
    frames = np.array([0, 255, 255, 255], np.uint8)[:, None, None]
    made = simulate(frames, threshold_pos=CONTRAST / 1.5, start_residual=0.0, bins=3, dtype="float32")
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
