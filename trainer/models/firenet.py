"""FireNet: a small recurrent network from voxel grids to pictures (Scheerlinck et al., WACV 2020).

conv3 + ReLU -> ConvGRU -> residual block -> ConvGRU -> residual block -> conv1, all at full size with 16 channels:
37,777 parameters. Attribute names are those of the published state dict (``net.head.conv.conv2d.weight`` ...).
"""

from __future__ import annotations

from torch import Tensor, nn

from trainer.models.blocks import ConvGRU, ConvLayer, RecurrentLayer, ResidualBlock
from trainer.models.sequence import ReconstructionNetwork, predict
from v2v_protocol.errors import UsageError

GREY = 0.5
"""What an untrained network predicts on average: the middle of the range of pictures."""


class _FireUNet(nn.Module):
    """The layers, under the names of the published state dict."""

    def __init__(self, bins: int, base_channels: int) -> None:
        super().__init__()
        self.head = RecurrentLayer(ConvLayer(bins, base_channels, 3), ConvGRU(base_channels))
        self.resblocks = nn.ModuleList(
            [RecurrentLayer(ResidualBlock(base_channels), ConvGRU(base_channels)), ResidualBlock(base_channels)]
        )
        self.pred = ConvLayer(base_channels, 1, 1, relu=False)
        nn.init.constant_(self.pred.conv2d.bias, GREY)  # type: ignore[arg-type]

    def forward(
        self, x: Tensor, states: tuple[Tensor | None, Tensor | None], steps: int
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        x, first = self.head(x, states[0], steps)
        x, second = self.resblocks[0](x, states[1], steps)
        return predict(self.pred, self.resblocks[1](x)), (first, second)


class FireNet(ReconstructionNetwork):
    """FireNet.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of every layer.
        normalize_voxels: see :func:`trainer.models.sequence.normalize_voxels`; True for the published FireNet, False
            for FireNet+ and for networks trained on the stream.

    Raises:
        UsageError: ``bins`` or ``base_channels`` below 1.
    """

    def __init__(self, *, bins: int = 5, base_channels: int = 16, normalize_voxels: bool = False) -> None:
        if min(bins, base_channels) < 1:
            raise UsageError(f"FireNet bins = {bins}, base_channels = {base_channels}: give 1 or more")
        super().__init__(bins=bins, size_multiple=1, normalizes=normalize_voxels)
        self.net = _FireUNet(bins, base_channels)

    def unroll(
        self, x: Tensor, state: tuple[Tensor, Tensor] | None, steps: int
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """See :meth:`ReconstructionNetwork.unroll`; two hidden states [B, 16, H, W]."""
        pictures, after = self.net(x, (None, None) if state is None else state, steps)
        return pictures, after
