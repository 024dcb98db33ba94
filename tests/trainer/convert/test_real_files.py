"""Test real recordings of four raw forms, if they are available."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.trainer.conftest import WEIGHTS
from trainer.convert import Converted, convert
from trainer.evaluation.readers import Recording
from trainer.evaluation.voxelise import VoxelSettings, voxel_grid
from trainer.evaluation.windows import picture_windows
from v2v_protocol.errors import UsageError
from v2v_recordings.items import ConvertOptions, SensorSize

EVENTS = WEIGHTS.parent / "events"


def converted(name: str, folder: Path, options: ConvertOptions | None = None) -> Converted:
    if not (EVENTS / name).is_file():
        pytest.skip(f"no file {EVENTS / name}: set V2V_TEST_WEIGHTS to the folder beside `events`")
    return convert(EVENTS / name, folder / "recording.h5", options=options)


def test_aedat4_of_a_davis(tmp_path: Path) -> None:
    done = converted("davis346_aestream.aedat4", tmp_path)
    assert (done.form, done.written.events, done.written.images) == ("aedat4", 117_667, 3)
    assert done.written.size == SensorSize(346, 260)
    with Recording(done.destination) as recording:
        windows = picture_windows(recording)
        assert [round(window.end - window.begin, 6) for window in windows] == [0.04, 0.04]
        times = recording.events(windows[0]).t
        assert windows[0].begin <= times[0] <= times[-1] < windows[0].end
        last = windows[-1].target
        assert last is not None
        pixels = recording.image(last)
        # Two lamps, in a dark room; both flicker, so that is where the events are.
        lamps = pixels > 240
        assert 20 < np.count_nonzero(lamps) < 400
        grid = voxel_grid(recording.events(windows[1]), recording.size, VoxelSettings(), (0, 1))
        busy = np.abs(grid).sum(axis=0)
        assert busy[lamps].mean() > 10 * busy.mean()


def test_evt2(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="give --size"):
        converted("faery_evt2.raw", tmp_path)
    done = converted("faery_evt2.raw", tmp_path, ConvertOptions(size=SensorSize(640, 480)))
    assert (done.form, done.written.events, done.written.reordered_events) == ("prophesee", 521_252, 0)


def test_bag_of_evt3_packets(tmp_path: Path) -> None:
    done = converted("ros_test_events_1.bag", tmp_path)
    assert (done.form, done.written.size, done.written.images) == ("bag", SensorSize(640, 480), 0)
    assert done.written.events > 300_000
    # 517 packets of about 4 ms.
    assert done.written.seconds == pytest.approx(2.07, abs=0.02)
