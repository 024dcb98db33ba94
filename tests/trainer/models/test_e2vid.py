"""E2VID against a float64 numpy network, its published keys, and what holds for every recurrent network."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from tests.trainer.models import numpy_networks as oracle
from trainer.models import E2VID, NETWORKS, VoxelNetwork, normalize_voxels
from trainer.models.blocks import TransposedConvLayer
from v2v_protocol.errors import UsageError

PUBLISHED = {
    "head.conv2d": (32, 5, 5, 5),
    "encoders.0.conv.conv2d": (64, 32, 5, 5),
    "encoders.0.recurrent_block.Gates": (256, 128, 3, 3),
    "encoders.1.conv.conv2d": (128, 64, 5, 5),
    "encoders.1.recurrent_block.Gates": (512, 256, 3, 3),
    "encoders.2.conv.conv2d": (256, 128, 5, 5),
    "encoders.2.recurrent_block.Gates": (1024, 512, 3, 3),
    "resblocks.0.conv1": (256, 256, 3, 3),
    "resblocks.0.conv2": (256, 256, 3, 3),
    "resblocks.1.conv1": (256, 256, 3, 3),
    "resblocks.1.conv2": (256, 256, 3, 3),
    "decoders.0.conv2d": (128, 256, 5, 5),
    "decoders.1.conv2d": (64, 128, 5, 5),
    "decoders.2.conv2d": (32, 64, 5, 5),
    "pred.conv2d": (1, 32, 1, 1),
}


def counts(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Signed event counts, mostly 0, as they come from the stream."""
    rng = np.random.default_rng(seed)
    return (rng.integers(-3, 4, shape) * (rng.random(shape) < 0.3)).astype(np.int8)


@pytest.fixture(params=sorted(NETWORKS))
def network(request: pytest.FixtureRequest) -> VoxelNetwork:
    """Each network, small, with weights that let the memory matter."""
    torch.manual_seed(0)
    small = {"e2vid": {"base_channels": 4, "encoders": 2}, "firenet": {"base_channels": 4}}
    return NETWORKS[request.param](**small[request.param])  # type: ignore[arg-type]


def test_keys_shapes_and_size_are_the_published_ones() -> None:
    state = E2VID().state_dict()
    expected = {}
    for name, shape in PUBLISHED.items():
        expected[f"unetrecurrent.{name}.weight"] = shape
        expected[f"unetrecurrent.{name}.bias"] = shape[:1]
    assert {name: tuple(tensor.shape) for name, tensor in state.items()} == expected
    assert len(state) == 30
    assert sum(parameter.numel() for parameter in E2VID().parameters()) == 10_710_401


def test_equals_the_numpy_network() -> None:
    """Full size, two clips of two steps, sides that need padding."""
    model = E2VID()
    weights = oracle.random_weights(model, seed=1)
    voxels = counts((2, 2, 5, 13, 18))
    expected = np.stack([oracle.e2vid(clip.astype(np.float64), weights) for clip in voxels])
    assert expected.std() > 0.1
    with torch.no_grad():
        pictures = model.forward_sequence(torch.from_numpy(voxels))
        np.testing.assert_allclose(pictures.numpy(), expected, rtol=0, atol=1e-11)
        pictures = model.float().to(memory_format=torch.channels_last).forward_sequence(torch.from_numpy(voxels))
        assert pictures.dtype == torch.float32
        np.testing.assert_allclose(pictures.numpy(), expected, rtol=0, atol=2e-5)


def test_transposed_convolution_doubles_the_size() -> None:
    """Every input pixel adds its kernel around the even output pixel that it maps to."""
    layer = TransposedConvLayer(2, 3, 5)
    weights = oracle.random_weights(layer, seed=3)
    x = np.random.default_rng(0).standard_normal((2, 4, 3))
    expected = np.zeros((3, 8 + 4, 6 + 4))
    for row, column in np.ndindex(4, 3):
        patch = np.tensordot(x[:, row, column], weights["transposed_conv2d.weight"], axes=1)
        expected[:, 2 * row : 2 * row + 5, 2 * column : 2 * column + 5] += patch
    expected = oracle.relu(expected[:, 2:-2, 2:-2] + weights["transposed_conv2d.bias"][:, None, None])
    with torch.no_grad():
        np.testing.assert_allclose(layer(torch.from_numpy(x)[None])[0].numpy(), expected, rtol=0, atol=1e-12)


def test_first_release_has_norm_sigmoid_and_transposed_convolutions() -> None:
    model = E2VID(base_channels=4, norm="batch", upsampling="transposed", final_activation="sigmoid").eval()
    with torch.no_grad():
        pictures = model.forward_sequence(torch.from_numpy(counts((1, 2, 5, 16, 16))))
    assert 0 < pictures.min() < pictures.max() < 1
    assert {"unetrecurrent.pred.norm_layer.running_mean", "unetrecurrent.resblocks.0.bn1.weight"} <= set(
        model.state_dict()
    )


@pytest.mark.parametrize("options", [{"norm": "instance"}, {"upsampling": "nearest"}, {"final_activation": "relu"}])
def test_unknown_settings_are_refused(options: dict[str, str]) -> None:
    with pytest.raises(UsageError, match=next(iter(options))):
        E2VID(**options)  # type: ignore[arg-type]


def test_pieces_with_their_state_equal_the_whole(network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((2, 5, 5, 17, 20)))
    with torch.no_grad():
        whole, last = network(voxels)
        first, state = network(voxels[:, :2])
        second, end = network(voxels[:, 2:], state)
        alone, _ = network(voxels[:, 2:])
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole, rtol=0, atol=1e-6)
    assert not torch.allclose(alone, whole[:, 2:], atol=1e-3), "the state makes no difference"
    torch.testing.assert_close(end, last, rtol=0, atol=1e-6)
    torch.testing.assert_close(network(voxels)[0], whole, rtol=0, atol=1e-6)


def test_clips_of_a_batch_are_independent_and_in_their_place(network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((3, 4, 5, 16, 16)))
    with torch.no_grad():
        together = network.forward_sequence(voxels)
        for index in range(3):
            torch.testing.assert_close(
                network.forward_sequence(voxels[index : index + 1])[0], together[index], rtol=0, atol=1e-6
            )


def test_the_past_reaches_the_last_picture_and_the_future_not_the_first(network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((1, 4, 5, 16, 16))).float().requires_grad_()
    pictures = network.forward_sequence(voxels)
    (of_last,) = torch.autograd.grad(pictures[:, -1].sum(), voxels, retain_graph=True)
    (of_first,) = torch.autograd.grad(pictures[:, 0].sum(), voxels)
    assert of_last[:, 0].abs().sum() > 0
    assert of_first[:, 0].abs().sum() > 0
    assert of_first[:, 1:].abs().sum() == 0


def test_every_parameter_gets_a_gradient(network: VoxelNetwork) -> None:
    network.forward_sequence(torch.from_numpy(counts((1, 3, 5, 16, 16)))).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
    moved = sum(
        bool(parameter.grad.abs().sum() > 0) for parameter in network.parameters() if parameter.grad is not None
    )
    assert moved == len(list(network.parameters()))


def test_autocast_gives_float32_pictures_near_the_exact_ones(network: VoxelNetwork) -> None:
    voxels = torch.from_numpy(counts((1, 6, 5, 16, 16)))
    with torch.no_grad():
        exact = network.forward_sequence(voxels)
        with torch.autocast("cpu", torch.bfloat16):
            pictures, state = network(voxels)
    assert pictures.dtype == torch.float32
    assert (pictures - exact).abs().max() < 0.1 * exact.std()
    carried = state[0].cell if isinstance(network, E2VID) else state[0]
    assert carried.dtype == torch.float32


def test_nothing_waits_for_the_device(network: VoxelNetwork) -> None:
    """Fake tensors have no values: reading one (``item``, ``if tensor``, boolean indexing) raises."""
    network.normalizes = True
    with FakeTensorMode(allow_non_fake_inputs=True):
        voxels = torch.zeros(2, 3, 5, 17, 20, dtype=torch.int8)
        network.forward_sequence(voxels).square().mean().backward()
        with torch.autocast("cpu", torch.bfloat16):
            network.forward_sequence(voxels).square().mean().backward()
        with pytest.raises(DataDependentOutputException):
            voxels.sum().item()


def test_padding_is_cut_off_again() -> None:
    model = E2VID(base_channels=4, encoders=2)
    voxels = torch.from_numpy(counts((1, 2, 5, 16, 32)))
    voxels[..., 13:, :] = 0
    voxels[..., 27:] = 0
    with torch.no_grad():
        padded = model.forward_sequence(voxels[..., :13, :27])
        whole = model.forward_sequence(voxels)
    torch.testing.assert_close(padded, whole[..., :13, :27], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [(2, 5, 16, 16), (1, 2, 4, 16, 16), (1, 0, 5, 16, 16)])
def test_wrong_shapes_are_refused(network: VoxelNetwork, shape: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="5, H, W"):
        network(torch.zeros(shape))


def test_normalisation_of_voxels() -> None:
    voxels = torch.from_numpy(counts((4, 5, 9, 7))).double()
    voxels[1] = 0
    voxels[2] = (voxels[2] != 0).double() * 3
    result = normalize_voxels(voxels)
    for given, normal in zip(voxels, result, strict=True):
        assert torch.equal(normal[given == 0], torch.zeros_like(normal[given == 0]))
    for index in (0, 3):
        values = result[index][voxels[index] != 0]
        assert abs(values.mean()) < 1e-12
        assert abs(values.std(correction=0) - 1) < 1e-12
    assert torch.equal(result[1], torch.zeros_like(result[1]))
    assert torch.equal(result[2], torch.zeros_like(result[2]))
