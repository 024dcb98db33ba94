"""Define EVFlowNet, a U-Net from one voxel grid to optical flow (Zhu et al., RSS 2018; layers of EvFlow+ and V2V).

encoder i conv3 stride 2, ReLU                          5 -> 64 -> 128 -> 256 -> 512,  1/2 ... 1/16 of the size
residual  two blocks                                  512
decoder j (x concatenated with encoder 3-j), bilinear upsampling, conv3, ReLU
                                                     1024 -> 256, 512 -> 128, 256 -> 64, 128 -> 32
pred      conv1, linear                                32 -> 2: px in (x, y) over the voxel grid

14,125,346 parameters, no memory: all grids of a sequence are one batch. Attribute names are those of the published
state dicts (``unet.encoders.0.conv2d.weight``).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from trainer.models.blocks import ConvLayer, ResidualBlock, UpsampleConvLayer
from trainer.models.sequence import Guide, Padding, Settings, VoxelNetwork, predict

_LEVELS = 4


class _UNet(nn.Module):
    """Apply a U-Net whose skip connections concatenate channels."""

    def __init__(self, bins: int, base_channels: int) -> None:
        super().__init__()
        widths = [base_channels * 2**level for level in range(_LEVELS + 1)]
        self.encoders = nn.ModuleList(
            ConvLayer(fine, coarse, 3, stride=2) for fine, coarse in itertools.pairwise([bins, *widths[1:]])
        )
        self.resblocks = nn.ModuleList(ResidualBlock(widths[-1]) for _ in range(2))
        self.decoders = nn.ModuleList(
            UpsampleConvLayer(2 * coarse, fine, 3) for coarse, fine in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.pred = ConvLayer(base_channels, 2, 1, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        skips = []
        for encoder in self.encoders:
            x = encoder(x)
            skips.append(x)
        for block in self.resblocks:
            x = block(x)
        for decoder in self.decoders:
            x = decoder(torch.cat([x, skips.pop()], dim=1))
        return predict(self.pred, x)


class EVFlowNet(VoxelNetwork):
    """Estimate flow with EVFlowNet, with one output at full size.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of the last decoder; encoder i has 2^(i+1) times as many.
        normalize_voxels, padding: see :class:`VoxelNetwork`.
    """

    task = "flow"
    signature = ("unet.encoders.0.conv2d.weight",)

    def __init__(
        self,
        *,
        bins: int = 5,
        base_channels: int = 32,
        normalize_voxels: bool = False,
        padding: Padding = "bottom-right",
    ) -> None:
        super().__init__(bins=bins, size_multiple=2**_LEVELS, normalizes=normalize_voxels, padding=padding)
        self.unet = _UNet(bins, base_channels)

    def unroll(self, x: Tensor, _state: Any, _steps: int, _guide: Guide | None) -> tuple[Tensor, tuple[()]]:
        """Run the network, see :meth:`VoxelNetwork.unroll`. The state only marks that the sequence has begun."""
        return self.unet(x), ()

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive the sizes from the tensors."""
        return {
            "bins": state["unet.encoders.0.conv2d.weight"].shape[1],
            "base_channels": state["unet.pred.conv2d.weight"].shape[1],
            "normalize_voxels": bool(settings.get("normalize", False)),
            "padding": settings.get("padding", "bottom-right"),
        }
