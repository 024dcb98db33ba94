"""What is trained, taken up from a checkpoint of other circumstances."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.trainer.training import configured
from trainer.config import TrainConfig
from trainer.config_file import load_config
from trainer.learner import Learner, build
from trainer.run.checkpoint import load_checkpoint, save_checkpoint
from trainer.run.distributed import Ranks
from v2v_protocol.errors import UsageError


def learner(folder: Path, *, channels_last: bool, fused: bool) -> tuple[Learner, TrainConfig]:
    """One on the CPU; ``fused`` as if it were a GPU."""
    config = load_config(configured(folder), [f"compute.channels_last={str(channels_last).lower()}"])
    built = build(config, Ranks(0, 1, torch.device("cpu")))
    for group in built.optimizer.param_groups:
        group["fused"] = fused
    return built, config


def step(trained: Learner) -> None:
    voxels = torch.linspace(-3, 3, 2 * 3 * 2 * 16 * 20).sin().reshape(2, 3, 2, 16, 20)
    prediction, _ = trained.model(voxels)
    trained.optimizer.zero_grad()
    (prediction - 0.5).square().mean().backward()
    trained.optimizer.step()


@pytest.mark.parametrize("fused", [False, True], ids=["to a CPU", "to a GPU"])
@pytest.mark.parametrize("was_fused", [False, True], ids=["from a CPU", "from a GPU"])
@pytest.mark.parametrize("channels_last", [False, True])
def test_the_optimiser_goes_on_in_another_memory_format(
    tmp_path: Path, channels_last: bool, was_fused: bool, fused: bool
) -> None:
    before, config = learner(tmp_path, channels_last=not channels_last, fused=was_fused)
    for _ in range(3):
        step(before)
    save_checkpoint(tmp_path / "last.pt", before.checkpoint(3, None, config))
    after, _ = learner(tmp_path, channels_last=channels_last, fused=fused)
    after.restore(load_checkpoint(tmp_path / "last.pt"))
    assert [group["fused"] for group in after.optimizer.param_groups] == [fused]
    for parameter, state in after.optimizer.state.items():
        moments = [state[name] for name in ("exp_avg", "exp_avg_sq", "max_exp_avg_sq")]
        assert {moment.stride() for moment in moments} == {parameter.stride()}
    step(before)
    step(after)
    for name, tensor in before.network.state_dict().items():
        assert torch.allclose(after.network.state_dict()[name], tensor, rtol=0, atol=1e-5), name


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["network.options={}"], r"set network\.options = \{'base_channels': 2\}$"),
        (
            ["network.options={normalize_voxels: true}"],
            r"set network\.options = \{'normalize_voxels': True, 'base_channels': 2\}$",
        ),
        (["stream.recipe.bins=5"], r"set stream\.recipe\.bins = 2$"),
        (["network.name=e2vid"], r"set network\.name = firenet$"),
    ],
)
def test_of_weights_that_do_not_fit_it_is_said_what_does(tmp_path: Path, settings: list[str], message: str) -> None:
    first = build(load_config(configured(tmp_path)), Ranks(0, 1, torch.device("cpu")))
    torch.save(first.network.state_dict(), tmp_path / "small.pth")
    weights = f"network.weights={tmp_path / 'small.pth'}"
    build(load_config(configured(tmp_path), [weights]), Ranks(0, 1, torch.device("cpu")))
    with pytest.raises(UsageError, match=rf"network\.weights: .*small\.pth does not fit this network; {message}"):
        build(load_config(configured(tmp_path), [weights, *settings]), Ranks(0, 1, torch.device("cpu")))
