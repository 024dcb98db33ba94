"""Test properties of every network: published keys and sizes, memory, batches, picture sizes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.trainer.models.numpy_networks import counts
from trainer.models import NETWORKS, VoxelNetwork
from trainer.weights import load_network
from v2v_protocol.errors import UsageError

SMALL: dict[str, dict[str, Any]] = {
    "e2vid": {"base_channels": 4, "encoders": 2},
    "hypere2vid": {"base_channels": 2},
    "etnet": {"base_channels": 2},
    "firenet": {"base_channels": 4},
    "evflownet": {"base_channels": 4},
    "eraft": {},
}
FORGETFUL = ("evflownet",)
"""Nothing of a window reaches the next."""


@pytest.fixture(params=[pytest.param(name, marks=[pytest.mark.slow] if name == "eraft" else []) for name in NETWORKS])
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(autouse=True)
def _two_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit E-RAFT to two updates; the other ten would test nothing more."""
    monkeypatch.setattr("trainer.models.eraft.UPDATES", 2)


@pytest.fixture
def network(name: str) -> VoxelNetwork:
    """Return each network at a small size, with weights for which the memory matters."""
    torch.manual_seed(0)
    return NETWORKS[name](**SMALL[name]).eval()


PUBLISHED: dict[str, dict[str, list[int]]] = json.loads(Path(__file__).with_name("published_keys.json").read_text())
"""The names and shapes in the files that the authors of each network publish."""
OF_15_BINS = {f"{net}.conv1.weight": [64, 15, 7, 7] for net in ("fnet", "cnet")}


@pytest.mark.parametrize(
    ("name", "changed", "parameters", "buffers"),
    [
        ("e2vid", {}, 10_710_401, 0),
        ("firenet", {}, 37_777, 0),
        ("hypere2vid", {}, 10_149_881, 574),
        ("etnet", {}, 22_175_361, 20_000 * 256),
        ("evflownet", {}, 14_125_346, 0),
        ("eraft", {}, 5_270_080, None),
        ("eraft", OF_15_BINS, 5_332_800, None),
    ],
)
def test_published_files_are_recognised_and_load_strictly(
    tmp_path: Path, name: str, changed: dict[str, list[int]], parameters: int, buffers: int | None
) -> None:
    # Each tensor is one stored number.
    state = {key: torch.tensor(0.01).expand(shape) for key, shape in (PUBLISHED[name] | changed).items()}
    state = {key: value.long() if key.endswith("num_batches_tracked") else value for key, value in state.items()}
    torch.save({"state_dict": {f"module.{key}": value for key, value in state.items()}, "epoch": 9}, tmp_path / "a.pth")
    network, found = load_network(tmp_path / "a.pth")
    assert found == name
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters
    if buffers is not None:
        assert sum(buffer.numel() for buffer in network.buffers()) == buffers
    for key, value in network.state_dict().items():
        if key not in network.computed and value.is_floating_point():
            assert (value == 0.01).all(), key
    missing = next(key for key in state if key.endswith(("conv2.weight", "pred.conv2d.weight")))
    torch.save({key: value for key, value in state.items() if key != missing}, tmp_path / "b.pth")
    with pytest.raises(UsageError, match="missing"):
        load_network(tmp_path / "b.pth")


# --- sequences ----------------------------------------------------------------------------------------------------


def test_pieces_with_their_state_equal_the_whole(name: str, network: VoxelNetwork) -> None:
    """The sides are not multiples of any size that a network needs."""
    voxels = torch.from_numpy(counts((2, 5, 5, 17, 23)))
    with torch.no_grad():
        whole, last = network(voxels)
        first, state = network(voxels[:, :2])
        second, end = network(voxels[:, 2:], state)
        alone, _ = network(voxels[:, 2:])
    assert whole.shape == (2, 5 - network.lead_voxels, 2 if network.task == "flow" else 1, 17, 23)
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole, rtol=0, atol=1e-5)
    if name not in FORGETFUL:
        assert not torch.allclose(alone, whole[:, -alone.shape[1] :], atol=1e-3), "the state makes no difference"
    torch.testing.assert_close(end, last, rtol=0, atol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(network(voxels)[0], whole, rtol=0, atol=1e-6)


def test_the_order_of_a_batch_is_that_of_its_outputs(network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((3, 3, 5, 16, 16)))
    with torch.no_grad():
        together = network.forward_sequence(voxels)
        for index in range(3):
            torch.testing.assert_close(
                network.forward_sequence(voxels[index : index + 1])[0], together[index], rtol=0, atol=1e-5
            )
    network.train()
    for module in network.modules():
        if isinstance(module, torch.nn.Dropout | torch.nn.MultiheadAttention):
            module.eval()  # dropout alone knows of places
    order = torch.tensor([2, 0, 1])
    with torch.no_grad():
        together, permuted = network.forward_sequence(voxels), network.forward_sequence(voxels[order])
    clips = together.ndim - 5
    torch.testing.assert_close(permuted, together.index_select(clips, order), rtol=0, atol=1e-4)


def test_gradients_reach_every_parameter_and_the_first_window(network: VoxelNetwork) -> None:
    network.train()
    voxels = torch.from_numpy(counts((2, 3, 5, 16, 16))).float().requires_grad_()
    network.forward_sequence(voxels)[..., -1, :, :, :].square().mean().backward()
    assert voxels.grad is not None
    assert voxels.grad[:, 0].any() == (network.task == "reconstruction"), "flow starts warm, without a gradient"
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key
        assert parameter.grad.abs().sum() > 0, key


def test_autocast_gives_float32_outputs_near_the_exact_ones(name: str, network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((1, 6, 5, 16, 16)))
    with torch.no_grad():
        exact = network.forward_sequence(voxels)
        with torch.autocast("cpu", torch.bfloat16):
            outputs, _ = network(voxels)
    assert outputs.dtype == torch.float32
    if name != "eraft":  # random weights amplify every rounding from update to update
        assert (outputs - exact).abs().max() < 0.15 * exact.std()


@pytest.mark.parametrize("shape", [(2, 5, 16, 16), (1, 2, 4, 16, 16), (1, 0, 5, 16, 16)])
def test_wrong_shapes_are_refused(network: VoxelNetwork, shape: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="5, H, W"):
        network(torch.zeros(shape))


@pytest.mark.parametrize("padding", ["bottom-right", "centred", "top-left"])
def test_padding_is_zeros_at_the_stated_sides(name: str, padding: str) -> None:
    """The output equals that for an input which contains these zeros."""
    torch.manual_seed(0)
    network = NETWORKS[name](**SMALL[name], padding=padding).eval()  # type: ignore[arg-type]
    left, right, top, bottom = network._edges(19, 21)
    assert (19 + top + bottom) % network.size_multiple == (21 + left + right) % network.size_multiple == 0
    if padding == "centred" and name != "eraft":
        assert left - right in (0, 1)
        assert top - bottom in (0, 1)
    elif name != "eraft":
        assert (left, top) == (0, 0) if padding == "bottom-right" else (right, bottom) == (0, 0)
    voxels = torch.from_numpy(counts((1, 2, 5, 19, 21)))
    padded = torch.nn.functional.pad(voxels, (left, right, top, bottom))
    with torch.no_grad():
        expected = network.forward_sequence(padded)[..., top : top + 19, left : left + 21]
        torch.testing.assert_close(network.forward_sequence(voxels), expected, rtol=0, atol=1e-5)
