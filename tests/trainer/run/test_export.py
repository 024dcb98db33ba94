"""Weights that are given to others, from a checkpoint."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from trainer.models import FireNet
from trainer.run.checkpoint import Checkpoint, save_checkpoint
from trainer.run.export import main
from trainer.weights import SHIPPED, load_network


def network(seed: int) -> FireNet:
    torch.manual_seed(seed)
    return FireNet(base_channels=4)


def saved(path: Path, steps: int, model: Any, average: Any = None, **options: object) -> str:
    config = {"network": {"name": "firenet", "options": {"base_channels": 4, **options}, "weights": ""}}
    save_checkpoint(path, Checkpoint(steps, 0, model, {}, average, None, config))
    return str(path)


@pytest.mark.parametrize("is_averaged", [True, False])
def test_the_averaged_weights_are_exported_where_there_are_any(
    tmp_path: Path, is_averaged: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    model, average = network(0).state_dict(), network(1).state_dict()
    last = saved(tmp_path / "last.pt", 7, model, average if is_averaged else None)
    assert main([last, str(tmp_path / "firenet.pt")]) == 0
    assert "trained for 7 steps" in capsys.readouterr().out
    found, name = load_network(tmp_path / "firenet.pt")
    assert name == "firenet"
    for key, tensor in found.state_dict().items():
        assert torch.equal(tensor, (average if is_averaged else model)[key])


def test_a_file_that_is_not_a_checkpoint_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(SHIPPED), str(tmp_path / "firenet.pt")]) == 2
    assert "is no checkpoint of a training run" in capsys.readouterr().err
    assert not (tmp_path / "firenet.pt").exists()


@pytest.mark.parametrize("refusal", ["No space left on device", "File exists"])
def test_a_file_that_cannot_be_written_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, refusal: str
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    last = saved(tmp_path / "last.pt", 7, network(0).state_dict())
    target = tmp_path / "firenet.pt"
    if refusal == "File exists":
        target = tmp_path / "last.pt" / "firenet.pt"
    else:
        monkeypatch.setattr(os, "fsync", full)
    assert main([last, str(target)]) == 2
    assert f"{target}: {refusal}; give another FILE, or free space there" in capsys.readouterr().err
