"""Compare metrics with float64 NumPy that follows the formulas, window by window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.trainer.losses.test_lpips import heads_file, random_metric, torchvision_like
from tests.trainer.models import numpy_networks
from trainer.evaluation.config import parse_config
from trainer.evaluation.flow import FLOW_METRICS, FlowScore, flow_table
from trainer.evaluation.metrics import METRICS, MetricEntry, make_metrics, mse, ssim
from trainer.evaluation.readers import EventWindow, RecordedImage
from trainer.evaluation.reconstruct import Step
from trainer.evaluation.score import SequenceScore, SequenceScorer, mean_over_sequences
from trainer.evaluation.tables import table
from v2v_protocol.errors import UsageError


def pair(height: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.random((height, width))
    return np.clip(0.7 * target + 0.3 * rng.random((height, width)), 0, 1), target


def slow_ssim(a: np.ndarray, b: np.ndarray, data_range: float) -> float:
    """Compute SSIM for each 7 x 7 window separately, with variances divided by 48."""
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    values = []
    for top in range(a.shape[0] - 6):
        for left in range(a.shape[1] - 6):
            one, other = (picture[top : top + 7, left : left + 7].ravel() for picture in (a, b))
            covariance = np.cov(one, other, ddof=1)
            luminance = (2 * one.mean() * other.mean() + c1) / (one.mean() ** 2 + other.mean() ** 2 + c1)
            structure = (2 * covariance[0, 1] + c2) / (covariance[0, 0] + covariance[1, 1] + c2)
            values.append(luminance * structure)
    return float(np.mean(values))


@settings(max_examples=30)
@given(st.integers(7, 14), st.integers(7, 14), st.integers(0, 100), st.sampled_from((1.0, 2.0)))
def test_ssim(height: int, width: int, seed: int, data_range: float) -> None:
    prediction, target = pair(height, width, seed)
    assert ssim(prediction, target, data_range=data_range) == pytest.approx(
        slow_ssim(prediction, target, data_range), abs=1e-10
    )


def test_mse() -> None:
    prediction, target = pair(9, 11, 1)
    assert mse(prediction, target) == pytest.approx(sum((prediction - target).ravel() ** 2) / 99, rel=1e-12)
    assert mse(np.zeros((2, 2)), np.full((2, 2), 0.5)) == 0.25


@pytest.mark.parametrize("net", ["alex", "squeeze"])
def test_lpips_from_files(tmp_path: Path, net: str) -> None:
    network, backbone, heads = random_metric(net)
    torch.save(torchvision_like(network.float()), tmp_path / "backbone.pth")
    torch.save(heads_file(network), tmp_path / "heads.pth")
    files = {net: (tmp_path / "backbone.pth", tmp_path / "heads.pth")}
    prediction, target = pair(33, 36, 3)
    expected = numpy_networks.lpips(net, prediction[None], target[None], backbone, heads)
    assert make_metrics([f"lpips_{net}"], files)[f"lpips_{net}"](prediction, target) == pytest.approx(
        expected, rel=1e-3
    )


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lpips_alex", r"--lpips alex BACKBONE HEADS .*alexnet.*--metrics"),
        ("psnr", f"give some of {', '.join(METRICS)}"),
    ],
)
def test_metrics_that_cannot_be_computed_are_refused(name: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_metrics([name], {"squeeze": ("a", "b")})


def test_ssim_needs_a_window() -> None:
    with pytest.raises(UsageError, match="at least 7 x 7"):
        ssim(np.zeros((6, 9)), np.zeros((6, 9)), data_range=1)


def test_a_toy_metric_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    """A configuration may ask for it, and its title is in the table."""
    entry = MetricEntry("MAE", lambda *_: lambda prediction, target: float(abs(prediction - target).mean()))
    monkeypatch.setitem(METRICS, "mae", entry)
    config = parse_config({"metrics": ["mse", "mae"], "data": ["HQF"]}, "own.yaml")
    prediction, target = pair(9, 11, 1)
    means = {name: metric(prediction, target) for name, metric in make_metrics(config.metrics, {}).items()}
    assert means["mae"] == pytest.approx(np.abs(prediction - target).mean())
    shown = table(config.data_sets[0], [SequenceScore("HQF", "still_life", 1, 0, 0, 0, means, means)], ())
    assert "MAE" in [str(column.header) for column in shown.columns]


def test_a_toy_metric_of_flow_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FLOW_METRICS, "worst", ("worst", lambda error: float(error.max())))
    score, truth = FlowScore(as_published=False), np.ones((2, 2, 3), np.float32)
    events = np.zeros((2, 3), bool)
    events[0, 0] = True
    prediction = truth.copy()
    prediction[:, 0, 0], prediction[0, 1, 2] = (1.0, 3.0), 6.0
    score.add(prediction, truth, events, 2)
    assert (score.means["worst_dense"], score.means["worst_sparse"]) == (5.0, 2.0)
    titles = [str(column.header) for column in flow_table("a", {"b": {"network": score}}, []).columns]
    assert titles[2:] == ["AEE", "AEE sparse", "3PE %", "3PE % sparse", "worst", "worst sparse"]


def test_means_over_sequences_are_unweighted() -> None:
    def score(frames: int, **means: float) -> SequenceScore:
        return SequenceScore("a", "b", frames, 0, 0, 0, means)

    assert mean_over_sequences([score(1, mse=0.2, ssim=0.1), score(1000, mse=0.4)]) == {"mse": pytest.approx(0.3)}
    assert mean_over_sequences([]) == {}


def test_correlation_ignores_brightness_and_contrast_and_is_0_for_a_blank() -> None:
    rng = np.random.default_rng(0)
    picture, other = rng.random((2, 9, 11))
    (metric,) = make_metrics(["correlation"], {}).values()
    assert metric(0.2 * picture + 0.4, picture) == pytest.approx(1)
    assert metric(1 - picture, picture) == pytest.approx(-1)
    assert metric(other, picture) == pytest.approx(np.corrcoef(other.ravel(), picture.ravel())[0, 1])
    assert metric(np.full_like(picture, 0.5), picture) == 0


def test_a_blank_is_scored_as_a_baseline() -> None:
    target = np.random.default_rng(1).integers(0, 256, (9, 11), dtype=np.uint8)
    scorer = SequenceScorer(make_metrics(["mse", "correlation"], {}))
    window = EventWindow(0, 0, 0.0, 1.0, RecordedImage("a", 1.0, 0))
    scorer.add(Step(window, 0, np.zeros((5, 9, 11), np.float32), (target / 255).astype(np.float32), target, 1.0))
    score = scorer.score("set", "one", 0)
    assert score.means == pytest.approx({"mse": 0, "correlation": 1}, abs=1e-6)
    assert score.blank == pytest.approx({"mse": np.var(target / 255), "correlation": 0})
