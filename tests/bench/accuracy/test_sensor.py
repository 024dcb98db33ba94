"""Simulated beside recorded events: a recording that the simulation itself made is followed to the event."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.accuracy import sensor
from bench.accuracy.sensor import Recording, read_recording
from tests.server.simulation.test_pixel import moving_frames
from v2v_protocol.errors import UsageError
from v2v_server.simulation import simulate

SHARED = Path(__file__).parents[4] / "shared" / "data"


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Three frames and their events at log_eps 0.1, gamma 1, residual 0."""
    frames = (moving_frames(3, 24, 40) // 2).astype(np.uint8)
    threshold = float(sensor._THRESHOLDS[20])
    voxels = simulate(
        frames, threshold_pos=threshold, gamma=1.0, log_eps=0.1, start_residual=0.0, bins=2, dtype="int16"
    ).voxels[0]
    bins, rows, columns = np.nonzero(voxels)
    counts = voxels[bins, rows, columns]
    repeats = np.abs(counts)
    events = np.empty(repeats.sum(), [("t", "f8"), ("x", "i8"), ("y", "i8"), ("on", "?")])
    for name, values in (("t", 0.04 * bins + 0.02), ("x", columns), ("y", rows), ("on", counts > 0)):
        events[name] = np.repeat(values, repeats)
    return Recording(frames, np.array([0.0, 0.04, 0.08]), events)


def test_the_setting_that_made_the_events_is_found(recording: Recording) -> None:
    made = sensor.Sensor(recording)
    right = made.record(1.0, 0.1, 0.0)
    assert right["correlation_pixels"] == pytest.approx(1.0)
    assert right["threshold"] == pytest.approx(sensor._THRESHOLDS[20])
    for wrong in ((1.0, 0.001, 0.0), (2.2, 0.1, 0.0), (1.0, 0.1, None)):
        assert made.record(*wrong)["correlation_pixels"] < 0.99
    assert made.record(1.0, 0.1, 0.0, noise_sigma=0.3)["correlation_pixels"] < 0.9
    assert right["ceiling_pixels"] < 1.0
    assert abs(right["correlation_pixels_mirrored"]) < 0.5


def test_there_is_a_record_for_each_setting(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor, "LOG_OFFSETS", (0.1,))
    monkeypatch.setattr(sensor, "EFFECTS", {"none": {}})
    records = sensor.records_of(recording)
    assert [record["measure"] for record in records] == ["log offset"] * 4 + ["effect"]


def test_recordings_that_cannot_be_read_are_refused(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "faery", None)
    with pytest.raises(UsageError, match="needs faery"):
        read_recording(tmp_path / "a.aedat4")
    fake = types.ModuleType("faery")
    fake.aedat = types.SimpleNamespace(Decoder=lambda path: [])  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "faery", fake)
    with pytest.raises(UsageError, match="no such file"):
        read_recording(tmp_path / "a.aedat4")
    (tmp_path / "a.aedat4").touch()
    with pytest.raises(UsageError, match="0 frames and 0 packets"):
        read_recording(tmp_path / "a.aedat4")


@pytest.mark.skipif(not SHARED.exists(), reason=f"no recording in {SHARED}")
def test_a_real_recording_is_read() -> None:
    pytest.importorskip("faery")
    recording = read_recording(SHARED / "events" / "davis346_aestream.aedat4")
    assert recording.frames.shape == (3, 260, 346)
    assert len(recording.events) == 117_667
    np.testing.assert_allclose(recording.seconds, [0.0, 0.04, 0.08], atol=1e-4)
    assert recording.events["t"].max() < 0.2
