"""The benchmark of a step: its figures belong to the network it names."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench import step


@pytest.mark.slow
def test_a_step_is_measured_apart(tmp_path: Path) -> None:
    out = tmp_path / "step.json"
    flags = ["--networks", "firenet", "--side", "16", "--voxels", "2", "--steps", "1", "--json", str(out)]
    assert step.main(flags) == 0
    (record,) = json.loads(out.read_text(encoding="utf-8"))
    assert (record["network"], record["parameters"], record["device"]) == ("firenet", 37_777, "cpu")
    assert record["voxel_grids_per_second"] == pytest.approx(4 / record["seconds"])
    assert 0 < record["fastest_seconds"] <= record["seconds"]
    assert record["memory_mib"] > 0


@pytest.mark.parametrize("flags", [["--networks", "firenet,nobody"], ["--side", "15"], ["--steps", "0"]])
def test_wrong_usage_is_status_2(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert step.main(flags) == 2
    assert capsys.readouterr().err.startswith("step: ")
