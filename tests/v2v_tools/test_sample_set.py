"""Test `v2v-simulate --count`: the recordings are the samples of the stream that the flags name."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.events import EventList
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_tools import simulate as command
from v2v_tools.remake import Remaker

RECIPE = {"voxels_per_clip": 3, "crop_height_px": 32, "crop_width_px": 40, "lead_frames": 1}
SETTINGS = [word for name, value in RECIPE.items() for word in ("--set", f"{name}={value}")]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    for name in ("one", "two"):
        (tmp_path / "videos").mkdir(exist_ok=True)
        write_clip(tmp_path / "videos" / f"{name}.mp4", panned_luma(60, 48, 64))
    return tmp_path / "videos"


@pytest.mark.parametrize(("seed", "epoch", "first"), [(0, 0, 0), (7, 3, 1)])
def test_the_events_of_a_set_counted_in_bins_are_the_samples_of_the_stream(
    seed: int, epoch: int, first: int, videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bins lie between the pictures of the recording, and so test the times of both."""
    out, names = tmp_path / "set", ["--seed", str(seed), "--epoch", str(epoch), "--index", str(first)]
    line = [str(videos), "--count", "2", "--out", str(out), "--arrays", "frames,flow", "--cache-dir", str(tmp_path)]
    assert command.main([*line, *names, *SETTINGS]) == 0
    assert "2 recordings with " in capsys.readouterr().out
    arrays = ("voxels", "frames", "flow")
    remaker = Remaker(open_catalogue(str(videos)), StreamSpec.from_dict({"recipe": RECIPE}), arrays)
    assert {path.name for path in out.glob("*.h5")} == {f"{seed}-{epoch}-{first + each}.h5" for each in (0, 1)}
    for index in (first, first + 1):
        sample = remaker.sample(seed, epoch, index)
        path = out / f"{seed}-{epoch}-{index}.h5"
        assert json.loads(path.with_suffix(".json").read_text()) == json.loads(json.dumps(sample.provenance.to_dict()))
        with h5py.File(path) as file:
            images = [file["images"][key] for key in sorted(file["images"])]
            t_us = np.round(file["events/ts"][:] * 1e6).astype(np.int64)
            x, y, p = (file[f"events/{name}"][:] for name in ("xs", "ys", "ps"))
            stamps = [each.attrs["timestamp"] for each in images]
            np.testing.assert_array_equal([each[:] for each in images], sample.arrays["frames"][:, 0])
            flow = [file["flow_dt1"][key] for key in sorted(file["flow_dt1"])]
            assert [each.attrs["timestamp"] for each in flow] == stamps
            np.testing.assert_array_equal([each[:] for each in flow[1:]], sample.arrays["flow"].astype(np.float32))
            assert file.attrs["t0"] == file["events/ts"][0]
            assert file.attrs["duration"] == file["events/ts"][-1] - file["events/ts"][0]
            ends = [each.attrs["event_idx"] for each in images]
        voxels = sample.arrays["voxels"]
        bin_us = 1e6 * (stamps[-1] - stamps[0]) / (voxels.shape[0] * voxels.shape[1])
        events = EventList(x, y, t_us, p, 40, 32)
        np.testing.assert_array_equal(events.voxels(*voxels.shape[:2], bin_us, "int8"), voxels)
        for grid in range(3):
            part = slice(ends[grid], ends[grid + 1])
            counts = np.zeros((32, 40), int)
            np.add.at(counts, (y[part], x[part]), np.where(p[part], 1, -1))
            np.testing.assert_array_equal(counts, voxels[grid].sum(0, dtype=int))
        assert voxels.any()


def test_after_the_last_sample_of_an_epoch_comes_the_next_epoch(videos: Path, tmp_path: Path) -> None:
    out, spec = tmp_path / "set", StreamSpec.from_dict({"recipe": RECIPE})
    last = Remaker(open_catalogue(str(videos)), spec).count - 1
    line = [str(videos), "--count", "2", "--out", str(out), "--cache-dir", str(tmp_path), "--epoch", "4", *SETTINGS]
    assert command.main([*line, "--index", str(last), "--events", "raw"]) == 0
    assert {path.name for path in out.glob("*.raw")} == {f"0-4-{last}.raw", "0-5-0.raw"}


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--count", "0"], "--count 0: give a whole number from 1"),
        (["--count", "1", "--index", "9999"], "--index 9999: the epoch has "),
        (["--count", "1", "--arrays", "voxels"], "--arrays voxels: a recording holds frames, flow, masks; give some"),
        (["--count", "1", "--events", "raw", "--arrays", "frames"], "raw holds no images; give another form: h5, npz"),
        (["--count=1", "--events", "raw", "--set", "crop_width_px=2049"], "EVT 3 holds at most 2048 px a side"),
    ],
)
def test_what_cannot_be_written_is_refused_before_any_work(
    flags: list[str], said: str, videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = [str(videos), "--out", str(tmp_path / "set"), "--cache-dir", str(tmp_path), *SETTINGS, *flags]
    assert command.main(line) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "set").exists()
