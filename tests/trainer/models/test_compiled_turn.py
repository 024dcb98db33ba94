"""Test ``compute.compile: step``: compiling one iteration of each loop does not change a network."""

from __future__ import annotations

import copy
from functools import partial

import pytest
import torch
from torch import Tensor

from trainer.models import E2VID, ERAFT, ETNet, FireNet, HyperE2VID, VoxelNetwork
from trainer.models.blocks import Loop
from trainer.models.sequence import Guide

pytestmark = [  # of what torch.compile itself does
    pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor"),
    pytest.mark.filterwarnings("ignore:`torch.jit.*:DeprecationWarning"),
]
SIDE_PX = 33
NETWORKS = {
    "firenet": partial(FireNet, base_channels=2),
    "e2vid": partial(E2VID, base_channels=2),
    "hypere2vid": partial(HyperE2VID, base_channels=2),
    "etnet": partial(ETNet, base_channels=2),
    "eraft": ERAFT,
}


def compared(network: VoxelNetwork) -> None:
    """Compare outputs, gradients and statistics of two training steps, and the output outside training."""
    eager = copy.deepcopy(network)
    network.compile_turns()
    torch.manual_seed(0)
    for _ in range(2):
        voxels = torch.randint(-3, 4, (2, 3, network.bins, SIDE_PX, SIDE_PX)).float()
        guide = Guide(torch.rand(2, 3, 1, SIDE_PX, SIDE_PX), 0.3) if isinstance(network, HyperE2VID) else None
        for each in (eager, network):
            torch.manual_seed(1)  # dropout
            each.zero_grad()
            each(voxels, None, guide)[0].square().mean().backward()
        close(network, eager)
    found: list[Tensor] = []
    for each in (eager, network):
        each.eval()
        with torch.no_grad():
            found.append(each(voxels)[0])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-5)
    assert all(loop.turn == loop._turn for loop in network.modules() if isinstance(loop, Loop))


def close(network: VoxelNetwork, eager: VoxelNetwork) -> None:
    for (name, mine), theirs in zip(network.named_parameters(), eager.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-3, atol=1e-5, msg=name)
    for (name, mine), theirs in zip(network.named_buffers(), eager.buffers(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "firenet" else [pytest.mark.slow]) for name in NETWORKS],
)
def test_one_iteration_is_traced_without_changes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """This runs all of ``torch.compile`` except code generation."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    monkeypatch.setattr("trainer.models.eraft.UPDATES", 2)
    torch.manual_seed(3)
    compared(NETWORKS[name](bins=2))
