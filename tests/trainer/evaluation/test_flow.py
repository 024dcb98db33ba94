"""Test scores of flow on recordings with known flow: the analytic errors, in both conventions."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.trainer.evaluation.h5_file import write_h5
from trainer.evaluation import paper
from trainer.evaluation.cli import main
from trainer.evaluation.flow import HOOD_ROW, FlowRun, FlowScore, evaluate_flow, flow_table
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models import EVFlowNet
from v2v_protocol.errors import UsageError

HEIGHT, WIDTH = 200, 24
LENGTHS = (1.0, 4.0, 2.0, 8.0)
"""Of the flow of each field, px: one more than there are windows."""


def recording(path: Path, *, empty: int | None = None) -> Path:
    """Flow (0.6, 0.8) LENGTHS[i] in field i, unknown in its left half; below row 190 ten times as large. Events in the
    column WIDTH - 1 only. ``empty``: a field that is nowhere known.
    """
    times = 5.0 + 0.05 * np.arange(len(LENGTHS))
    rows = np.tile(np.arange(HEIGHT), 3)
    t = np.repeat(times[:-1] + 0.01, HEIGHT)
    write_h5(path, t, np.full(len(t), WIDTH - 1), rows, np.ones(len(t)), [], sensor_resolution=(HEIGHT, WIDTH))
    with h5py.File(path, "a") as file:
        for index, (time, length) in enumerate(zip(times, LENGTHS, strict=True)):
            field = np.empty((2, HEIGHT, WIDTH), np.float32)
            field[:] = np.array([0.6, 0.8])[:, None, None] * length
            field[:, HOOD_ROW:] *= 10
            field[:, :, : WIDTH // 4], field[:, :, WIDTH // 4 : WIDTH // 2] = np.nan, 0
            if index == empty:
                field[:] = np.nan
            file[f"flow/flow{index:09d}"] = field
            file[f"flow/flow{index:09d}"].attrs.update(timestamp=time, event_idx=0, image_idx=0)
    return path


def constant(x: float, y: float) -> EVFlowNet:
    network = EVFlowNet(base_channels=2)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.unet.pred.conv2d.bias.copy_(torch.tensor([x, y]))  # type: ignore[union-attr]
    return network


def run(network: EVFlowNet, *, as_published: bool) -> FlowRun:
    return FlowRun(network, VoxelSettings(bins=network.bins), as_published=as_published)


def test_a_window_without_counted_pixels_is_left_out_or_scores_0(tmp_path: Path) -> None:
    path = recording(tmp_path / "outdoor_day2.h5", empty=1)
    right = evaluate_flow(run(constant(0, 0), as_published=False), path, None)["zeros"]
    assert (right.windows, right.means["aee_sparse"]) == (3, pytest.approx((1 + 2) / 2, rel=1e-5))
    published = evaluate_flow(run(constant(0, 0), as_published=True), path, None)["zeros"]
    assert published.means["aee_dense"] == pytest.approx((0 + 2 + 8) / 3 * (1 + 9 * 0.05), rel=1e-5)


def test_without_pictures_a_time_range_counts_from_the_first_field(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.h5")
    assert evaluate_flow(run(constant(0, 0), as_published=False), path, (0.04, 0.11))["zeros"].windows == 1
    with pytest.raises(UsageError, match=r"1 flow fields in the time range .*v2v-convert reads MVSEC's"):
        evaluate_flow(run(constant(0, 0), as_published=False), path, (0.04, 0.06))


def test_the_command_shows_the_papers_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "data" / "mvsec").mkdir(parents=True)
    recording(tmp_path / "data" / "mvsec" / "indoor_flying1.h5")
    torch.save(constant(0, 0).state_dict(), tmp_path / "a.pth")
    arguments = ["--weights", str(tmp_path / "a.pth"), "--data", str(tmp_path / "data"), "--cuts", "none"]
    main(["mvsec-flow", *arguments, "--out", str(tmp_path / "out"), "--json", str(tmp_path / "a.json")])
    shown = capsys.readouterr().out
    stated = paper.FLOW["Zeros"]["indoor_flying1"]
    assert f"{stated['aee_dense']:.3f}" in shown
    (tmp_path / "data" / "mvsec" / "indoor_flying2.h5").write_bytes(b"no recording")
    assert main(["mvsec-flow", *arguments]) == 1
    assert "not scored: " in (named := capsys.readouterr().err)
    assert "indoor_flying2.h5" in named
    records = json.loads((tmp_path / "a.json").read_text())
    assert [record["predictor"] for record in records] == ["network", "zeros"]
    assert records[0]["aee_dense"] == records[1]["aee_dense"]
    assert (tmp_path / "out" / "indoor_flying1.png").is_file()
    assert main([*arguments[:3], str(tmp_path / "data" / "mvsec"), "--window-events", "9", "--stretch", "robust"]) == 2
    assert "--stretch, --window-events: for networks that reconstruct pictures" in capsys.readouterr().err


def test_a_recording_that_states_no_size_takes_a_given_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with h5py.File(recording(tmp_path / "a.h5"), "a") as file:
        del file.attrs["sensor_resolution"]
    torch.save(constant(0, 0).state_dict(), tmp_path / "a.pth")
    arguments = ["--weights", str(tmp_path / "a.pth"), "--data", str(tmp_path / "a.h5")]
    assert main(arguments) == 2
    assert "--size WxH" in capsys.readouterr().err
    assert main([*arguments, "--size", f"{WIDTH}x{HEIGHT}"]) == 0


def test_rows_of_the_paper_that_have_no_flow_are_left_out() -> None:
    score = FlowScore(as_published=False)
    score.add(np.zeros((2, 1, 1), np.float32), np.ones((2, 1, 1), np.float32), np.ones((1, 1), bool), 1)
    table = flow_table("a", {"indoor_flying1": {"network": score}}, ["Zeros", next(iter(paper.RESULTS))])
    assert table.row_count == 2
