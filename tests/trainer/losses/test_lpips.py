"""Compare LPIPS with a float64 NumPy network (all three backbones) and with the published package (SqueezeNet)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.trainer.models import numpy_networks as oracle
from trainer.losses.backbones import BACKBONES
from trainer.losses.lpips import LPIPS, SCALE, SHIFT, unit_length
from v2v_protocol.errors import UsageError

SQUEEZE = ("squeezenet1_1_features_torchvision.pth", "lpips_v0.1/squeeze.pth")

PACKAGE = [
    # (first, second, height, width, distance): pictures of `picture`; package lpips 0.1.4, net="squeeze",
    # normalize=True, float32, with the two files above in place of its download.
    (0, 1, 64, 64, 0.3652583),
    (0, 2, 64, 64, 0.4230108),
    (1, 3, 64, 64, 0.0475354),
    (0, 1, 48, 80, 0.3496033),
    (0, 2, 48, 80, 0.4304011),
    (1, 3, 48, 80, 0.0564001),
    (0, 1, 17, 33, 0.2745043),
    (0, 2, 17, 33, 0.3875665),
    (1, 3, 17, 33, 0.0750774),
]


def picture(kind: int, height: int, width: int) -> torch.Tensor:
    """A pattern with all spatial frequencies, of 8 bits: [1, height, width] in 0 .. 1."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = 0.25 * np.sin(0.37 * (kind + 1) * x + 0.11 * y + kind) + 0.25 * np.cos(
        0.05 * (kind + 2) * x * y / width + 0.23 * y
    )
    return torch.tensor(np.round(np.clip(0.5 + waves, 0, 1) * 255) / 255, dtype=torch.float32)[None]


def random_metric(net: str, seed: int = 0) -> tuple[LPIPS, dict[str, np.ndarray], list[np.ndarray]]:
    """Return the metric in float64 with random weights, and the same weights in NumPy."""
    metric = LPIPS(net).double()
    # Constants of float32 turned into float64 would be off by 1e-8.
    metric.shift.copy_(torch.tensor(SHIFT, dtype=torch.float64).view(3, 1, 1))
    metric.scale.copy_(torch.tensor(SCALE, dtype=torch.float64).view(3, 1, 1))
    backbone = oracle.random_weights(metric.features, seed)
    rng = np.random.default_rng(seed + 1)
    heads = [rng.random(channels) for channels in metric.backbone.channels]
    for layer, head in enumerate(heads):
        metric.get_buffer(f"head{layer}").copy_(torch.from_numpy(head))
    return metric, backbone, heads


@pytest.mark.parametrize(("net", "height", "width"), [("vgg", 17, 20), ("alex", 31, 40), ("squeeze", 17, 26)])
def test_equals_the_numpy_network(net: str, height: int, width: int) -> None:
    metric, backbone, heads = random_metric(net)
    first, second = picture(0, height, width).double(), picture(1, height, width).double()
    expected = oracle.lpips(net, first.numpy(), second.numpy(), backbone, heads)
    assert expected > 1e-3
    assert metric(first, second).item() == pytest.approx(expected, rel=1e-10)
    assert metric.float()(first.float(), second.float()).item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("first", "second", "height", "width", "distance"), PACKAGE)
def test_equals_the_published_package(
    published: Path, first: int, second: int, height: int, width: int, distance: float
) -> None:
    metric = LPIPS.from_files("squeeze", *(published / name for name in SQUEEZE))
    result = metric(picture(first, height, width), picture(second, height, width))
    assert result.item() == pytest.approx(distance, abs=2e-6)


@pytest.fixture(scope="module")
def squeeze() -> LPIPS:
    torch.manual_seed(0)
    metric = LPIPS("squeeze")
    for layer in range(7):
        metric.get_buffer(f"head{layer}").fill_(0.5)
    return metric


def test_a_batch_of_clips_is_one_pass_over_its_pictures(squeeze: LPIPS) -> None:
    clips = torch.stack([torch.stack([picture(b * 3 + t, 20, 24) for t in range(3)]) for b in range(2)])
    target = clips.flip(0)
    distances = squeeze(clips, target)
    assert distances.shape == (2, 3)
    for b in range(2):
        for t in range(3):
            assert distances[b, t].item() == pytest.approx(squeeze(clips[b, t], target[b, t]).item(), rel=1e-5)


def test_gradients_reach_the_prediction_only(squeeze: LPIPS) -> None:
    first, second = picture(0, 20, 20).requires_grad_(), picture(1, 20, 20).requires_grad_()
    squeeze(first, second).backward()
    assert first.grad is not None
    assert first.grad.abs().sum() > 0
    assert second.grad is None
    assert all(not parameter.requires_grad and parameter.grad is None for parameter in squeeze.parameters())
    assert not any(buffer.requires_grad for buffer in squeeze.buffers())


def test_dead_features_give_gradient_zero_not_nan() -> None:
    """Where all channels are 0, the published formula gives NaN for every pixel in the receptive field."""
    metric = LPIPS("squeeze")
    for name, parameter in metric.features.named_parameters():
        if name.endswith("bias"):
            parameter.fill_(-100.0)
    for layer in range(7):
        metric.get_buffer(f"head{layer}").fill_(1.0)
    black = torch.zeros(1, 20, 20, requires_grad=True)
    metric(black, picture(0, 20, 20)).backward()
    assert black.grad is not None
    assert torch.equal(black.grad, torch.zeros_like(black))


@pytest.mark.parametrize("length", [0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-4, 1.0, 1e4])
def test_unit_length_has_the_published_values(length: float) -> None:
    features = torch.tensor([0.6, -0.8]).view(1, 2, 1, 1) * length
    exact = np.array([0.6, -0.8]) * length
    expected = exact / (np.sqrt((exact**2).sum()) + 1e-10)
    np.testing.assert_allclose(unit_length(features.double()).flatten().numpy(), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(unit_length(features).flatten().numpy(), expected, rtol=0, atol=1e-6)


def test_autocast_compares_in_float32(squeeze: LPIPS) -> None:
    first, second = picture(0, 32, 32), picture(1, 32, 32)
    exact = squeeze(first, second)
    with torch.autocast("cpu", torch.bfloat16):
        rough = squeeze(first, second)
    assert rough.dtype == torch.float32
    assert rough.item() == pytest.approx(exact.item(), rel=0.05)


@pytest.mark.parametrize("net", sorted(BACKBONES))
def test_the_smallest_picture_is_stated_correctly(net: str) -> None:
    metric = LPIPS(net)
    smallest = BACKBONES[net].smallest_px
    assert metric(torch.rand(1, smallest, smallest), torch.rand(1, smallest, smallest)).isfinite()
    with pytest.raises(UsageError, match=f"at least {smallest}"):
        metric(torch.rand(1, smallest, smallest - 1), torch.rand(1, smallest, smallest - 1))


@pytest.mark.parametrize(("first", "second"), [((1, 20, 20), (2, 1, 20, 20)), ((2, 20, 20), (2, 20, 20))])
def test_wrong_shapes_are_refused(squeeze: LPIPS, first: tuple[int, ...], second: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="equal shapes"):
        squeeze(torch.zeros(first), torch.zeros(second))


def torchvision_like(metric: LPIPS) -> dict[str, torch.Tensor]:
    """Return a complete state dict as torchvision saves it."""
    whole = {f"features.{name}": tensor for name, tensor in metric.features.state_dict().items()}
    return whole | {"classifier.1.weight": torch.zeros(2, 2)}


def heads_file(metric: LPIPS) -> dict[str, torch.Tensor]:
    """Write the heads as LPIPS publishes them."""
    layers = range(len(metric.backbone.channels))
    return {f"lin{layer}.model.1.weight": metric.get_buffer(f"head{layer}")[None, :, None, None] for layer in layers}


@pytest.mark.parametrize(
    ("net", "backbone", "heads", "message"),
    [
        ("resnet", "", "", "vgg, alex, squeeze"),
        ("squeeze", "", "squeeze", r"not downloaded automatically.*pytorch.org/models/squeezenet"),
        ("squeeze", "squeeze", "", r"not downloaded automatically.*lpips/weights/v0.1/squeeze.pth"),
        ("squeeze", "squeeze", "alex", r"of 7 LPIPS weights .*lpips/weights/v0.1/squeeze.pth"),
        ("squeeze", "alex", "squeeze", r"first 0.weight.*pytorch.org/models/squeezenet"),
    ],
)
def test_missing_or_wrong_files_say_where_to_get_them(
    tmp_path: Path, net: str, backbone: str, heads: str, message: str
) -> None:
    if backbone:
        torch.save(torchvision_like(LPIPS(backbone)), tmp_path / "backbone.pth")
    if heads:
        torch.save(heads_file(LPIPS(heads)), tmp_path / "heads.pth")
    with pytest.raises(UsageError, match=message):
        LPIPS.from_files(net, tmp_path / "backbone.pth", tmp_path / "heads.pth")
