"""Define ET-Net: E2VID's encoders, then transformers over all positions of the picture (Weng et al., ICCV 2021).

head, encoders   as E2VID                                5 -> 32 -> 64 -> 128 -> 256
tokens           the encoders' outputs at 1/8 of the size with 256 channels: scale 0 is encoder 2, scale 1 is encoder 1
                 through conv2 stride 2, scale 2 is encoder 0 through conv4 stride 4; one token per position
transformers     encoder s on scale s, with position embedding; decoder 0 attends from scale 0 to itself, decoder 1 from
                 scale 1 to scale 0, decoder 2 from scale 2 to scale 1; the mean of all six outputs goes on
decoders, pred   as E2VID, then a sigmoid

22,175,361 parameters. Attribute names are those of the published state dicts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from trainer.models.blocks import ConvLayer, ConvLSTM, LSTMState, RecurrentLayer, UpsampleConvLayer
from trainer.models.sequence import Guide, Padding, Settings, VoxelNetwork, predict
from v2v_protocol.errors import UsageError

HEADS = 8
ENCODER_LAYERS = 3
DECODER_LAYERS = 2
DROPOUT = 0.1
POSITIONS = 20_000
"""Rows of V2V's table of positions. The original's has 8000 rows and is not stored in its files."""


class _Layer(nn.Module):
    """Apply a pre-norm transformer layer to tokens [L, B, C]. With ``cross`` it also attends to a memory."""

    def __init__(self, channels: int, *, cross: bool) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(channels, HEADS, dropout=DROPOUT)
        self.norm1 = nn.LayerNorm(channels)
        if cross:
            self.cross_attn = nn.MultiheadAttention(channels, HEADS, dropout=DROPOUT)
            self.norm21 = nn.LayerNorm(channels)
            self.norm22 = nn.LayerNorm(channels)
            self.norm3 = nn.LayerNorm(channels)
        else:
            self.norm2 = nn.LayerNorm(channels)
        self.linear1 = nn.Linear(channels, 4 * channels)
        self.linear2 = nn.Linear(4 * channels, channels)
        self.dropout = nn.Dropout(DROPOUT)

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor:
        own = self.norm1(x)
        x = x + self.dropout(self.self_attn(own, own, own, need_weights=False)[0])
        if memory is not None:
            other = self.norm22(memory)
            x = x + self.dropout(self.cross_attn(self.norm21(x), other, other, need_weights=False)[0])
        normed = self.norm2(x) if memory is None else self.norm3(x)
        result: Tensor = x + self.dropout(self.linear2(self.dropout(self.linear1(normed).relu())))
        return result


class _Layers(nn.Module):
    def __init__(self, channels: int, count: int, *, cross: bool) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(channels, cross=cross) for _ in range(count))

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor:
        for layer in self.layers:
            x = layer(x, memory)
        return x


class _Transformer(nn.Module):
    """Apply the layers, under their names in the state dicts. Matrices are initialised by Glorot's rule."""

    def __init__(self, channels: int, *, decodes: bool) -> None:
        super().__init__()
        layers = _Layers(channels, DECODER_LAYERS if decodes else ENCODER_LAYERS, cross=decodes)
        self.add_module("decoder" if decodes else "encoder", layers)
        for parameter in self.parameters():
            if parameter.ndim > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, *tokens: Tensor) -> Tensor:
        (layers,) = self.children()
        result: Tensor = layers(*tokens)
        return result


class _Positions(nn.Module):
    """Hold sin and cos of the position in raster order, [1, positions, C] (Vaswani et al. 2017)."""

    pos_table: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        place, channel = torch.arange(POSITIONS, dtype=torch.float64)[:, None], torch.arange(channels)
        angle = place / 10_000 ** (2 * (channel // 2).double() / channels)
        self.register_buffer("pos_table", torch.where(channel % 2 == 0, angle.sin(), angle.cos()).float()[None])


class ETNet(VoxelNetwork):
    """Reconstruct pictures with ET-Net.

    Args:
        bins: bins of a voxel grid.
        base_channels: channels of the head; each of three encoders doubles them.
        normalize_voxels, padding: see :class:`VoxelNetwork`.
    """

    signature = ("trans_encoder0.encoder.layers.0.self_attn.in_proj_weight",)
    computed = ("position_embedding.pos_table",)

    def __init__(
        self,
        *,
        bins: int = 5,
        base_channels: int = 32,
        normalize_voxels: bool = False,
        padding: Padding = "bottom-right",
    ) -> None:
        multiple = 16 if padding == "bottom-right" else 8
        super().__init__(bins=bins, size_multiple=multiple, normalizes=normalize_voxels, padding=padding)
        c0, c1, c2, c3 = (base_channels * 2**level for level in range(4))
        self.head = ConvLayer(bins, c0, 5)
        self.DownsampleConv = nn.ModuleList(
            RecurrentLayer(ConvLayer(fine, coarse, 5, stride=2), ConvLSTM(coarse))
            for fine, coarse in ((c0, c1), (c1, c2), (c2, c3))
        )
        self.position_embedding = _Positions(c3)
        self.split1 = nn.Conv2d(c2, c3, 2, stride=2)
        self.split2 = nn.Conv2d(c1, c3, 4, stride=4)
        for scale in range(3):
            self.add_module(f"trans_encoder{scale}", _Transformer(c3, decodes=False))
            self.add_module(f"trans_decoder{scale}", _Transformer(c3, decodes=True))
        self.UpsampleConv = nn.ModuleList(UpsampleConvLayer(a, b, 5) for a, b in ((c3, c2), (c2, c1), (c1, c0)))
        self.pred = ConvLayer(c0, 1, 1, relu=False)

    def unroll(
        self, x: Tensor, state: tuple[LSTMState, ...] | None, steps: int, _guide: Guide | None
    ) -> tuple[Tensor, tuple[LSTMState, ...]]:
        """Run the network, see :meth:`VoxelNetwork.unroll`.

        The state is one :class:`LSTMState` per encoder. Transformers have no memory.
        """
        head = x = self.head(x)
        skips, after = [], []
        for number, encoder in enumerate(self.DownsampleConv):
            x, memory = encoder(x, None if state is None else state[number], steps)
            skips.append(x)
            after.append(memory)
        x = self._attend(skips)
        for decoder in self.UpsampleConv:
            x = decoder(x + skips.pop())
        return predict(self.pred, x + head).sigmoid(), tuple(after)

    def _attend(self, skips: list[Tensor]) -> Tensor:
        """Apply the transformers to the encoders' outputs and return [N, C, H / 8, W / 8]."""
        fine, middle, coarse = skips
        shape = coarse.shape[2:]
        places = shape[0] * shape[1]
        if places > POSITIONS:
            raise UsageError(
                f"the picture has {places} positions of 8 x 8 px, and ETNet at most {POSITIONS}: give a smaller picture"
            )
        position = self.position_embedding.pos_table[:, :places].transpose(0, 1)
        scales = (coarse, self.split1(middle), self.split2(fine))
        tokens = [scale.flatten(2).permute(2, 0, 1) + position for scale in scales]  # [places, N, C]
        encoded = [self.get_submodule(f"trans_encoder{scale}")(x) for scale, x in enumerate(tokens)]
        memories = (encoded[0], encoded[0], encoded[1])
        decoded = [
            self.get_submodule(f"trans_decoder{scale}")(x, memory)
            for scale, (x, memory) in enumerate(zip(encoded, memories, strict=True))
        ]
        mean = torch.stack([*encoded, *decoded]).mean(dim=0)
        return torch.unflatten(mean.permute(1, 2, 0), 2, shape)

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], settings: Settings) -> dict[str, Any]:
        """Derive the sizes from the tensors."""
        channels, bins = state["head.conv2d.weight"].shape[:2]
        return {
            "bins": bins,
            "base_channels": channels,
            "normalize_voxels": bool(settings.get("normalize", False)),
            "padding": settings.get("padding", "bottom-right"),
        }
