"""Define LPIPS's ImageNet networks up to the last layer that it uses: VGG16, AlexNet, SqueezeNet 1.1.

Layers have the positions of torchvision's ``features``, so that its weight files fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Fire(nn.Module):
    """Apply SqueezeNet's block: 1x1 to few channels, then 1x1 and 3x3 in parallel (Iandola et al. 2016)."""

    def __init__(self, inputs: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block to features [B, C, H, W]."""
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


def _vgg16() -> list[nn.Module]:
    layers: list[nn.Module] = []
    inputs = 3
    for stage, (channels, convolutions) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        if stage:
            layers.append(nn.MaxPool2d(2, 2))
        for _ in range(convolutions):
            layers += [nn.Conv2d(inputs, channels, 3, padding=1), nn.ReLU()]
            inputs = channels
    return layers


def _alexnet() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    ]


def _squeezenet() -> list[nn.Module]:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    return [
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool()),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool()),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool()),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    ]


@dataclass(frozen=True)
class Backbone:
    """Describe a network for which LPIPS has heads.

    Attributes:
        layers: creates the layers, untrained.
        taps: positions of the layers whose output LPIPS compares.
        channels: number of channels at each tap.
        smallest_px: the smallest height and width for which the last layer has an output.
        weights_from: URL of torchvision's weights.
    """

    layers: Callable[[], list[nn.Module]]
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    smallest_px: int
    weights_from: str


BACKBONES = {
    "vgg": Backbone(
        layers=_vgg16,
        taps=(3, 8, 15, 22, 29),
        channels=(64, 128, 256, 512, 512),
        smallest_px=16,
        weights_from="https://download.pytorch.org/models/vgg16-397923af.pth",
    ),
    "alex": Backbone(
        layers=_alexnet,
        taps=(1, 4, 7, 9, 11),
        channels=(64, 192, 384, 256, 256),
        smallest_px=31,
        weights_from="https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    ),
    "squeeze": Backbone(
        layers=_squeezenet,
        taps=(1, 4, 7, 9, 10, 11, 12),
        channels=(64, 128, 256, 384, 384, 512, 512),
        smallest_px=17,
        weights_from="https://download.pytorch.org/models/squeezenet1_1-b8a52dc0.pth",
    ),
}
"""Networks by their names in LPIPS."""
