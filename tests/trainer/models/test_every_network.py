"""Test properties of every network: published keys and sizes, memory, batches, picture sizes, no synchronisation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from tests.trainer.models.numpy_networks import counts
from trainer.models import NETWORKS, VoxelNetwork
from trainer.models.sequence import Guide
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
    chosen: str = request.param
    return chosen


@pytest.fixture(autouse=True)
def _two_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit E-RAFT to two updates; the other ten would test nothing more."""
    monkeypatch.setattr("trainer.models.eraft.UPDATES", 2)


@pytest.fixture
def network(name: str) -> VoxelNetwork:
    """Return each network at a small size, with weights for which the memory matters."""
    torch.manual_seed(0)
    return NETWORKS[name](**SMALL[name]).eval()


# --- published keys -----------------------------------------------------------------------------------------------

Shapes = dict[str, tuple[int, ...]]


def conv(name: str, outputs: int, inputs: int, *kernel: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs, *(kernel or (1, 1))), f"{name}.bias": (outputs,)}


def norm(name: str, channels: int) -> Shapes:
    statistics = dict.fromkeys(("weight", "bias", "running_mean", "running_var"), (channels,))
    return {f"{name}.{key}": shape for key, shape in statistics.items()} | {f"{name}.num_batches_tracked": ()}


def linear(name: str, *shape: int) -> Shapes:
    return {f"{name}.weight": shape, f"{name}.bias": shape[:1]}


def e2vid_encoders(prefix: str, encoders: str) -> Shapes:
    keys = conv(f"{prefix}head.conv2d", 32, 5, 5, 5)
    for level, width in enumerate((64, 128, 256)):
        keys |= conv(f"{prefix}{encoders}.{level}.conv.conv2d", width, width // 2, 5, 5)
        keys |= conv(f"{prefix}{encoders}.{level}.recurrent_block.Gates", 4 * width, 2 * width, 3, 3)
    return keys


def hypere2vid() -> Shapes:
    u = "unetrecurrent."
    keys = e2vid_encoders(u, "encoders") | conv(f"{u}pred.conv2d", 1, 32)
    for block in range(2):
        for number in (1, 2):
            keys |= conv(f"{u}resblocks.{block}.conv{number}", 256, 256, 3, 3)
    keys |= conv(f"{u}decoders.1.conv2d", 64, 128, 5, 5) | conv(f"{u}decoders.2.conv2d", 32, 64, 5, 5)
    d = f"{u}decoders.0."
    keys |= conv(f"{d}context_fusion.conv", 32, 6, 3, 3) | {f"{d}dynamic_atom_generation.bases": (12, 25)}
    keys |= conv(f"{d}dynamic_atom_generation.bases_net.0", 64, 32, 3, 3)
    keys |= norm(f"{d}dynamic_atom_generation.bases_net.1", 64)
    keys |= conv(f"{d}dynamic_atom_generation.bases_net.3", 72, 64, 3, 3)
    keys |= norm(f"{d}dynamic_atom_generation.bases_net.4", 72)
    return keys | {
        f"{d}dynamic_conv.compositional_coefficients": (128, 1536, 1, 1), f"{d}dynamic_conv.bias": (128,)
    }  # fmt: skip


def etnet() -> Shapes:
    keys = e2vid_encoders("", "DownsampleConv") | conv("pred.conv2d", 1, 32)
    for level, width in enumerate((128, 64, 32)):
        keys |= conv(f"UpsampleConv.{level}.conv2d", width, 2 * width, 5, 5)
    keys |= conv("split1", 256, 128, 2, 2) | conv("split2", 256, 64, 4, 4)
    for scale in range(3):
        for kind, layers, attentions, norms in (
            ("encoder", 3, ("self_attn",), ("norm1", "norm2")),
            ("decoder", 2, ("self_attn", "cross_attn"), ("norm1", "norm21", "norm22", "norm3")),
        ):
            for layer in range(layers):
                at = f"trans_{kind}{scale}.{kind}.layers.{layer}."
                for attention in attentions:
                    keys |= {f"{at}{attention}.in_proj_weight": (768, 256), f"{at}{attention}.in_proj_bias": (768,)}
                    keys |= linear(f"{at}{attention}.out_proj", 256, 256)
                for each in norms:
                    keys |= linear(f"{at}{each}", 256)
                keys |= linear(f"{at}linear1", 1024, 256) | linear(f"{at}linear2", 256, 1024)
    return keys


def evflownet() -> Shapes:
    keys = conv("unet.pred.conv2d", 2, 32)
    for level, (inputs, outputs) in enumerate(((5, 64), (64, 128), (128, 256), (256, 512))):
        keys |= conv(f"unet.encoders.{level}.conv2d", outputs, inputs, 3, 3)
    for level, width in enumerate((256, 128, 64, 32)):
        keys |= conv(f"unet.decoders.{level}.conv2d", width, 4 * width, 3, 3)
    for block in range(2):
        for number in (1, 2):
            keys |= conv(f"unet.resblocks.{block}.conv{number}", 512, 512, 3, 3)
    return keys


def eraft(bins: int = 5) -> Shapes:
    keys: Shapes = {}
    for net in ("fnet", "cnet"):
        normed = norm if net == "cnet" else lambda _name, _channels: {}
        keys |= conv(f"{net}.conv1", 64, bins, 7, 7) | normed(f"{net}.norm1", 64) | conv(f"{net}.conv2", 256, 128)
        for layer, (inputs, width) in enumerate(((64, 64), (64, 96), (96, 128)), start=1):
            for block in range(2):
                at = f"{net}.layer{layer}.{block}."
                keys |= conv(f"{at}conv1", width, width if block else inputs, 3, 3) | conv(
                    f"{at}conv2", width, width, 3, 3
                )
                keys |= normed(f"{at}norm1", width) | normed(f"{at}norm2", width)
                if layer > 1 and not block:
                    keys |= conv(f"{at}downsample.0", width, inputs)
                    keys |= normed(f"{at}norm3", width) | normed(f"{at}downsample.1", width)
    u = "update_block."
    keys |= conv(f"{u}encoder.convc1", 256, 324) | conv(f"{u}encoder.convc2", 192, 256, 3, 3)
    keys |= conv(f"{u}encoder.convf1", 128, 2, 7, 7) | conv(f"{u}encoder.convf2", 64, 128, 3, 3)
    keys |= conv(f"{u}encoder.conv", 126, 256, 3, 3)
    for gate in "zrq":
        keys |= conv(f"{u}gru.conv{gate}1", 128, 384, 1, 5) | conv(f"{u}gru.conv{gate}2", 128, 384, 5, 1)
    keys |= conv(f"{u}flow_head.conv1", 256, 128, 3, 3) | conv(f"{u}flow_head.conv2", 2, 256, 3, 3)
    return keys | conv(f"{u}mask.0", 256, 128, 3, 3) | conv(f"{u}mask.2", 576, 256)


@pytest.mark.parametrize(
    ("name", "keys", "count", "parameters", "buffers"),
    [
        ("hypere2vid", hypere2vid(), 47, 10_149_881, 574),
        ("etnet", etnet(), 254, 22_175_361, 20_000 * 256),
        ("evflownet", evflownet(), 26, 14_125_346, 0),
        ("eraft", eraft(), 179, 5_270_080, None),
        ("eraft", eraft(15), 179, 5_332_800, None),
    ],
)
def test_published_files_are_recognised_and_load_strictly(
    tmp_path: Path, name: str, keys: Shapes, count: int, parameters: int, buffers: int | None
) -> None:
    assert len(keys) == count
    state = {key: torch.full(shape, 0.01) for key, shape in keys.items()}
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


def test_the_future_does_not_reach_the_past(name: str, network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((1, 4, 5, 16, 16))).float().requires_grad_()
    outputs = network.forward_sequence(voxels)
    (of_last,) = torch.autograd.grad(outputs[:, -1].sum(), voxels, retain_graph=True)
    (of_first,) = torch.autograd.grad(outputs[:, 0].sum(), voxels)
    assert of_last[:, -1].abs().sum() > 0
    assert of_first[:, 0].abs().sum() > 0
    assert of_first[:, 1 + network.lead_voxels :].abs().sum() == 0
    if network.task == "reconstruction":
        assert of_last[:, 0].abs().sum() > 0


def test_every_parameter_gets_a_gradient(network: VoxelNetwork) -> None:
    network.train()
    network.forward_sequence(torch.from_numpy(counts((2, 3, 5, 16, 16)))).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


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


def test_computing_does_not_synchronise_with_the_device(name: str, network: VoxelNetwork) -> None:
    """Fake tensors have no values: reading one (``item``, ``if tensor``, boolean indexing) raises."""
    network.normalizes = True
    guide = Guide(torch.zeros(2, 3, 1, 17, 20), 0.5)
    network.train()
    with FakeTensorMode(allow_non_fake_inputs=True):
        voxels = torch.zeros(2, 3, 5, 17, 20, dtype=torch.int8)
        for lowered in (False, True):
            with torch.autocast("cpu", torch.bfloat16, enabled=lowered):
                network(voxels, None, guide)[0].square().mean().backward()
        with pytest.raises(DataDependentOutputException):
            voxels.sum().item()
