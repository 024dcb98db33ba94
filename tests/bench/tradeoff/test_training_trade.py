"""What presets cost a network: the measure against its definition, and one tiny run for real."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from bench.tradeoff import training_trade
from tests.clips import panned_luma, write_clip


class Sees(torch.nn.Module):
    """A network that reconstructs the grey that its voxels spell out."""

    def __init__(self, **_: Any) -> None:
        super().__init__()

    def forward_sequence(self, voxels: torch.Tensor) -> torch.Tensor:
        return voxels.float().mean(dim=2, keepdim=True) / 100


@pytest.mark.parametrize(("seen", "expected"), [(0.0, 0.0), (10.0, 0.4)])
def test_the_error_is_a_share_of_that_of_the_mean_grey(
    monkeypatch: pytest.MonkeyPatch, seen: float, expected: float
) -> None:
    """Half black, half white: the mean errs by 1/2 everywhere, a network that is off by 0.2 by 2/5 of that."""
    frames = torch.zeros(2, 3, 1, 4, 4)
    frames[:, :, :, :2] = 255
    true = frames.repeat(1, 1, 5, 1, 1) / 255 * 100
    batch: Any = SimpleNamespace(arrays={"frames": frames, "voxels": true + 2 * seen})
    monkeypatch.setattr(training_trade, "NETWORKS", {"firenet": Sees})
    monkeypatch.setattr(training_trade, "load_into", lambda network, weights, ema: None)
    judgement = training_trade.judge_weights(Path("unused"), [batch, batch])
    assert judgement == pytest.approx((expected, 1.0))


def test_a_constant_has_no_correlation_and_a_negative_has_minus_one() -> None:
    target = torch.rand(2, 4, 1, 8, 8)
    assert training_trade.judge(torch.full_like(target, 0.5), target).correlation == pytest.approx(0.0, abs=1e-3)
    assert training_trade.judge(1 - target, target).correlation == pytest.approx(-1.0)


def test_correlation_is_that_of_the_later_half_within_each_frame() -> None:
    """Numpy's, frame by frame; what the network sees before it has seen much does not count."""
    target, prediction = torch.rand(2, 2, 4, 1, 8, 8)
    expected = [np.corrcoef(prediction[b, t].flatten(), target[b, t].flatten())[0, 1] for b in (0, 1) for t in (2, 3)]
    assert training_trade.judge(prediction, target).correlation == pytest.approx(np.mean(expected), abs=1e-5)


@pytest.mark.slow
def test_a_failed_training_says_which_and_why(tmp_path: Path) -> None:
    with pytest.raises(training_trade.TrainingFailed, match=r"exact, seed 4: status 2: .*optimizer.nonsense"):
        training_trade.train("tcp://127.0.0.1:1", "tiny-cpu", "exact", 4, ["optimizer.nonsense=1"], tmp_path)


@pytest.mark.slow
def test_one_step_under_every_preset(tmp_path: Path) -> None:
    folder, file = tmp_path / "clips", tmp_path / "out.json"
    folder.mkdir()
    for number in range(2):
        write_clip(folder / f"{number}.mp4", panned_luma(211, 128, 144, step=(1, 1 + number)), gop=25)
    status = training_trade.main([
        "--videos", str(folder), "--held-out", str(folder), "--seeds", "0", "--steps", "1", "--seconds", "5",
        "--samples", "2", "--json", str(file),
    ])  # fmt: skip
    assert status == 0
    records = json.loads(file.read_text())
    assert [(record["preset"], record["limit"]) for record in records] == [
        (preset, limit) for limit in ("1 batches", "5 s") for preset in ("exact", "balanced", "fast")
    ]
    assert all(record["steps"] >= 1 and record["error_of_constant"] > 0 for record in records)
    assert [record["steps"] for record in records[:3]] == [1, 1, 1]
