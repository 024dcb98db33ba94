"""E2VID: a recurrent U-Net from voxel grids to pictures (Rebecq et al., CVPR 2019; layers as in E2VID+ and V2V).

head      conv5, ReLU                                   5 -> 32
encoder i conv5 stride 2, ReLU, ConvLSTM               32 -> 64 -> 128 -> 256,  1/2, 1/4, 1/8 of the size
residual  two blocks                                  256
decoder j (x + hidden state of encoder 2-j), bilinear upsampling, conv5, ReLU    256 -> 128 -> 64 -> 32
pred      conv1 on (x + head), linear                  32 -> 1

10,710,401 parameters. Attribute names are those of the published state dicts (``unetrecurrent.head.conv2d.weight``).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

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
from trainer.models.sequence import ReconstructionNetwork, predict
from v2v_protocol.errors import UsageError

KERNEL_SIZE = 5


class UNetRecurrent(nn.Module):
    """U-Net with a :class:`ConvLSTM` in every encoder and skip connections that add."""

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
        self.decoders = nn.ModuleList(
            upsample(channels[level], channels[level - 1], KERNEL_SIZE, norm=norm) for level in range(encoders, 0, -1)
        )
        self.pred = ConvLayer(channels[0], 1, 1, relu=False, norm=norm)

    def forward(
        self, x: Tensor, states: Sequence[LSTMState | None], steps: int
    ) -> tuple[Tensor, tuple[LSTMState, ...]]:
        """[T*B, bins, H, W] and one state per encoder -> [T*B, 1, H, W] and the states after the last step."""
        head = self.head(x)
        x, skips, after = head, [], []
        for encoder, state in zip(self.encoders, states, strict=True):
            x, state = encoder(x, state, steps)
            skips.append(x)
            after.append(state)
        for block in self.resblocks:
            x = block(x)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decoder(x + skip)
        return predict(self.pred, x + head), tuple(after)


class E2VID(ReconstructionNetwork):
    """Recurrent E2VID.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of the head; each encoder doubles them.
        encoders: number of encoders and decoders.
        residual_blocks: number of residual blocks.
        norm: "none" (E2VID+, V2V), or "batch" as in the first release of E2VID.
        upsampling: "bilinear" (E2VID+, V2V), or "transposed" convolution.
        final_activation: "none" (E2VID+, V2V), or "sigmoid" (first release).
        normalize_voxels: see :func:`trainer.models.sequence.normalize_voxels`; True for the first release.

    Raises:
        UsageError: a setting that is none of these.
    """

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
    ) -> None:
        for name, value, known in (
            ("norm", norm, ("none", "batch")),
            ("upsampling", upsampling, ("bilinear", "transposed")),
            ("final_activation", final_activation, ("none", "sigmoid")),
        ):
            if value not in known:
                raise UsageError(f"E2VID {name} = {value!r}: give one of {', '.join(known)}")
        if min(bins, base_channels, encoders) < 1 or residual_blocks < 0:
            raise UsageError("E2VID bins, base_channels and encoders are at least 1, residual_blocks at least 0")
        # 16 as in V2V, although three encoders ask for 8 only: published figures were made with this padding.
        super().__init__(bins=bins, size_multiple=max(16, 2**encoders), normalizes=normalize_voxels)
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
        self, x: Tensor, state: tuple[LSTMState, ...] | None, steps: int
    ) -> tuple[Tensor, tuple[LSTMState, ...]]:
        """See :meth:`ReconstructionNetwork.unroll`; one :class:`LSTMState` per encoder."""
        states = [None] * len(self.unetrecurrent.encoders) if state is None else state
        pictures, after = self.unetrecurrent(x, states, steps)
        return torch.sigmoid(pictures) if self.sigmoid else pictures, after
