"""The soak: when it says that a process grows, and one short run for real."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.chaos import soak
from bench.speed.memory import fit
from tests.clips import panned_luma, write_clip


@pytest.mark.parametrize(("slope", "verdict"), [(0.0, False), (0.2, False), (0.3, True), (-1.0, False)])
def test_growth_is_a_slope_above_the_limit(slope: float, verdict: bool) -> None:
    line = fit([[(at, 100.0 + slope * at / 60.0 + 0.01 * (at % 2)) for at in range(600)]])
    assert soak.grows(line, most_mib_per_hour=16.0) is verdict


def test_a_slope_that_may_be_noise_is_none() -> None:
    line = fit([[(at, 100.0 + (50.0 if at > 450 else 0.0)) for at in range(600)]])
    assert line.slope > 1.0
    assert not soak.grows(line, most_mib_per_hour=16.0)


@pytest.mark.slow
def test_a_short_soak(tmp_path: Path) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    for number in range(3):
        write_clip(clips / f"{number}.mp4", panned_luma(90, step=(1, 1 + number)), gop=15)
    out, picture = tmp_path / "soak.json", tmp_path / "soak.png"
    flags = ["--samples", "1500", "--batch-size", "3", "--workers", "1", "--warmup-seconds", "1"]
    for change in ("voxels_per_clip=4", "crop_height_px=32", "crop_width_px=40"):
        flags += ["--set", change]
    # So short a run is all warm-up: what is tested is that it runs, counts and draws.
    flags += ["--most-mib-per-hour", "100000"]
    assert soak.main(["--videos", str(clips), *flags, "--json", str(out), "--plot", str(picture)]) == 0
    records = json.loads(out.read_text(encoding="utf-8"))
    assert {record["process"] for record in records} == {"broker", "worker 0", "client"}
    assert all(record["samples"] == 1500 and not record["lost"] and not record["duplicated"] for record in records)
    assert picture.stat().st_size > 5000


@pytest.mark.parametrize("arguments", [["--minutes", "0"], ["--samples", "0"], ["--workers", "0"]])
def test_wrong_usage_is_status_2(tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert soak.main(["--videos", str(tmp_path), *arguments]) == 2
    assert capsys.readouterr().err.startswith("soak: ")
