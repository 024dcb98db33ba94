"""`v2v-simulate --whole`: recordings of whole videos."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip, write_panned
from v2v_recordings.writers import EventWriter
from v2v_server.simulation import continued
from v2v_tools import whole_clip
from v2v_tools.simulate import main

SLOW = pytest.mark.slow  # the general kernel in float64
CAMERA = [
    "--set", "threshold=[0.2,0.2]", "--set", "shot_noise_hz=[5,5]", "--set", "refractory_seconds=[0.001,0.001]",
    "--set", "photoreceptor_hz=[50,50]", "--substep-px", "1",
]  # fmt: skip


def simulate(videos: Path, out: Path, *flags: str, form: str = "h5") -> int:
    return main([
        "--whole", str(videos), "--out", str(out), "--events", form, "--cache-dir", f"{out}-index", *CAMERA, *flags,
    ])  # fmt: skip


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.name.startswith(".")}


def without_files(folder: Path) -> bool:
    return not folder.exists() or not files(folder)


@SLOW
def test_what_is_read_and_simulated_at_a_time_changes_no_event(tmp_path: Path, monkeypatch: Any) -> None:
    write_clip(tmp_path / "videos/a.mp4", panned_luma(40, step=(0, 3)), gop=7)
    assert simulate(tmp_path / "videos", tmp_path / "whole", "--frames") == 0
    whole = read(tmp_path / "whole/a.mp4.h5")
    assert simulate(tmp_path / "videos", tmp_path / "processes", "--frames", "--jobs", "2") == 0
    monkeypatch.setattr(whole_clip, "_READ_BYTES", 5 * 48 * 64)
    monkeypatch.setattr(continued.ContinuedClip.__init__, "__defaults__", (np.float64, 300))
    assert simulate(tmp_path / "videos", tmp_path / "small", "--frames") == 0
    for folder in ("processes", "small"):
        found = read(tmp_path / folder / "a.mp4.h5")
        assert found.keys() == whole.keys()
        for name, values in whole.items():
            np.testing.assert_array_equal(found[name], values)
    assert len(whole["events/ts"]) > 3000
    assert (np.diff(whole["events/ts"]) >= 0).all()
    assert sum(name.startswith("images/") for name in whole) == 40
    with h5py.File(tmp_path / "whole/a.mp4.h5") as file:
        stamps = [image.attrs["timestamp"] for image in file["images"].values()]
    np.testing.assert_allclose(stamps, 0.04 * np.arange(40), atol=1e-9)


def content(recording: Path) -> dict[str, tuple[int, bytes]]:
    """Return time of change and bytes of each file of a recording."""
    paths = recording.iterdir() if recording.is_dir() else [recording]
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in paths}


@SLOW
@pytest.mark.parametrize(("form", "ending"), [("raw", ".raw"), ("evreal", "")])
def test_a_second_start_makes_what_is_missing_and_refuses_other_settings(
    form: str, ending: str, tmp_path: Path, capfd: Any
) -> None:
    videos, out = write_panned(tmp_path / "videos", 2, 12), tmp_path / "out"
    assert simulate(videos, out, form=form) == 0
    made = files(out)
    first, second = (out / f"{path.name}{ending}" for path in sorted(videos.iterdir()))
    before, again = content(first), content(second)
    shutil.rmtree(second) if second.is_dir() else second.unlink()
    capfd.readouterr()
    assert simulate(videos, out, form=form) == 0
    assert "1 video of 2 complete already" in capfd.readouterr().out
    assert content(first) == before
    assert {name: data for name, (_, data) in content(second).items()} == {
        name: data for name, (_, data) in again.items()
    }
    assert simulate(videos, out, "--seed", "1", form=form) == 2
    assert "made with other settings" in capfd.readouterr().err
    assert files(out) == made


@SLOW
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_recording_that_cannot_be_ended_leaves_nothing(tmp_path: Path, monkeypatch: Any, error: Any) -> None:
    videos, out, calls = write_panned(tmp_path / "videos", 2, 12), tmp_path / "out", list[int]()
    add = EventWriter.add

    def failing(self: Any, events: Any) -> None:
        calls.append(1)
        if len(calls) == 2:
            raise error
        add(self, events)

    monkeypatch.setattr(EventWriter, "add", failing)
    is_disk = isinstance(error, OSError)
    assert simulate(videos, out) == (1 if is_disk else 130)
    assert len(files(out)) == (2 if is_disk else 0)
    monkeypatch.undo()
    assert simulate(videos, out) == 0
    assert len(files(out)) == 4


@SLOW
def test_a_cut_begins_a_new_state_without_events_of_its_own(tmp_path: Path) -> None:
    dark, bright = panned_luma(30) // 4, 255 - panned_luma(30, step=(0, 1)) // 4
    write_clip(tmp_path / "videos/cut.mkv", np.concatenate([dark, bright]), codec="ffv1", pixel_format="gray")
    quiet = ["--recipe", "noise-free"]
    cut, kept = tmp_path / "cut", tmp_path / "kept"
    for out, flags in ((cut, ["--scene", "auto"]), (kept, [])):
        assert main([
            "--whole", str(tmp_path / "videos"), "--out", str(out), "--events", "dsec", "--cache-dir", f"{out}-index",
            *quiet, *flags,
        ]) == 0  # fmt: skip
    note = json.loads((cut / "cut.mkv.h5.provenance.json").read_text())
    assert note["shots"] == [0, 30]

    def between(folder: Path) -> int:
        t = read(folder / "cut.mkv.h5")["events/t"]
        return int(np.count_nonzero((t >= 29 * 40_000) & (t < 30 * 40_000)))

    assert between(kept) > 3000
    assert between(cut) == 0


def test_a_form_that_cannot_hold_the_picture_is_refused_before_work(tmp_path: Path, capfd: Any) -> None:
    write_clip(tmp_path / "videos/wide.mkv", np.zeros((2, 2, 2050), np.uint8), codec="ffv1", pixel_format="gray")
    assert simulate(tmp_path / "videos", tmp_path / "out", form="raw") == 2
    assert (
        "2050 x 2 px; EVT 3 holds at most 2048 px a side: give a smaller crop, or another form: h5, dsec"
        in capfd.readouterr().err
    )
    assert without_files(tmp_path / "out")


def test_what_gives_no_events_is_named(tmp_path: Path, capfd: Any) -> None:
    write_clip(tmp_path / "videos/single.mp4", panned_luma(1))
    assert simulate(tmp_path / "videos", tmp_path / "out") == 1
    assert "single.mp4: it has a single frame, and events need two" in capfd.readouterr().out
    shutil.rmtree(tmp_path / "videos")
    write_clip(tmp_path / "videos/a.mp4", panned_luma(3))
    assert simulate(tmp_path / "videos", tmp_path / "videos/out") == 2
    assert "it lies in" in capfd.readouterr().err
    assert simulate(tmp_path / "videos", tmp_path / "out", "--jobs", "0") == 2
    assert "--jobs 0: give a whole number from 1" in capfd.readouterr().err
    assert simulate(tmp_path / "videos", tmp_path / "out", "--videos-kind", "photographs") == 2
    assert "a photograph has no length" in capfd.readouterr().err
