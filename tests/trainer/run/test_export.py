"""Weights that are given to others, from a checkpoint."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession

from trainer.models import NETWORKS, FireNet, VoxelNetwork
from trainer.run.checkpoint import Checkpoint, save_checkpoint
from trainer.run.export import main
from trainer.train import main as train
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


def test_the_command_of_v2v_train_exports(tmp_path: Path) -> None:
    last = saved(tmp_path / "last.pt", 7, network(0).state_dict())
    assert train(["export", last, str(tmp_path / "firenet.pt")]) == 0
    assert load_network(tmp_path / "firenet.pt")[1] == "firenet"


NETWORKS_OF_SIZES = {
    "firenet": {"base_channels": 4, "normalize_voxels": True, "padding": "centred"},
    "e2vid": {"base_channels": 4, "encoders": 2},
    "evflownet": {"base_channels": 2},
}


def exported(folder: Path, name: str) -> tuple[VoxelNetwork, Path]:
    """Return a network of random weights, and its file as ONNX for grids of 44 x 36 px, which are padded."""
    torch.manual_seed(0)
    options = NETWORKS_OF_SIZES[name]
    made = NETWORKS[name](**options).eval()
    config = {"network": {"name": name, "options": options}}
    torch.save({"state_dict": made.state_dict(), "config": config}, folder / "weights.pt")
    assert main([str(folder / "weights.pt"), str(folder / "out.onnx"), "--onnx", "--size", "44x36"]) == 0
    return made, folder / "out.onnx"


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # of the exporter's own code
@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS_OF_SIZES)
def test_onnx_computes_the_same_with_its_memory_as_inputs_and_outputs(name: str, tmp_path: Path) -> None:
    made, file = exported(tmp_path, name)
    session = InferenceSession(file, providers=["CPUExecutionProvider"])
    first, *memory = session.get_inputs()
    assert first.name == "voxels"
    assert [each.name for each in session.get_outputs()][1:] == [each.name.replace("state", "next") for each in memory]
    held = {each.name: np.zeros(each.shape, np.float32) for each in memory}
    state: Any = None
    outputs = []
    for _ in range(20):
        voxels = torch.randint(-2, 3, (1, 5, 36, 44)).float()
        found, *after = session.run(None, {"voxels": voxels.numpy(), **held})
        held = dict(zip(held, after, strict=True))
        with torch.inference_mode():
            expected, state = made(voxels[:, None], state)
        np.testing.assert_allclose(found, expected[:, 0].numpy(), rtol=0, atol=1e-4)
        outputs.append(found)
    assert np.ptp(outputs) > 1e-3  # not blank
    if name != "evflownet":
        forgetful = session.run(None, {"voxels": voxels.numpy(), **{each: 0 * value for each, value in held.items()}})
        assert np.abs(forgetful[0] - found).max() > 1e-3


@pytest.mark.parametrize("name", ["etnet"])
def test_a_network_that_was_not_compared_is_not_exported(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = NETWORKS[name]()
    torch.save(
        {"state_dict": made.state_dict(), "config": {"network": {"name": name, "options": {}}}}, tmp_path / "w.pt"
    )
    assert main([str(tmp_path / "w.pt"), str(tmp_path / "out.onnx"), "--onnx"]) == 2
    assert "--onnx exports firenet, e2vid, evflownet, and this is etnet" in capsys.readouterr().err


def test_a_missing_package_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def export(*_: object, **__: object) -> None:
        raise ImportError("No module named 'onnx'")

    monkeypatch.setattr(torch.onnx, "export", export)
    assert main([str(SHIPPED), str(tmp_path / "out.onnx"), "--onnx"]) == 2
    assert "pip install onnx onnxscript" in capsys.readouterr().err
    assert not (tmp_path / "out.onnx").exists()


def test_the_checkpoint_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "last.pt"), str(tmp_path / "last.pt"), "--onnx"]) == 2
    assert "it is the checkpoint; give another FILE" in capsys.readouterr().err
