"""Define FireNet, a small recurrent network from voxel grids to pictures (Scheerlinck et al., WACV 2020).

conv3 + ReLU -> ConvGRU -> residual block -> ConvGRU -> residual block -> conv1, all at full size with 16 channels:
37,777 parameters. Attribute names are those of the published state dict (``net.head.conv.conv2d.weight`` ...).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from trainer.models.blocks import ConvGRU, ConvLayer, RecurrentLayer, ResidualBlock
from trainer.models.sequence import Guide, Padding, Settings, VoxelNetwork, predict
from v2v_protocol.errors import UsageError

_GREY = 0.5
"""Initial bias of the prediction: the middle of the range of pictures."""

PLUS = {
    "head.conv2d": "net.head.conv.conv2d",
    "G1": "net.head.recurrent_block",
    "R1": "net.resblocks.0.conv",
    "G2": "net.resblocks.0.recurrent_block",
    "R2": "net.resblocks.1",
    "pred.conv2d": "net.pred.conv2d",
}
"""Names of the layers here by their names in FireNet+, which is otherwise FireNet."""


class _FireUNet(nn.Module):
    """Apply the layers, under the names of the published state dict."""

    def __init__(self, bins: int, base_channels: int) -> None:
        super().__init__()
        self.head = RecurrentLayer(ConvLayer(bins, base_channels, 3), ConvGRU(base_channels))
        self.resblocks = nn.ModuleList(
            [RecurrentLayer(ResidualBlock(base_channels), ConvGRU(base_channels)), ResidualBlock(base_channels)]
        )
        self.pred = ConvLayer(base_channels, 1, 1, relu=False)
        nn.init.constant_(self.pred.conv2d.bias, _GREY)  # type: ignore[arg-type]

    def forward(
        self, x: Tensor, states: tuple[Tensor | None, Tensor | None], steps: int
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        x, first = self.head(x, states[0], steps)
        x, second = self.resblocks[0](x, states[1], steps)
        return predict(self.pred, self.resblocks[1](x)), (first, second)


class FireNet(VoxelNetwork):
    """Reconstruct pictures with FireNet.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of every layer.
        normalize_voxels: see :func:`trainer.models.sequence.normalize_voxels`; True for the published FireNet, False
            for FireNet+ and for networks trained on the stream.
        padding: "bottom-right" adds no padding, because the network takes all sizes. "centred" pads to multiples of 16,
            as the code of the first published FireNet does.

    Raises:
        UsageError: ``bins`` or ``base_channels`` is below 1.
    """

    signature = ("net.head.recurrent_block.reset_gate.weight",)

    def __init__(
        self,
        *,
        bins: int = 5,
        base_channels: int = 16,
        normalize_voxels: bool = False,
        padding: Padding = "bottom-right",
    ) -> None:
        if min(bins, base_channels) < 1:
            raise UsageError(f"FireNet bins = {bins}, base_channels = {base_channels}: give 1 or more")
        multiple = 1 if padding == "bottom-right" else 16
        super().__init__(bins=bins, size_multiple=multiple, normalizes=normalize_voxels, padding=padding)
        self.net = _FireUNet(bins, base_channels)

    def unroll(
        self, x: Tensor, state: tuple[Tensor, Tensor] | None, steps: int, _guide: Guide | None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Run the network, see :meth:`VoxelNetwork.unroll`. The state is two hidden states [B, 16, H, W]."""
        pictures, after = self.net(x, (None, None) if state is None else state, steps)
        return pictures, after

    @classmethod
    def own_name(cls, name: str) -> str:
        """Replace the layer names of FireNet+, see :data:`PLUS`."""
        layer = next((layer for layer in PLUS if name.startswith(f"{layer}.")), None)
        return name if layer is None else PLUS[layer] + name.removeprefix(layer)

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive the sizes from the tensors. The first FireNet's file states that it normalises its input."""
        base_channels, bins = state["net.head.conv.conv2d.weight"].shape[:2]
        first = bool(settings.get("normalize", False))
        padding = "centred" if first else "bottom-right"
        return {"bins": bins, "base_channels": base_channels, "normalize_voxels": first, "padding": padding}
