"""Judging networks on held-out clips: scores that follow from their definition."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch

from bench.accuracy import learn
from trainer.evaluation.metrics import make_metrics
from trainer.models import NETWORKS
from v2v_protocol.errors import UsageError

METRICS = make_metrics(["mse", "correlation"], {})


def clip() -> tuple[torch.Tensor, torch.Tensor]:
    """Voxels that spell out the frames, 5 samples of 4 steps."""
    frames = torch.rand(5, 4, 1, 8, 8)
    return frames.repeat(1, 1, 5, 1, 1), frames


def test_only_the_later_half_counts() -> None:
    voxels, frames = clip()
    voxels[:, :2] = 1 - voxels[:, :2]
    found = learn.score(lambda voxels: voxels[:, :, :1], voxels, frames, METRICS)
    assert found == pytest.approx({"correlation": 1.0, "mse": 0.0}, abs=1e-5)


def test_pictures_are_clamped_first() -> None:
    voxels, _ = clip()
    found = learn.score(lambda voxels: voxels[:, :, :1] + 7, voxels, torch.ones(5, 4, 1, 8, 8), METRICS)
    assert found["mse"] == 0.0


def test_constant_grey_is_the_mean_of_what_is_judged() -> None:
    voxels, frames = clip()
    frames[:, 2:, :, :4], frames[:, 2:, :, 4:] = 0.25, 0.75
    found = learn.score(learn._grey(frames), voxels, frames, METRICS)
    assert found == pytest.approx({"correlation": 0.0, "mse": 0.0625}, abs=1e-3)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    torch.save(NETWORKS["firenet"](base_channels=2).state_dict(), tmp_path / "weights.pth")
    return tmp_path / "weights.pth"


def asked(weights: tuple[str, ...] = (), normalized: tuple[str, ...] = ()) -> argparse.Namespace:
    return argparse.Namespace(weights=weights, ema_weights=(), normalized_weights=normalized)


def test_the_same_file_can_be_judged_with_and_without_normalisation(weights: Path) -> None:
    found = learn.networks(asked((f"plain={weights}",), (f"normal={weights}",)))
    assert {name: network.normalizes for name, network in found.items()} == {"plain": False, "normal": True}


@pytest.mark.parametrize(
    ("entries", "said"),
    [((), "no network to judge"), (("x",), "'x': write NAME=FILE"), (("x={}", "x={}"), "two networks are called 'x'")],
)
def test_what_cannot_be_judged_is_said(weights: Path, entries: tuple[str, ...], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        learn.networks(asked(tuple(entry.format(weights) for entry in entries)))
