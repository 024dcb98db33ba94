"""Compare E2VID with a float64 NumPy network, and with its published keys."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from tests.trainer.models.numpy_networks import counts
from trainer.models import E2VID, normalize_voxels
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
    """The network has its full size; the input is two clips of two steps with sides that need padding."""
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
