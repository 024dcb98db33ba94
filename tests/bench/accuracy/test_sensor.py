"""The judge of simulators: on a recording that a known simulator made, that simulator comes first."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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


@pytest.fixture
def toys(tmp_path: Path) -> Iterator[Path]:
    """Write a package with the interface of each peer: one event at each pixel that becomes brighter."""
    (tmp_path / "v2ecore").mkdir()
    (tmp_path / "v2ecore" / "emulator.py").write_text("""
import numpy as np
class EventEmulator:
    def __init__(self, pos_thres=0.2, neg_thres=0.2, seed=0, output_folder=None):
        self.before = None
    def generate_events(self, frame, seconds):
        before, self.before = self.before, frame
        if before is None:
            return None
        y, x = np.nonzero(frame > before)
        return np.stack([np.full(len(x), seconds - 0.001), x, y, np.ones(len(x))], axis=1)
""")
    package = tmp_path / "metavision_core_ml" / "video_to_event"
    package.mkdir(parents=True)
    (package / "simulator.py").write_text("""
import numpy as np
class EventSimulator:
    def __init__(self, height, width, Cp, Cn, refractory_period):
        self.before, self.found = None, []
    def image_callback(self, picture, us):
        before, self.before = self.before, picture
        if before is not None:
            y, x = np.nonzero(picture > before)
            self.found += [(i, j, 1, us - 1000) for i, j in zip(x, y)]
    def get_events(self):
        return np.array(self.found, [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")])
""")
    (tmp_path / "eventcv.py").write_text("""
import numpy as np
def simulate(frames, fps, seed=0, pos_thres=0.2, neg_thres=0.2):
    step, y, x = np.nonzero(np.diff(frames, axis=0) > 0)
    t = ((step + 1) * 1e6 / fps - 1000).astype(np.uint64)
    class Stream:
        numpy = staticmethod(lambda: np.stack([x, y, t, np.ones_like(x)], axis=1).astype(np.uint64))
    return Stream()
""")
    modules = set(sys.modules)
    sys.path.insert(0, str(tmp_path))
    yield tmp_path
    sys.path.remove(str(tmp_path))
    for name in set(sys.modules) - modules:
        if name.partition(".")[0] in ("v2ecore", "metavision_core_ml", "eventcv"):
            del sys.modules[name]


@pytest.mark.parametrize("name", simulators.PEERS)
@pytest.mark.parametrize("threshold", [0.0, 0.3])
def test_an_adapter_puts_events_where_the_package_saw_them(toys: Path, name: str, threshold: float) -> None:
    whole = given()
    # Every other tile, as of a sensor too large to keep: pixels are not neighbours.
    asked = part_of(whole, whole.pixels % WIDTH < 32)
    counts = simulators.counts_of(simulators.PEERS[name](asked, threshold, 0))
    np.testing.assert_array_equal(counts[1], np.diff(asked.frames.astype(int), axis=0) > 0)
    assert not counts[0].any()


def test_a_recording_is_like_itself_and_not_like_its_mirror() -> None:
    made = given()
    same = simulators.compared(made, simulators.counts_of(made), made)
    assert same["correlation"] == pytest.approx(1.0)
    assert (same["log_ratio"], same["intervals"], same["missed"], same["invented"]) == (0.0, 0.0, 0.0, 0.0)
    assert abs(same["mirrored"]) < 0.6
    none = simulators.of_events(made, [], [], [])
    empty = simulators.compared(made, simulators.counts_of(made), none)
    assert (empty["correlation"], empty["missed"], empty["invented"]) == (0.0, 1.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["linear", "2.2", "srgb"])
def test_the_equations_agree_with_the_kernel(light: str) -> None:
    made = given(light)
    exact = simulators.compared(made, simulators.counts_of(made), simulators.equations(made, 0.2, 1))
    assert exact["correlation"] > 0.8


@pytest.mark.slow
def test_the_threshold_of_the_camera_is_found_and_bars_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = given()
    monkeypatch.setattr(sensor, "seen", lambda path: (made, "toy: 5 steps"))
    asked = argparse.Namespace(recordings=tmp_path / "toy.h5", recipe=[], peer=[], light=[], draws=5)
    report = sensor.measure(asked)
    rows = {(row["light"], row["simulator"], row["at"]): row for row in report.records}
    assert {light for light, _, _ in rows} == {"linear", "2.2"}
    assert rows["linear", sensor.NEW, "number"]["threshold"] == pytest.approx(0.2, rel=0.35)
    assert rows["linear", sensor.NEW, "best"]["correlation"] <= 1.0
    assert not any(row["stated"] for key, row in rows.items() if key[0] == "2.2")
    worse = [dict(row, correlation=0.0) if row["simulator"] == sensor.NEW else row for row in report.records]
    assert f"correlation: {sensor.NEW} 0.000" in "; ".join(sensor.missed(worse))
    assert sensor.missed([]) == []


def test_an_unknown_peer_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    asked = argparse.Namespace(recordings=tmp_path, recipe=[], peer=["esim=x"], light=[], draws=1)
    with pytest.raises(UsageError, match="--peer esim=x: give one of v2e, openeb, eventcv"):
        sensor.measure(asked)


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
    report = sensor.measure(argparse.Namespace(recordings=tmp_path / "a.h5", recipe=[], peer=[], light=[], draws=1))
    assert "left out: " in report.lines[0]
    assert "fewer than 2 frames" in report.lines[0]
