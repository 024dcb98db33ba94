"""The judge of simulators: on a recording that a known simulator made, that simulator comes first."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from bench.accuracy import sensor
from tests.oracles import simulators
from tests.oracles.simulators import part_of
from v2v_protocol.errors import UsageError
from v2v_recordings.items import Light
from v2v_tools.fit.recording import Recorded, recorded
from v2v_tools.fit.statistics import simulate_recording

HEIGHT, WIDTH = 32, 48
CAMERA = {"threshold_pos": 0.2, "threshold_neg": 0.2, "log_eps": 0.02}


def given(name: str = "linear") -> Recorded:
    """Gratings that move, seen by a simulated camera."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    frames = np.stack([100 + 60 * np.sin(0.5 * x + 0.2 * y + 0.9 * step) for step in range(6)]).astype(np.uint8)
    one = np.zeros(1, np.int64)
    blank = recorded(
        HEIGHT, WIDTH, one, one, one > 0, frames, 1_000_000 + 20_000 * np.arange(6), light=Light.parse(name)
    )  # fmt: skip
    return simulators.within(simulate_recording(blank, CAMERA, 3, "triangular"))


V2E = """
import numpy as np
class EventEmulator:
    def __init__(self, pos_thres=0.2, neg_thres=0.2, seed=0, output_folder=None, device="cuda"):
        self.before, self.pos_thres, self.t_previous = None, pos_thres, 0
        assert device == "cpu", "no CUDA here"
    def set_dvs_params(self, name):
        assert name == "noisy"
    def generate_events(self, frame, seconds):
        if seconds < self.t_previous:
            raise ValueError("this frame time must be later than previous frame time")
        self.t_previous = seconds
        before, self.before = self.before, frame
        if before is None:
            return None
        y, x = np.nonzero(frame > before)
        return np.stack([np.full(len(x), seconds), x, y, np.ones(len(x))], axis=1).astype(np.float32)
"""
OPENEB = """
import numpy as np
from metavision_sdk_base import EventCD
class EventSimulator:
    def __init__(self, height, width, Cp, Cn, refractory_period):
        self.before, self.found = None, []
    def image_callback(self, picture, us):
        before, self.before = self.before, picture
        if before is not None:
            y, x = np.nonzero(picture > before)
            self.found += [(i, j, 1, us - 1000) for i, j in zip(x, y)]
    def get_events(self):
        return np.array(self.found, EventCD)
"""
EVENTCV = """
import numpy as np
def simulate(frames, fps, seed=0, pos_thres=0.2, neg_thres=0.2):
    step, y, x = np.nonzero(np.diff(frames, axis=0) > 0)
    t = ((step + 1) * 1e6 / fps - 1000).astype(np.uint64)
    class Stream:
        numpy = staticmethod(lambda: np.stack([x, y, t, np.ones_like(x)], axis=1).astype(np.uint64))
    return Stream()
"""
V2V = """
import numpy as np
class EventEmulator:
    def __init__(self, pos_thres, neg_thres, base_noise_std, hot_pixel_fraction, hot_pixel_std):
        pass
    def video_to_voxel(self, video):
        return (np.diff(video, axis=0) > 0).astype(float)
"""
TOYS = {
    "v2ecore/emulator.py": V2E,
    "metavision_core_ml/video_to_event/__init__.py": "import metavision_sdk_core  # compiled",
    "metavision_core_ml/video_to_event/simulator.py": OPENEB,
    "eventcv.py": EVENTCV,
    "data/v2v_core_esim.py": V2V,
}


@pytest.fixture
def toys(tmp_path: Path) -> Iterator[Path]:
    """Write a package with the interface of each peer: one event at each pixel that becomes brighter."""
    for name, text in TOYS.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    modules = set(sys.modules)
    sys.path.insert(0, str(tmp_path))
    yield tmp_path
    sys.path.remove(str(tmp_path))
    for name in set(sys.modules) - modules:
        if name.partition(".")[0] in ("v2ecore", "metavision_core_ml", "metavision_sdk_base", "eventcv", "data"):
            del sys.modules[name]


@pytest.mark.parametrize("name", simulators.PEERS)
@pytest.mark.parametrize("threshold", [0.0, 0.3])
def test_an_adapter_puts_events_where_the_package_saw_them(toys: Path, name: str, threshold: float) -> None:
    whole = given()
    # Every other tile, as of a sensor too large to keep: pixels are not neighbours.
    asked = part_of(whole, whole.pixels % WIDTH < 32)
    # A first frame before the first event has a negative time.
    asked = dataclasses.replace(asked, t_us=asked.t_us - 1_000_500, frame_us=asked.frame_us - 1_000_500)
    counts = simulators.counts_of(simulators.PEERS[name](asked, threshold, 0))
    np.testing.assert_array_equal(counts[1], np.diff(asked.frames.astype(int), axis=0) > 0)
    assert not counts[0].any()


def figures_of(made: Recorded, other: Recorded) -> dict[str, float]:
    sums = simulators.tallied(made, simulators.counts_of(made), other)
    return dict(zip(simulators.FIGURES, simulators.figures(sums.sum(axis=0)).mean(axis=0), strict=True))


def test_a_recording_is_like_itself_and_not_like_its_mirror() -> None:
    made = given()
    same = figures_of(made, made)
    assert same["correlation"] == pytest.approx(1.0)
    assert (same["log_ratio"], same["intervals"], same["missed"], same["invented"]) == (0.0, 0.0, 0.0, 0.0)
    assert abs(same["mirrored"]) < 0.6
    empty = figures_of(made, simulators.of_events(made, [], [], []))
    assert (empty["correlation"], empty["missed"], empty["invented"]) == (0.0, 1.0, 0.0)


def test_the_rate_of_still_pixels_is_that_of_pixels_around_which_no_frame_changes() -> None:
    """Events are added to every pixel; a rate is counted where the picture stands still, and near no pixel that
    moves.
    """
    made = given()
    frames = made.frames.copy()
    frames[:, made.pixels % WIDTH < 24] = 100
    frames[:, made.pixels % WIDTH < 12] += np.arange(6, dtype=np.uint8)[:, None] % 2  # noise of frames
    half = dataclasses.replace(made, frames=frames)
    still = simulators.is_unchanged(half)
    np.testing.assert_array_equal(still, np.broadcast_to(made.pixels % WIDTH < 20, still.shape))
    every = np.arange(len(made.pixels))
    noisy = simulators.of_events(half, np.repeat(made.frame_us[:-1] + 7, len(every)), np.tile(every, 5), still.ravel())
    empty = simulators.of_events(half, [], [], [])
    found = figures_of(empty, noisy)
    assert (found["still_hz"], found["sensor_still_hz"]) == (pytest.approx(1 / 0.02), 0.0)
    assert figures_of(noisy, empty)["sensor_still_hz"] == pytest.approx(1 / 0.02)


@pytest.mark.parametrize("hz", [100.0, 120.0, 77.0])
def test_a_lamp_is_told_by_the_phase_of_brighter_events(hz: float) -> None:
    made = given()
    still = dataclasses.replace(made, frames=np.full_like(made.frames, 90))
    t = np.arange(0.0, 0.1, 1 / hz)
    us = made.frame_us[0] + np.repeat(1e6 * np.concatenate([t, t + 0.5 / hz]), 9)  # darker half a period later
    lamp = simulators.of_events(still, us, np.arange(len(us)), np.arange(len(us)) < len(us) // 2)
    assert (sensor.lamp_strength(lamp) > 0.99) == (hz in sensor.LAMPS_HZ)
    assert sensor.lamp_strength(simulators.of_events(still, [], [], [])) == 0.0


@settings(max_examples=10)
@hypothesis.given(st.integers(0, 99))
def test_figures_from_sums_are_those_of_the_maps(seed: int) -> None:
    made = given()
    random = np.random.default_rng(seed)
    kept = random.random(len(made.t_us)) < 0.7
    owner = np.repeat(np.arange(len(made.pixels)), np.diff(made.first))
    other = simulators.of_events(made, made.t_us[kept], owner[kept], random.permutation(made.p[kept]))
    true, found = simulators.counts_of(made), simulators.counts_of(other)
    wanted = [simulators.correlation(a, b) for a, b in zip(found[1] - found[0], true[1] - true[0], strict=True)]
    ratios = np.log((found.sum(axis=(0, 2)) + 0.5) / (true.sum(axis=(0, 2)) + 0.5))
    got = figures_of(made, other)
    assert got["correlation"] == pytest.approx(np.mean(wanted))
    assert got["ratio"] == pytest.approx(ratios.mean())
    both = (found.sum(axis=0) > 0) & (true.sum(axis=0) > 0)
    assert got["missed"] == pytest.approx(np.mean(1 - both.sum(axis=1) / (true.sum(axis=0) > 0).sum(axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize("light", ["linear", "2.2", "srgb"])
def test_the_equations_agree_with_the_kernel(light: str) -> None:
    made = given(light)
    assert figures_of(made, simulators.equations(made, 0.2, 1))["correlation"] > 0.8


def test_an_interval_holds_the_spread_of_blocks_and_of_steps() -> None:
    made = given()
    sums = simulators.tallied(made, simulators.counts_of(made), made)[None]
    alike = sensor.of_pieces(sums)
    place = simulators.FIGURES.index("correlation")
    assert alike.value[place] == pytest.approx(1.0)
    np.testing.assert_allclose(alike.drawn[:, place], 1.0)
    apart = sums.copy()
    apart[:, :, 0] = simulators.tallied(made, simulators.counts_of(made), simulators.of_events(made, [], [], []))[:, 0]
    row = sensor.of_pieces(apart).record()
    assert row["correlation"] == pytest.approx(0.8)
    assert row["correlation_low"] < 0.6
    assert row["correlation_high"] > 0.95


def asked_for(recordings: Path, **changed: Any) -> argparse.Namespace:
    flags: dict[str, Any] = {"recipe": [], "peer": [], "light": [], "draws": 1, "json": None}
    return argparse.Namespace(recordings=recordings, **(flags | changed))


@pytest.mark.slow
def test_thresholds_are_found_on_one_half_and_bars_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = given()
    monkeypatch.setattr(sensor, "seen", lambda path: (made, "toy: 5 steps"))
    for name in "ab":
        (tmp_path / f"{name}.h5").touch()
    report = sensor.measure(asked_for(tmp_path, draws=5))
    rows = {(row["recording"], row["light"], row["simulator"], row["at"]): row for row in report.records}
    assert {light for _, light, _, _ in rows} == {"linear", "2.2", "stated"}
    assert rows["a", "linear", sensor.NEW, "number"]["threshold"] == pytest.approx(0.2, rel=0.35)
    assert rows["a", "linear", sensor.NEW, "best"]["correlation"] <= 1.0
    assert not any(row["stated"] for key, row in rows.items() if key[1] == "2.2")
    whole = [row for row in report.records if row["recording"] == "all"]
    for at in ("own", "best", "number"):
        mine = [row for row in whole if row["at"] == at]
        ranks = {int(row["correlation_rank"].split()[0]): row["correlation"] for row in mine}
        assert sorted(ranks) == list(range(1, len(mine) + 1))
        assert [ranks[rank] for rank in sorted(ranks)] == sorted(ranks.values(), reverse=True)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, ""),
        ({"correlation": 0.52}, "noise costs 0.080 of the correlation; the bar is at 0.03"),
        ({"correlation": 0.3}, f"correlation: {sensor.NEW} 0.300, paper 0.400; noise costs 0.300"),
        ({"log_ratio": 1.5}, f"log ratio: {sensor.NEW} 1.500, paper 1.000"),
        ({"still_hz": 0.9}, f"where frames are still, {sensor.NEW} fires 4.50 times the sensor's events"),
        ({"still_hz": 0.06}, f"where frames are still, {sensor.NEW} fires 0.30 times the sensor's events"),
        ({"still_hz": 0.9, "lamp": 0.9}, ""),
    ],
)
def test_each_bar_is_judged_by_its_own_figure(changed: dict[str, float], said: str) -> None:
    """A lamp, which frames do not show, is not held against a simulator."""
    given = {"correlation": 0.6, "log_ratio": 0.5, "still_hz": 0.3, "sensor_still_hz": 0.2, "steps": 3, "lamp": 0.1}
    others = {"paper": {"correlation": 0.4, "log_ratio": 1.0}, f"{sensor.NEW}, quiet": {}, sensor.NEW: changed}
    rows = [
        {"recording": recording, "simulator": name, "at": "own", "stated": True, **given, **own}
        for recording in ("a", "b", "all")
        for name, own in others.items()
    ]
    for row in rows:
        if row["recording"] == "all":
            del row["lamp"]
    assert "; ".join(sensor.missed(rows)).startswith(said)
    assert bool(sensor.missed(rows)) == bool(said)
    assert sensor.missed([dict(row, stated=False) for row in rows]) == []


def test_what_the_odd_stripes_show_chooses_nothing() -> None:
    """Events added to the half that is reported change its figures, and no threshold that is chosen."""
    made = given()
    owner = np.repeat(np.arange(len(made.pixels)), np.diff(made.first))
    is_odd = np.repeat(~sensor.CHOOSES[made.blocks()], np.diff(made.first))
    louder = simulators.of_events(
        made, np.concatenate([made.t_us, np.repeat(made.t_us[is_odd] + 1, 3)]),
        np.concatenate([owner, np.repeat(owner[is_odd], 3)]), np.concatenate([made.p, np.repeat(made.p[is_odd], 3)]),
    )  # fmt: skip
    louder = simulators.within(louder)
    found = [list(sensor.judged(each, simulators.counts_of(each), simulators.esim, 1)) for each in (made, louder)]
    assert [threshold for _, threshold, _ in found[0]] == [threshold for _, threshold, _ in found[1]]
    assert found[1][0][2].record()["ratio"] < 0.5 * found[0][0][2].record()["ratio"]


def test_rows_stay_when_a_peer_fails_and_one_recording_is_no_verdict(
    toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = given()
    monkeypatch.setattr(sensor, "seen", lambda path: (made, "toy: 5 steps"))
    monkeypatch.setattr(sensor, "RECIPES", ("paper", sensor.NEW))
    (toys / "v2ecore" / "emulator.py").write_text("EventEmulator = int")
    (toys / "eventcv.py").write_text("import sys\ndef simulate(frames, **rest):\n    sys.exit(1)")
    out = tmp_path / "rows.json"
    written = list[int]()
    monkeypatch.setattr(sensor, "write_json", lambda path, rows: written.append(len(rows)))
    asked = asked_for(
        tmp_path / "toy.h5", peer=[f"v2e={toys}", "eventcv=", f"openeb={toys}"], light=["linear"], json=out
    )
    report = sensor.measure(asked)
    names = {row["simulator"] for row in report.records}
    assert "openeb" in names
    assert not {"v2e", "eventcv"} & names
    assert written == list(range(1, written[-1] + 1))  # a row at a time
    assert len(report.missed) == 2
    assert "peer v2e failed: TypeError" in report.missed[0]
    assert "peer eventcv failed: SystemExit" in report.missed[1]
    assert any("at least 2 recordings" in line for line in report.lines)
    said = capsys.readouterr().err
    assert "toy.h5, light linear: openeb, 8 of 8\n  own: correlation " in said


def test_an_unknown_peer_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--peer esim=x: give one of v2e, v2e-noisy, openeb, eventcv"):
        sensor.measure(asked_for(tmp_path, peer=["esim=x"]))


def test_what_is_near_white_is_left_out_and_recordings_without_frames_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = given()
    lamp = made.frames.copy()
    lamp[2, np.searchsorted(made.pixels, 5 * WIDTH + 40)] = 255
    bright: Any = dataclasses.replace(made, frames=lamp)
    monkeypatch.setattr(sensor, "read_recording", lambda path, options: bright)
    seen, text = sensor.seen(tmp_path / "lamp.h5")
    row, column = np.divmod(seen.pixels, WIDTH)
    assert not ((abs(row - 5) <= 8) & (abs(column - 40) <= 8)).any()
    assert len(seen.pixels) % simulators.ROWS == 0
    assert "left out near white" in text
    monkeypatch.setattr(sensor, "read_recording", lambda path, options: dataclasses.replace(made, frames=lamp[:1]))
    report = sensor.measure(asked_for(tmp_path / "a.h5"))
    assert "left out: " in report.lines[0]
    assert "fewer than 2 frames" in report.lines[0]
