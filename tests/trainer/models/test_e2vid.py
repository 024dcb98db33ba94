"""Compare E2VID with a float64 NumPy network."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from tests.trainer.models.numpy_networks import counts
from trainer.models import E2VID, normalize_voxels
from trainer.models.blocks import TransposedConvLayer
from v2v_protocol.errors import UsageError


def test_equals_the_numpy_network() -> None:
    """The network has its full depth; the input is two clips of two steps with sides that need padding."""
    model = E2VID(base_channels=8)
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


def test_voxels_without_spread_are_normalised_to_zero() -> None:
    """One grid is empty, and all events of the other are in steps of 3."""
    voxels = torch.from_numpy(counts((2, 5, 9, 7))).double()
    voxels[0] = 0
    voxels[1] = (voxels[1] != 0) * 3
    assert not normalize_voxels(voxels).any()
