"""What is trained, taken up from a checkpoint of other circumstances."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from tests.trainer.training import ALONE, configured
from trainer.config import ComputeConfig
from trainer.config_file import load_config
from trainer.learner import build, channels_last, obeying_weights
from trainer.models import FireNet
from trainer.models.blocks import Loop
from trainer.run.checkpoint import load_checkpoint, save_checkpoint
from trainer.run.distributed import Ranks
from trainer.tasks import Work
from trainer.train import main
from trainer.weights import SHIPPED, load_network
from v2v_protocol.errors import UsageError
from v2v_protocol.safe_yaml import parse_yaml


def test_a_training_begins_with_the_shipped_weights() -> None:
    """By their name, which means the same on every host and in every folder."""
    network = build(obeying_weights(load_config("finetune-cpu")), ALONE).network
    shipped, _ = load_network(SHIPPED)
    for name, tensor in shipped.state_dict().items():
        assert torch.equal(network.state_dict()[name], tensor)


@pytest.mark.parametrize("fused", [False, True], ids=["to a CPU", "to a GPU"])
@pytest.mark.parametrize("was_fused", [False, True], ids=["from a CPU", "from a GPU"])
@pytest.mark.parametrize("channels_last", [False, True])
def test_the_optimiser_resumes_in_another_memory_format(
    tmp_path: Path, channels_last: bool, was_fused: bool, fused: bool
) -> None:
    """Fused as on a GPU, on the CPU."""
    layouts = [f"compute.channels_last={str(each).lower()}" for each in (not channels_last, channels_last)]
    before, after = (build(load_config(configured(tmp_path), [layout]), ALONE) for layout in layouts)
    before.optimizer.param_groups[0]["fused"], after.optimizer.param_groups[0]["fused"] = was_fused, fused
    work = Work(voxels=torch.randint(-3, 4, (2, 3, 2, 16, 20)), truth={"frames": torch.rand(2, 3, 1, 16, 20)})
    for number in range(3):
        before.step(work, number, 0)
    save_checkpoint(tmp_path / "last.pt", before.checkpoint(3, None))
    after.restore(load_checkpoint(tmp_path / "last.pt"))
    assert [group["fused"] for group in after.optimizer.param_groups] == [fused]
    for parameter, state in after.optimizer.state.items():
        moments = [state[name] for name in ("exp_avg", "exp_avg_sq", "max_exp_avg_sq")]
        assert {moment.stride() for moment in moments} == {parameter.stride()}
    for each in (before, after):
        each.step(work, 3, 0)
    for name, tensor in before.network.state_dict().items():
        assert torch.allclose(after.network.state_dict()[name], tensor, rtol=0, atol=1e-5), name


@pytest.mark.parametrize(
    ("said", "device", "precision", "last"),
    [
        ("auto", "cpu", "float32", True),
        ("auto", "cuda", "float32", False),
        ("auto", "cuda", "tf32", True),
        ("auto", "cuda", "bfloat16", True),
        (False, "cpu", "tf32", False),
        (True, "cuda", "float32", True),
    ],
)
def test_the_memory_format_follows_device_and_precision(
    said: bool | str, device: str, precision: Literal["float32", "tf32", "bfloat16"], last: bool
) -> None:
    compute = ComputeConfig(channels_last=said, precision=precision)
    assert channels_last(compute, torch.device(device)) is last


@pytest.mark.parametrize(
    ("saved", "file", "expected"),
    [
        ({"precision": "float32", "channels_last": False}, "", ("float32", False)),
        ({"precision": "tf32", "channels_last": "auto"}, "", ("tf32", "auto")),
        ({}, "", ("float32", False)),  # of a release without these keys
        ({"precision": "float32", "channels_last": False}, "compute: {precision: bfloat16}", ("bfloat16", False)),
    ],
)
def test_a_resumed_run_keeps_the_precision_of_its_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], saved: dict[str, Any], file: str,
    expected: tuple[str, bool | str],
) -> None:  # fmt: skip
    """Not the default, which may have changed since; what the file says goes first."""
    plain = build(load_config(configured(tmp_path)), ALONE).checkpoint(1, None)
    others = {key: value for key, value in plain.config["compute"].items() if key not in ("precision", "channels_last")}
    config = {**plain.config, "compute": others | saved}
    save_checkpoint(tmp_path / "last.pt", dataclasses.replace(plain, config=config))
    (tmp_path / "mine.yaml").write_text(file)
    assert main([str(tmp_path / "mine.yaml"), "--resume", str(tmp_path / "last.pt"), "--show-config"]) == 0
    shown = parse_yaml(capsys.readouterr().out)["compute"]
    assert (shown["precision"], shown["channels_last"]) == expected
    assert (ComputeConfig().precision, ComputeConfig().channels_last) == ("tf32", "auto")


def test_weights_determine_the_network_and_the_configuration_overrides(tmp_path: Path) -> None:
    first = build(load_config(configured(tmp_path)), ALONE)
    torch.save({"state_dict": first.network.state_dict(), "data_loader": {"normalize": True}}, tmp_path / "small.pth")
    weights = f"network.weights={tmp_path / 'small.pth'}"
    obeyed = obeying_weights(load_config(configured(tmp_path), [weights, "network.options={}"]))
    assert obeyed.network.options == {"base_channels": 2, "normalize_voxels": True, "padding": "centred"}
    assert build(obeyed, ALONE).network.normalizes
    own = "network.options={normalize_voxels: false}"
    assert not build(obeying_weights(load_config(configured(tmp_path), [weights, own])), ALONE).network.normalizes
    for setting, told in (
        ("stream.recipe.bins=5", r"set stream\.recipe\.bins = 2$"),
        ("network.name=e2vid", r"set network\.name = firenet$"),
    ):
        config = load_config(configured(tmp_path), [weights, "network.options={}", setting])
        with pytest.raises(UsageError, match=rf"network\.weights: .*small\.pth is of another network; {told}"):
            obeying_weights(config)


@pytest.mark.parametrize("longest", [0.0, 0.3])
def test_pieces_of_a_batch_make_the_same_step(tmp_path: Path, longest: float) -> None:
    """And gradients are shortened, or left alone, as PyTorch would."""
    network = FireNet(bins=2, base_channels=2)
    results = []
    for pieces in (1, 4):
        settings = [f"compute.pieces={pieces}", f"optimizer.clip_gradient_norm={longest}"]
        built = build(load_config(configured(tmp_path), settings), ALONE)
        built.network.load_state_dict(network.state_dict())
        torch.manual_seed(0)
        voxels, frames = torch.randint(-3, 4, (4, 3, 2, 16, 20)), torch.rand(4, 3, 1, 16, 20)
        values = built.step(Work(voxels=voxels, truth={"frames": frames}), 0, 0)
        results.append((values, [parameter.grad for parameter in built.network.parameters()]))
    (whole, gradients), (parts, others) = results
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value)
    torch.testing.assert_close(others, gradients)
    network.zero_grad()
    (network(voxels)[0] - frames).abs().mean().backward()
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), longest or float("inf"))
    torch.testing.assert_close(whole["gradient_norm"], norm)
    torch.testing.assert_close(gradients, [parameter.grad for parameter in network.parameters()])


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # torch.compile looks at all of it
def test_one_compiled_time_step_makes_the_same_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    voxels, frames = torch.randint(-3, 4, (4, 3, 2, 16, 20)), torch.rand(4, 3, 1, 16, 20)
    results = []
    for compiled in ("none", "step"):
        built = build(load_config(configured(tmp_path), [f"compute.compile={compiled}"]), ALONE)
        values = [built.step(Work(voxels=voxels, truth={"frames": frames}), step, 0) for step in range(2)]
        results.append((values, built.network.state_dict(), built.trained.state_dict()))
    assert any(isinstance(module, Loop) and module._compiled for module in built.network.modules())
    torch.testing.assert_close(results[1], results[0])


def test_a_compiled_step_needs_a_new_pytorch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "__version__", "2.6.0+cu124")
    with pytest.raises(UsageError, match=r"compute\.compile = step: PyTorch is 2\.6\.0\+cu124, and this needs 2\.7"):
        build(load_config(configured(tmp_path), ["compute.compile=step"]), ALONE)
    build(load_config(configured(tmp_path)), ALONE)


def test_dropout_differs_between_ranks_and_steps_and_not_between_runs(tmp_path: Path) -> None:
    """One process for each rank in turn, with the same weights and the same batch."""
    voxels, frames = torch.randint(-3, 4, (2, 3, 2, 16, 20)), torch.rand(2, 3, 1, 16, 20)
    settings = ["network.name=etnet", "optimizer.learning_rate=1e-12"]

    def loss(rank: int, step: int) -> float:
        built = build(load_config(configured(tmp_path), settings), ALONE)
        alone = dataclasses.replace(built, rank=rank)  # without its siblings
        return float(alone.step(Work(voxels=voxels, truth={"frames": frames}), step, 0)["total"])

    found = [loss(rank, step) for rank, step in ((0, 0), (1, 0), (0, 1), (0, 0))]
    assert len(set(found)) == 3
    assert found[0] == found[3]


@pytest.mark.parametrize(
    ("settings", "ranks", "message"),
    [
        (["compute.pieces=3"], ALONE, r"compute\.pieces = 3: give a divisor of stream\.batch_size = 4"),
        (
            ["compute.compile=step", "network.name=evflownet", "loss.flow=stream"],
            ALONE,
            r"compute\.compile = step: EVFlowNet has no loop .*; take clip, or none",
        ),
        (
            ["compute.cuda_graph=true"],
            Ranks(0, 2, torch.device("cuda")),
            r"compute\.cuda_graph = true: 2 ranks exchange gradients",
        ),
        pytest.param(
            ["compute.cuda_graph=true"],
            ALONE,
            r"compute\.cuda_graph = true: PyTorch sees no GPU here",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused(tmp_path: Path, settings: list[str], ranks: Ranks, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        build(load_config(configured(tmp_path), settings), ranks)
