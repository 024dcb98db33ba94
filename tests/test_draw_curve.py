"""Test the drawn curve: the logged values, with consecutive steps over several runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from examples import draw_curve
from trainer.run.reporting import METRICS_FILE


def logged(folder: Path, losses: list[float]) -> Path:
    folder.mkdir()
    records = [{"step": step, "epoch": 0, "total": loss} for step, loss in enumerate(losses, start=1)]
    records.append({"step": len(losses), "epoch": 0, "held_out_total": 7.0})
    (folder / METRICS_FILE).write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def test_steps_continue_over_runs_and_the_loss_is_smoothed(tmp_path: Path) -> None:
    training, held_out = draw_curve.curves([logged(tmp_path / "a", [1.0, 2.0]), logged(tmp_path / "b", [2.0])])
    assert list(training) == [1, 2, 3]
    assert training[1] == 1.0
    assert training[2] == pytest.approx(1.05)
    assert training[1] < training[2] < training[3] < 2.0
    assert {step: loss for step, loss in held_out.items() if not math.isnan(loss)} == {2: 7.0, 3: 7.0}
    assert list(held_out) == [2, 2.5, 3, 3.5]


def test_a_picture_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = logged(tmp_path / "a", [1.0, 0.5, 0.25])
    assert draw_curve.main([str(run), str(tmp_path / "curve.png")]) == 0
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert "3 readings up to step 3" in capsys.readouterr().out


def test_a_part_of_the_loss_without_readings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no reading of 'lpips'"):
        draw_curve.main([str(logged(tmp_path / "a", [1.0])), str(tmp_path / "curve.png"), "--of", "lpips"])
