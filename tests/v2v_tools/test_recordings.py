"""The tools take recordings, and do not speak of a simulation of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.digests.clips import write_recordings
from v2v_tools import preview, simulate
from v2v_tools.doctor import command as doctor

SIZE = ("--set", "voxels_per_clip=2", "--set", "crop_height_px=32", "--set", "crop_width_px=40")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recordings(tmp_path_factory.mktemp("recordings") / "prepared")


def flags(folder: Path) -> list[str]:
    return ["--videos-kind", "recordings", "--cache-dir", str(folder.parent)]


def test_a_preview_shows_what_was_recorded(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.png"
    line = [str(folder), *flags(folder), "--preset", "recordings", *SIZE, "--seeds", "1", "--out", str(out)]
    assert preview.main(line) == 0
    said = capsys.readouterr()
    assert "start of a clip" not in said.out + said.err
    assert out.stat().st_size > 1000


def test_a_sample_is_remade_and_nothing_is_simulated(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.npz"
    line = [str(folder), *flags(folder), "--preset", "recordings", *SIZE, "--out", str(out)]
    assert simulate.main(line) == 0
    assert "; recorded events, 0 bins saturated" in capsys.readouterr().out
    assert np.load(out)["voxels"].any()
    assert simulate.main([*line, "--events", str(tmp_path / "b.npz")]) != 0
    assert "has events of its own, so none are simulated" in capsys.readouterr().err
    whole = ["--whole", str(folder), *flags(folder), "--events", "h5", "--out", str(tmp_path / "c")]
    assert simulate.main(whole) == 2
    assert "--whole with recordings: they have events of their own" in capsys.readouterr().err


def test_a_check_of_the_corpus(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    doctor.main(["--videos", str(folder), *flags(folder), "--recipe", "recordings"])
    said = capsys.readouterr().out
    assert "2 videos: 2 v2v recording" in said
    assert "2 videos give no sequence of the recipe recordings" in said, "they have 12 marks, and the recipe needs 41"
