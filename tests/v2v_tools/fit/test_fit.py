"""A camera with known parameters is recorded and fitted again."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.cameras import Film, TrueCamera, record, rendered_film
from tests.oracles.simulators import frame_offset, part_of
from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, Light, SensorSize
from v2v_server.config import recipe_setting
from v2v_tools.fit import estimators
from v2v_tools.fit import recording as recording_module
from v2v_tools.fit.fit import FittedCamera, fit
from v2v_tools.fit.increments import increments_of, is_still, still_time
from v2v_tools.fit.interval import Estimate, bootstrap
from v2v_tools.fit.recording import Recorded, chosen_pixels, read_recording, recorded
from v2v_tools.fit.regression import Regression
from v2v_tools.fit.report import report_lines, write_recipe
from v2v_tools.fit.statistics import simulate_recording

LIGHT = Light.parse("2.2")
FAST = TrueCamera(0.2, 0.26, shot_noise_hz=3.0, leak_hz=0.0, refractory_seconds=5e-4, log_eps=0.01)
IGNORING = TrueCamera(0.23, 0.21, shot_noise_hz=3.0, refractory_seconds=1e-3, log_eps=0.01, noise_ignores=True)
ALTERNATING = TrueCamera(0.2, 0.23, 0.12, leak_hz=0.2, log_eps=0.01, band_share=0.24, band_hz=28.0)
SLOW = TrueCamera(0.25, 0.21, 0.12, 0.4, 0.6, 0.0, 60.0, log_eps=0.01)


STILL = Film(np.full((481, 24, 32), 0.5, np.float32), 240)
film = lru_cache(maxsize=3)(rendered_film)


def recording_of(
    camera: TrueCamera, film_seen: Film | None = None, frames: npt.NDArray[np.uint8] | None = None
) -> Recorded:
    made = record(film_seen or film("coffee", 48, 64, 70.0, moving=1.0), camera, 1)
    shown = made["frames"] if frames is None else frames
    height, width = shown.shape[1:]
    place = made["y"].astype(np.int64) * width + made["x"]
    return recorded(height, width, made["t"], place, made["p"], shown, made["frame_us"], light=LIGHT)


@lru_cache(maxsize=3)
def fitted(camera: TrueCamera) -> FittedCamera:
    return fit(recording_of(camera))


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "how"), [(FAST, "noise obeys it"), (IGNORING, "noise ignores it")])
def test_a_camera_with_refractory_period_and_noise_is_found_again(camera: TrueCamera, how: str) -> None:
    found = fitted(camera).estimates
    check(found, camera, ("threshold_pos", "threshold_neg", "refractory_seconds", "shot_noise_hz"))
    assert how in found["refractory_seconds"].note


@pytest.mark.slow
def test_a_camera_with_low_pass_mismatch_and_leak_is_found_again() -> None:
    names = ("threshold_pos", "threshold_neg", "threshold_mismatch_sigma", "leak_hz")
    check(fitted(SLOW).estimates, SLOW, names)
    corner = fitted(SLOW).estimates["photoreceptor_hz"]
    assert corner.told
    assert corner.low <= 1 / SLOW.photoreceptor_hz <= corner.high


@pytest.mark.slow
def test_noise_that_alternates_is_told_as_nothing_else() -> None:
    made = fitted(ALTERNATING)
    check(made.estimates, ALTERNATING, ("threshold_pos", "threshold_neg"))
    for name in ("shot_noise_hz", "leak_hz"):
        assert not made.estimates[name].told
        assert "events of still pixels alternate" in made.left_out[name]
    assert not {"shot_noise_hz", "leak_hz", "hot_pixel_share", "hot_pixel_sigma"} & made.camera.keys()
    text = " ".join(report_lines(made, "x"))
    assert "obeys it" not in text  # no noise event is known that could tell
    static = fit(dataclasses.replace(recording_of(ALTERNATING, STILL), frames=np.empty((0, 0), np.uint8)), static=True)
    assert {"shot_noise_hz", "leak_hz", "dead_pixel_share"} <= static.left_out.keys()


def check(estimates: Mapping[str, Estimate], camera: TrueCamera, names: tuple[str, ...]) -> None:
    for name in names:
        made, true = estimates[name], getattr(camera, name)
        assert made.told, (name, made)
        assert made.low * 0.97 <= true <= made.high * 1.03, (name, true, made)


@pytest.mark.slow
def test_an_absent_effect_is_left_out_and_the_report_says_why() -> None:
    left_out = fitted(FAST).left_out
    for name in ("threshold_mismatch_sigma", "photoreceptor_hz", "hot_pixel_share"):
        assert "too little to matter" in left_out[name]
    assert "refractory_seconds" not in left_out
    assert any(line.startswith("  photoreceptor_hz: at most") for line in report_lines(fitted(FAST), "x"))


@pytest.mark.slow
def test_the_recipe_is_one_that_a_server_accepts(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_recipe(path, fitted(SLOW), "recording.h5")
    recipe = recipe_setting(str(path), ())
    assert recipe.threshold[0] < 0.21 * 1.03
    assert recipe.threshold[1] > 0.21 * 0.97
    assert recipe.leak_hz[0] > 0.3
    assert 40 < recipe.photoreceptor_hz[0] < 60 * 1.1
    assert recipe.refractory_seconds == (0.0, 0.0)
    assert path.read_text().startswith("# Camera of recording.h5, fitted by v2v-fit")


def test_dead_pixels_are_silent_among_active_neighbours() -> None:
    side, dead = 40, np.arange(41, 800, 31)  # in the upper half: nothing in the lower one fires
    place = np.tile(np.setdiff1d(np.arange(800), dead), 30)
    frames, frame_us = np.full((2, side, side), 100, np.uint8), np.array([0, len(place)])
    made = recorded(side, side, np.arange(len(place)), place, place >= 0, frames, frame_us, light=LIGHT)
    found = estimators.dead_pixels(made, made.blocks())
    assert found.value == len(dead) / 800
    assert found.low <= found.value <= found.high < 0.1


def test_noise_is_that_of_pixels_whose_neighbours_are_quiet_too() -> None:
    """Half of the sensor sees motion too dark for a grey level: its pixels fire together."""
    rng, side, seconds, hz = np.random.default_rng(2), 40, 4, 4.0
    light = LIGHT.of(np.array(100.0))
    noise = rng.random((seconds * 1000, side, side)) < hz * (1 - 0.75 * light) / 1000
    moving = np.zeros_like(noise)
    moving[: seconds * 500 : 200, :, : side // 2] = True
    at, y, x = np.nonzero(noise | moving)
    frames = np.full((30 * seconds + 1, side, side), 100, np.uint8)
    frame_us = np.linspace(0, 1e6 * seconds, len(frames)).astype(np.int64)
    made = recorded(side, side, at * 1000, y * side + x, rng.random(len(at)) < 0.5, frames, frame_us, light=LIGHT)
    still = still_time(made, is_still(made))
    found = estimators.shot_noise(still, made.blocks(), np.zeros(side**2, np.bool_))
    assert found.told
    assert found.low <= hz <= found.high


def still_events(
    rng: np.random.Generator, counts: npt.NDArray[np.int64], on_share: npt.NDArray[np.float64], turns: float
) -> Recorded:
    """Return events of still pixels: signs are drawn for each pixel, or turn with a probability after the first."""
    owner = np.repeat(np.arange(len(counts)), counts)
    p = rng.random(len(owner)) < on_share[owner]
    for at in np.flatnonzero(np.diff(owner) == 0) + 1 if turns else ():
        p[at] = p[at - 1] != (rng.random() < turns)
    t = rng.integers(100_000, 3_900_000, len(owner))
    frames, frame_us = np.full((41, 32, 32), 100, np.uint8), np.arange(41) * 100_000
    t = t[np.lexsort((t, owner))]
    return recorded(32, 32, t, owner, p, frames, frame_us, light=LIGHT)


@settings(max_examples=15)
@given(st.floats(0.3, 8.0), st.floats(0.0, 1.5), st.floats(0.0, 1.0), st.integers(0, 99))
def test_signs_that_alternate_are_not_those_of_shot_noise_and_leak(
    rate: float, spread: float, on_share: float, seed: int
) -> None:
    """Rates and shares of signs differ from pixel to pixel, however far."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(rate * rng.lognormal(-(spread**2) / 2, spread, 1024)).astype(np.int64)
    shares = np.clip(on_share + rng.normal(0, 0.2, 1024), 0, 1)
    no_hot, everywhere = np.zeros(1024, np.bool_), np.ones((40, 1024), np.bool_)
    assert estimators.unexplained(still_events(rng, counts, shares, 0.0), everywhere, no_hot) == ""
    if np.maximum(counts - 1, 0).sum() > 100:
        made = still_events(rng, counts, shares, 0.85)
        assert "events of still pixels alternate" in estimators.unexplained(made, everywhere, no_hot)


@pytest.mark.parametrize(
    ("count", "one_sign", "said"), [(19.5, True, "barely beyond"), (25.0, True, ""), (19.5, False, "with both signs")]
)
def test_a_share_of_hot_pixels_is_at_most_one(count: float, one_sign: bool, said: str) -> None:
    """Pixels barely above the others, as noise of uneven rates has them, are the tail of an endless distribution."""
    is_hot = np.arange(1024) < 20
    on = np.where(is_hot, count if one_sign else count / 2, 2.0)
    off = np.where(is_hot, 0.0 if one_sign else count / 2, 2.0)
    still = np.repeat(np.stack([np.full(1024, 2.0), np.zeros(1024), on, off])[:, :, None] / 4, 4, axis=2)
    blocks = np.random.default_rng(0).integers(0, 64, 1024)
    share, sigma = estimators.hot_pixels(still, is_hot, (0.2, 0.2), 0.0, blocks)
    assert said in share.note
    assert share.told == sigma.told == (not said)
    assert said or 0.0 < share.low <= share.value <= share.high <= 1.0


@pytest.mark.parametrize("period", [Estimate(1e-3, 9e-4, 1.1e-3, 1e-4, "x"), Estimate(1e-3, 0.0, 9e-3, 1e-4, "x")])
@pytest.mark.parametrize("note", ["x", "noise ignores it: 90 intervals of any two signs end before 900 us"])
@pytest.mark.parametrize("shot", [Estimate(3.0, 2.9, 3.1), Estimate(1e-9, 0.0, 1e-9), Estimate(np.nan, np.nan, np.nan)])
def test_a_report_says_once_whether_noise_obeys_the_period(period: Estimate, note: str, shot: Estimate) -> None:
    given = dataclasses.replace(period, note=note)
    said = estimators.with_noise(given, shot, np.full(100_000, 5e3)).note
    assert said.count("obeys it") + said.count("ignores it:") <= 1
    assert ("obeys it" in said) == (note == "x" and given.told and shot.value == 3.0)


@pytest.mark.parametrize(
    ("camera", "late"), [(FAST, 0), (FAST, 2), (SLOW, 0)], ids=["no low-pass", "no low-pass, 8 ms late", "low-pass"]
)  # fmt: skip
def test_thresholds_and_low_pass_come_back_from_events_and_frames(camera: TrueCamera, late: int) -> None:
    """The low-pass is slower in the dark, frames are as late everywhere."""
    seen = film("camera", 48, 64, 70.0, moving=0.8, still=0.0)
    shown = np.minimum(np.arange(0, len(seen.grey), 8) + late, len(seen.grey) - 1)
    made = recording_of(camera, seen, np.rint(255 * seen.grey[shown]).astype(np.uint8))
    found = Regression(increments_of(made, camera.refractory_seconds, 33_333.0), made.blocks())
    if not late:
        names = ("threshold_pos", "threshold_neg", "log_eps")
        check(dict(zip(names, (found.positive, found.negative, found.log_eps), strict=True)), camera, names)
    inverse = 1 / camera.photoreceptor_hz if camera.photoreceptor_hz else 0.0
    assert found.corner.is_absent != bool(inverse)
    assert found.corner.is_absent or found.corner.low <= inverse
    assert inverse <= found.corner.high


def test_pieces_of_a_recording_that_differ_widen_an_interval() -> None:
    rng = np.random.default_rng(1)
    alike = np.stack([rng.normal(10.0, 0.1, 256), np.ones(256)], axis=1)
    by_time = alike + np.stack([np.tile([-1.0, -0.3, 0.3, 1.0], 64), np.zeros(256)], axis=1)
    widths = []
    for sums in (alike, by_time):
        value, low, high = bootstrap(sums, lambda s: np.array([s[0] / s[1]]))
        assert low[0] < value[0] < high[0]
        widths.append(high[0] - low[0])
    assert widths[0] < 0.05
    assert widths[1] > 1.0


@settings(max_examples=20)
@given(st.floats(3e-4, 3e-3), st.integers(0, 99))
def test_intervals_of_noise_that_ignores_the_period_only_bound_it(period: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    same = rng.random(200_000) < 0.8
    gaps = 1e6 * period + rng.exponential(5e3, len(same))
    noisy = rng.random(len(same)) < 0.1
    gaps = np.where(noisy, rng.exponential(3e4, len(same)), gaps)
    same = np.where(noisy, rng.random(len(same)) < 0.5, same)
    made = estimators.refractory(np.stack([gaps, same]))
    assert "ignores" in made.note
    assert made.low <= period <= made.high * 1.02
    assert made.high < 1.5 * period


@given(st.floats(0.05, 0.5), st.booleans())
def test_events_of_a_steady_ramp_count_its_change(threshold: float, rises: bool) -> None:
    """The level between two events is linear, so there is no residual: the count is the change over the threshold."""
    frames_us = np.arange(11) * 20_000
    level = 2.0 * frames_us / frames_us[-1]
    crossings = np.arange(1, int(2.0 / threshold) + 1) * threshold
    t = np.round(crossings / 2.0 * frames_us[-1]).astype(np.int64)
    grey = np.full((11, 1, 1), 100, np.uint8)
    made = recorded(1, 1, t, np.zeros(len(t), np.int64), np.full(len(t), rises), grey, frames_us, light=LIGHT)
    increments = increments_of(made, 0.0, 1e6)
    count = increments.on if rises else increments.off
    change = np.round(increments.seconds * 1e6) / frames_us[-1] * level[-1]
    np.testing.assert_allclose(count, change / threshold, atol=2e-4 / threshold)
    assert len(count) or len(t) < 3 or 2 * threshold > 0.5


@settings(max_examples=20)
@given(st.floats(1e-4, 3e-3), st.integers(0, 99))
def test_the_end_of_the_intervals_is_the_refractory_period(period: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gaps = 1e6 * period + rng.exponential(3e4, 20_000)
    made = estimators.refractory(np.stack([np.floor(gaps), rng.random(20_000) < 0.5]))
    assert made.told
    assert made.low - 5e-6 <= period <= made.high + 5e-6


def test_intervals_that_the_scene_ends_do_not_pass_for_a_refractory_period() -> None:
    rng = np.random.default_rng(3)
    same = rng.random(20_000) < 0.7
    gaps = np.where(same, 2000.0, 9000.0) + rng.exponential(2e3, 20_000)
    made = estimators.refractory(np.stack([gaps, same]))
    assert not made.told
    assert "speed" in made.note


def test_a_recording_in_files_is_the_recording_in_memory(tmp_path: Path) -> None:
    made = record(film("coins", 20, 24, 60.0, moving=0.2, still=0.1), FAST, 1)
    write_ijrr(tmp_path, made)
    read, direct = read_recording(tmp_path), recorded(
        20, 24, made["t"], made["y"].astype(np.int64) * 24 + made["x"], made["p"], made["frames"], made["frame_us"]
    )  # fmt: skip
    np.testing.assert_array_equal(read.t_us + int(made["t"].min()), direct.t_us)
    np.testing.assert_array_equal(read.first, direct.first)
    np.testing.assert_array_equal(read.counts, direct.counts)
    assert len(read.frames) in (len(direct.frames) - 1, len(direct.frames))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("0.1 -1 5 1", "x of event 1 is -1"),
        ("0.1 5 -1 0", "y of event 1 is -1"),
        ("0.1 24 5 1", "an event lies outside 24x20 px"),
    ],
)
def test_events_outside_the_sensor_are_refused(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "a.txt").write_text(f"24 20\n0.0 1 1 1\n{line}\n")
    with pytest.raises(UsageError, match=said):
        read_recording(tmp_path / "a.txt", ConvertOptions(size=SensorSize(24, 20)))


def write_ijrr(folder: Path, made: Mapping[str, npt.NDArray[Any]]) -> None:
    columns = zip(made["t"], made["x"], made["y"], made["p"], strict=True)
    lines = [f"{t * 1e-6:.6f} {x} {y} {int(p)}\n" for t, x, y, p in columns]
    height, width = made["frames"].shape[1:]
    (folder / "events.txt").write_text(f"{width} {height}\n" + "".join(lines))
    listing = []
    for number, (t, frame) in enumerate(zip(made["frame_us"], made["frames"], strict=True)):
        cv2.imwrite(str(folder / f"{number}.png"), frame)
        listing.append(f"{t * 1e-6:.6f} {number}.png\n")
    (folder / "images.txt").write_text("".join(listing))


def test_a_long_recording_is_read_within_its_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles are dropped, not time: the still end of a recording stays."""
    made = record(rendered_film("coins", 40, 56, 60.0, moving=0.2, still=0.2), FAST, 1)
    write_ijrr(tmp_path, made)
    whole = read_recording(tmp_path)
    monkeypatch.setattr(recording_module, "MOST_EVENTS", len(made["t"]) // 3)
    monkeypatch.setattr(recording_module, "MOST_FRAME_PIXELS", made["frames"].size // 5)
    part = read_recording(tmp_path)
    assert 0 < len(part.t_us) <= len(made["t"]) // 3
    assert 0 < part.frames.size <= made["frames"].size // 5
    assert part.seconds == pytest.approx(whole.seconds, rel=0.05)
    np.testing.assert_array_equal(part.counts, whole.counts)
    mine = part_of(whole, np.isin(whole.pixels, part.pixels))
    np.testing.assert_array_equal(part.frames, mine.frames)
    np.testing.assert_array_equal(np.diff(part.first), np.diff(mine.first))


@settings(max_examples=20)
@given(st.integers(64, 900), st.integers(64, 900))
def test_tiles_of_a_large_sensor_stay_within_the_limit(height: int, width: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording_module, "MOST_PIXELS", 4096)
        pixels = chosen_pixels(height, width)
    assert len(pixels) == min(height * width, 4096)
    assert (np.diff(pixels) > 0).all()
    assert np.isin(chosen_pixels(height, width, len(pixels) // 2), pixels).all()


@pytest.mark.slow  # of an oracle of a bench
@settings(max_examples=8)
@given(st.integers(-9, 9), st.sampled_from(["linear", "2.2", "srgb"]))
def test_the_offset_of_the_frames_is_found(offset_ms: int, name: str) -> None:
    """Gratings of any speed: the events have exact times, and the frames are seen later than they say."""
    rng, light = np.random.default_rng(offset_ms + 20), Light.parse(name)
    curve = light.of(np.arange(256.0))
    speed, phase = rng.uniform(3.0, 6.0, 1600), rng.uniform(0.0, 2 * np.pi, 1600)

    def levels(seconds: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(np.exp(0.5 * np.sin(speed * 2 * np.pi * seconds[:, None] + phase) - 1.2))

    fine = np.arange(0.0, 0.5, 2e-4)
    steps = np.floor(np.log(0.03 + levels(fine)) / 0.15)
    at, pixel = np.nonzero(np.diff(steps, axis=0))
    frame_us = np.arange(20_000, 480_000, 33_000)
    frames = np.abs(curve[:, None, None] - levels(frame_us * 1e-6 + offset_ms * 1e-3)).argmin(axis=0).astype(np.uint8)
    made = recorded(
        40, 40, (1e6 * fine[at + 1]).astype(np.int64), pixel, np.diff(steps, axis=0)[at, pixel] > 0,
        frames.reshape(-1, 40, 40), frame_us, light=light,
    )  # fmt: skip
    found = frame_offset(made)
    assert found.value == pytest.approx(offset_ms * 1e-3, abs=1e-3)
    assert found.low <= found.value <= found.high


def test_frames_of_unknown_light_are_refused(tmp_path: Path) -> None:
    write_ijrr(tmp_path, record(film("coins", 20, 24, 60.0, moving=0.2, still=0.1), FAST, 1))
    made = read_recording(tmp_path)
    with pytest.raises(UsageError, match=r"does not state the light of its frames.*--light linear"):
        fit(dataclasses.replace(made, light=None))
    assert made.light == Light.parse("linear")  # IJRR is of a DAVIS
    assert read_recording(tmp_path, ConvertOptions(light=LIGHT)).light == LIGHT


def test_a_camera_of_linear_frames_has_the_thresholds_of_the_same_light() -> None:
    """The same scene, once gamma-coded and once linear: the fit takes each for what it is."""
    coded = recording_of(FAST, film("camera", 48, 64, 70.0, moving=0.8, still=0.0))
    linear = np.rint(255.0 * LIGHT.of(np.arange(256.0))).astype(np.uint8)[coded.frames]
    others = [coded, dataclasses.replace(coded, frames=linear, light=Light.parse("linear"))]
    found = [Regression(increments_of(each, 5e-4, 33_333.0), each.blocks()) for each in others]
    assert found[1].positive.value == pytest.approx(found[0].positive.value, rel=0.15)
    wrong = dataclasses.replace(coded, light=Light.parse("linear"))
    assert (
        Regression(increments_of(wrong, 5e-4, 33_333.0), wrong.blocks()).positive.value < 0.7 * found[0].positive.value
    )


def test_srgb_is_simulated_as_its_own_curve() -> None:
    made = recording_of(FAST, rendered_film("camera", 24, 32, 70.0, moving=0.3, still=0.0))
    camera = {"threshold_pos": 0.2, "threshold_neg": 0.2, "log_eps": 0.02}
    counts = {
        name: len(simulate_recording(dataclasses.replace(made, light=Light.parse(name)), camera).t_us)
        for name in ("srgb", "2.2", "linear")
    }
    assert counts["srgb"] == pytest.approx(counts["2.2"], rel=0.06)
    assert counts["linear"] > 1.3 * counts["2.2"]  # the dark of this picture is lifted


@pytest.mark.parametrize("text", ["", "gamma", "0", "-1", "nan", "1e9"])
def test_a_light_is_a_name_or_an_exponent(text: str) -> None:
    with pytest.raises(UsageError, match="give linear, srgb or an exponent from"):
        Light.parse(text)
    assert Light.parse("1.0") == Light.parse("linear")
    assert Light.parse("2.2\n").name == "2.2"


def test_a_recording_without_events_is_refused() -> None:
    none = np.empty(0, np.int64)
    with pytest.raises(UsageError, match="no events"):
        recorded(4, 4, none, none, none.astype(bool), np.empty((0, 4, 4), np.uint8), none)
