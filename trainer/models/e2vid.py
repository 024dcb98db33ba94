"""Define E2VID, a recurrent U-Net from voxel grids to pictures (Rebecq et al., CVPR 2019; layers of E2VID+ and V2V).

head      conv5, ReLU                                   5 -> 32
encoder i conv5 stride 2, ReLU, ConvLSTM               32 -> 64 -> 128 -> 256,  1/2, 1/4, 1/8 of the size
residual  two blocks                                  256
decoder j (x + hidden state of encoder 2-j), bilinear upsampling, conv5, ReLU    256 -> 128 -> 64 -> 32
pred      conv1 on (x + head), linear                  32 -> 1

10,710,401 parameters. Attribute names are those of the published state dicts (``unetrecurrent.head.conv2d.weight``).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from trainer.models.blocks import (
    ConvLayer,
    ConvLSTM,
    LSTMState,
    RecurrentLayer,
    ResidualBlock,
    TransposedConvLayer,
    UpsampleConvLayer,
)
from trainer.models.sequence import Guide, Padding, Settings, VoxelNetwork, predict
from v2v_protocol.errors import UsageError

KERNEL_SIZE = 5
PREDICTION = re.compile(r"unetrecurrent\.pred\.conv2d\.(weight|bias)")


class UNetRecurrent(nn.Module):
    """Apply a U-Net with a :class:`ConvLSTM` in every encoder and additive skip connections."""

    def __init__(
        self, bins: int, base_channels: int, encoders: int, residual_blocks: int, *, norm: bool, transposed: bool
    ) -> None:
        super().__init__()
        channels = [base_channels * 2**level for level in range(encoders + 1)]
        self.head = ConvLayer(bins, channels[0], KERNEL_SIZE)
        self.encoders = nn.ModuleList(
            RecurrentLayer(ConvLayer(fine, coarse, KERNEL_SIZE, stride=2, norm=norm), ConvLSTM(coarse))
            for fine, coarse in itertools.pairwise(channels)
        )
        self.resblocks = nn.ModuleList(ResidualBlock(channels[-1], norm=norm) for _ in range(residual_blocks))
        upsample = TransposedConvLayer if transposed else UpsampleConvLayer
        self.decoders: nn.ModuleList = nn.ModuleList(
            upsample(channels[level], channels[level - 1], KERNEL_SIZE, norm=norm) for level in range(encoders, 0, -1)
        )
        self.pred = ConvLayer(channels[0], 1, 1, relu=False, norm=norm)

    def encode(
        self, x: Tensor, states: Sequence[LSTMState | None] | None, steps: int
    ) -> tuple[Tensor, list[Tensor], tuple[LSTMState, ...]]:
        """Run the head, the encoders and the residual blocks.

        Args:
            x: [T*B, bins, H, W].
            states: one per encoder; None after a reset.
            steps: T.

        Returns:
            The output of the residual blocks; the skip connections (head, then the hidden states of the encoders); the
            states after the last step.
        """
        x = self.head(x)
        skips, after = [x], []
        for number, encoder in enumerate(self.encoders):
            x, state = encoder(x, None if states is None else states[number], steps)
            skips.append(x)
            after.append(state)
        for block in self.resblocks:
            x = block(x)
        return x, skips, tuple(after)

    def forward(
        self, x: Tensor, states: Sequence[LSTMState | None] | None, steps: int
    ) -> tuple[Tensor, tuple[LSTMState, ...]]:
        """Map [T*B, bins, H, W] and one state per encoder to [T*B, 1, H, W] and the states after the last step."""
        x, skips, after = self.encode(x, states, steps)
        for decoder in self.decoders:
            x = decoder(x + skips.pop())
        return predict(self.pred, x + skips.pop()), after


class E2VID(VoxelNetwork):
    """Reconstruct pictures with recurrent E2VID.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of the head; each encoder doubles them.
        encoders: number of encoders and decoders.
        residual_blocks: number of residual blocks.
        norm: "none" (E2VID+, V2V), or "batch" as in the first release of E2VID.
        upsampling: "bilinear" (E2VID+, V2V), or "transposed" convolution.
        final_activation: "none" (E2VID+, V2V), or "sigmoid" (first release).
        normalize_voxels: see :func:`trainer.models.sequence.normalize_voxels`; True for the first release.
        padding: see :class:`VoxelNetwork`; "centred" for the first release and E2VID+.

    Raises:
        UsageError: a setting has another value, or a size is too small.
    """

    signature: ClassVar[tuple[str, ...]] = (
        "unetrecurrent.decoders.0.conv2d.weight",
        "unetrecurrent.decoders.0.transposed_conv2d.weight",
    )

    def __init__(
        self,
        *,
        bins: int = 5,
        base_channels: int = 32,
        encoders: int = 3,
        residual_blocks: int = 2,
        norm: Literal["none", "batch"] = "none",
        upsampling: Literal["bilinear", "transposed"] = "bilinear",
        final_activation: Literal["none", "sigmoid"] = "none",
        normalize_voxels: bool = False,
        padding: Padding = "bottom-right",
    ) -> None:
        for name, value, known in (
            ("norm", norm, ("none", "batch")),
            ("upsampling", upsampling, ("bilinear", "transposed")),
            ("final_activation", final_activation, ("none", "sigmoid")),
        ):
            if value not in known:
                raise UsageError(f"E2VID {name} = {value!r}: give one of {', '.join(known)}")
        if min(bins, base_channels, encoders) < 1 or residual_blocks < 0:
            raise UsageError(
                f"E2VID bins = {bins}, base_channels = {base_channels}, encoders = {encoders}, residual_blocks = "
                f"{residual_blocks}: give at least 1 of the first three, and 0 or more residual blocks"
            )
        # V2V pads to 16, although three encoders need only 8: its published results use this padding.
        multiple = max(16, 2**encoders) if padding == "bottom-right" else 2**encoders
        super().__init__(bins=bins, size_multiple=multiple, normalizes=normalize_voxels, padding=padding)
        self.unetrecurrent = UNetRecurrent(
            bins,
            base_channels,
            encoders,
            residual_blocks,
            norm=norm == "batch",
            transposed=upsampling == "transposed",
        )
        self.sigmoid = final_activation == "sigmoid"

    def unroll(
        self, x: Tensor, state: tuple[LSTMState, ...] | None, steps: int, _guide: Guide | None
    ) -> tuple[Tensor, tuple[LSTMState, ...]]:
        """Run the network, see :meth:`VoxelNetwork.unroll`. The state is one :class:`LSTMState` per encoder."""
        pictures, after = self.unetrecurrent(x, state, steps)
        return torch.sigmoid(pictures) if self.sigmoid else pictures, after

    @classmethod
    def own_name(cls, name: str) -> str:
        """Replace E2VID+'s prefix ``unetflow``."""
        return re.sub(r"^unetflow\.", "unetrecurrent.", name)

    @classmethod
    def own_tensor(cls, name: str, tensor: Tensor) -> Tensor:
        """Keep channel 0, the picture, of E2VID+'s prediction layer, [3, ...], which also predicts flow."""
        return tensor[:1].clone() if PREDICTION.fullmatch(name) and len(tensor) == 3 else tensor

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive sizes, norm and upsampling from the tensors, and the first release's sigmoid from the settings.

        Raises:
            UsageError: see :meth:`VoxelNetwork.from_state`.
        """
        for name, built in (("skip_type", "sum"), ("recurrent_block_type", "convlstm")):
            if settings.get(name, built) != built:
                raise UsageError(f"E2VID with {name} = {settings[name]!r} is not implemented, only {built!r}")
        head = state["unetrecurrent.head.conv2d.weight"]
        sigmoid = settings.get("final_activation") == "sigmoid"
        return {
            "bins": head.shape[1],
            "base_channels": head.shape[0],
            "encoders": sum(name.endswith("recurrent_block.Gates.weight") for name in state),
            "residual_blocks": sum(bool(re.fullmatch(r".*resblocks\.\d+\.conv1\.weight", name)) for name in state),
            "norm": "batch" if any(name.endswith("norm_layer.running_mean") for name in state) else "none",
            "upsampling": "transposed" if any("transposed_conv2d" in name for name in state) else "bilinear",
            "final_activation": "sigmoid" if sigmoid else "none",
            "normalize_voxels": bool(settings.get("normalize", sigmoid)),
            "padding": settings.get("padding", "bottom-right"),
        }
