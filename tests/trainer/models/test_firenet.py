"""Compare FireNet with a float64 NumPy network, and test its published weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from trainer.models import FireNet
from trainer.weights import load_into
from v2v_protocol.errors import UsageError


def normalized(voxel: np.ndarray) -> np.ndarray:
    """Non-zero values to mean 0 and standard deviation 1."""
    values = voxel[voxel != 0]
    return np.where(voxel != 0, (voxel - values.mean()) / values.std(), 0)


@pytest.mark.parametrize("normalizes", [False, True])
def test_equals_the_numpy_network(normalizes: bool) -> None:
    model = FireNet(normalize_voxels=normalizes)
    weights = oracle.random_weights(model, seed=2)
    rng = np.random.default_rng(0)
    voxels = (rng.integers(-3, 4, (2, 4, 5, 11, 14)) * (rng.random((2, 4, 5, 11, 14)) < 0.3)).astype(np.int8)
    clips = voxels.astype(np.float64)
    if normalizes:
        clips = np.stack([[normalized(voxel) for voxel in clip] for clip in clips])
    expected = np.stack([oracle.firenet(clip, weights) for clip in clips])
    assert expected.std() > 0.1
    with torch.no_grad():
        pictures = model.forward_sequence(torch.from_numpy(voxels))
        np.testing.assert_allclose(pictures.numpy(), expected, rtol=0, atol=1e-12)
        pictures = model.float().to(memory_format=torch.channels_last).forward_sequence(torch.from_numpy(voxels))
        np.testing.assert_allclose(pictures.numpy(), expected, rtol=0, atol=1e-5)


def test_an_untrained_network_predicts_grey() -> None:
    torch.manual_seed(0)
    pictures = FireNet().forward_sequence(torch.zeros(1, 2, 5, 8, 8))
    assert abs(pictures.mean() - 0.5) < 0.2


@pytest.mark.parametrize("name", ["firenet_evreal.pth", "firenet_plus_state_dict.pth"])
def test_published_weights_load_strictly_and_follow_an_edge(published: Path, name: str) -> None:
    """A bright bar moves right: the reconstruction is brighter at the bar than behind and ahead of it."""
    model = FireNet(normalize_voxels=name == "firenet_evreal.pth")
    report = load_into(model, published / name)
    assert len(report.used) == len(model.state_dict()) == 24
    assert report.unused == report.missing == report.misshaped == ()
    voxels = torch.zeros(1, 20, 5, 32, 64)
    for step in range(20):
        for position in range(5):
            front = (5 * step + position) // 2
            voxels[0, step, position, :, front] = 2
            if front >= 16:
                voxels[0, step, position, :, front - 16] = -2
    with torch.no_grad():
        picture = model.forward_sequence(voxels)[0, -1, 0, 8:24]
    bar = picture[:, 36:46].mean()
    assert bar > picture[:, 4:28].mean() + 0.1
    assert bar > picture[:, 54:62].mean() + 0.03


@pytest.mark.parametrize("options", [{"bins": 0}, {"base_channels": 0}])
def test_sizes_below_one_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(UsageError, match="give 1 or more"):
        FireNet(**options)  # type: ignore[arg-type]
