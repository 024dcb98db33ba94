"""Define RAFT, small and large.

Source: Teed and Deng, "RAFT: Recurrent All-Pairs Field Transforms for Optical Flow", ECCV 2020.

Both encoders compute features at an eighth of the picture's size. The correlation of every pixel of one picture with
every pixel of the other forms a pyramid. Twelve times, a recurrent unit looks it up around the target of the current
flow and updates the flow. Parameters have torchvision's names, so that its weight files load unchanged;
:func:`torchvision_name` translates those of the authors' repository.

    size   features  context       correlation radius   recurrent unit            upsampling
    small  128       96 + 64       3                    3 x 3                     bilinear
    large  256       128 + 128     4                    1 x 5, then 5 x 1         learned convex combination
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from trainer.models.blocks import Loop

DOWNSCALE = 8
LEVELS = 4
SMALLEST_SIDE_PX = DOWNSCALE * 2**LEVELS
"""The coarsest correlation needs at least 2 x 2 pixels."""


@dataclass(frozen=True, slots=True)
class Size:
    """Hold the layer sizes of one variant, in channels."""

    features: tuple[int, int, int, int, int]
    context: int
    hidden: int
    bottleneck: bool
    radius: int
    correlation: tuple[int, ...]
    motion: tuple[int, int]
    motion_out: int
    kernels: tuple[tuple[int, int], ...]
    head: int
    learned_upsampling: bool


RAFT_SIZES = {
    "small": Size(
        features=(32, 32, 64, 96, 128), context=160, hidden=96, bottleneck=True, radius=3, correlation=(96,),
        motion=(64, 32), motion_out=82, kernels=((3, 3),), head=128, learned_upsampling=False,
    ),
    "large": Size(
        features=(64, 64, 96, 128, 256), context=256, hidden=128, bottleneck=False, radius=4, correlation=(256, 192),
        motion=(128, 64), motion_out=128, kernels=((1, 5), (5, 1)), head=256, learned_upsampling=True,
    ),
}  # fmt: skip


def _convolution(
    inputs: int, outputs: int, kernel: int, stride: int = 1, norm: str = "", relu: bool = True
) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2)]
    if norm == "instance":
        layers.append(nn.InstanceNorm2d(outputs))
    elif norm == "batch":
        layers.append(nn.BatchNorm2d(outputs))
    if relu:
        layers.append(nn.ReLU())
    return nn.Sequential(*layers)


class _Block(nn.Module):
    """Apply a residual block: two 3 x 3 convolutions, or (bottleneck) 1 x 1, 3 x 3, 1 x 1 on C / 4."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: str, bottleneck: bool) -> None:
        super().__init__()
        if bottleneck:
            self.convnormrelu1 = _convolution(inputs, outputs // 4, 1, norm=norm)
            self.convnormrelu2 = _convolution(outputs // 4, outputs // 4, 3, stride, norm)
            self.convnormrelu3: nn.Module = _convolution(outputs // 4, outputs, 1, norm=norm)
        else:
            self.convnormrelu1 = _convolution(inputs, outputs, 3, stride, norm)
            self.convnormrelu2 = _convolution(outputs, outputs, 3, norm=norm)
            self.convnormrelu3 = nn.Identity()
        self.downsample: nn.Module = nn.Identity()
        if stride > 1:
            self.downsample = _convolution(inputs, outputs, 1, stride, norm, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        y = self.convnormrelu3(self.convnormrelu2(self.convnormrelu1(x)))
        return functional.relu(self.downsample(x) + y)


class _Encoder(nn.Module):
    """Map [N, inputs, H, W] to [N, outputs, H / 8, W / 8]."""

    def __init__(self, size: Size, inputs: int, outputs: int, norm: str) -> None:
        super().__init__()
        first, *rest, _ = size.features
        self.convnormrelu = _convolution(inputs, first, 7, 2, norm)
        for number, (inputs, width, stride) in enumerate(zip(size.features, rest, (1, 2, 2), strict=False), start=1):
            blocks = nn.Sequential(
                _Block(inputs, width, stride, norm, size.bottleneck), _Block(width, width, 1, norm, size.bottleneck)
            )
            self.add_module(f"layer{number}", blocks)
        self.conv = nn.Conv2d(rest[-1], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.children():
            x = layer(x)
        return x


class _MotionEncoder(nn.Module):
    def __init__(self, size: Size) -> None:
        super().__init__()
        self.convcorr1 = _convolution(LEVELS * (2 * size.radius + 1) ** 2, size.correlation[0], 1)
        self.convcorr2 = _convolution(*size.correlation, 3) if len(size.correlation) == 2 else nn.Identity()
        self.convflow1 = _convolution(2, size.motion[0], 7)
        self.convflow2 = _convolution(*size.motion, 3)
        self.conv = _convolution(size.correlation[-1] + size.motion[-1], size.motion_out - 2, 3)

    def forward(self, flow: Tensor, correlation: Tensor) -> Tensor:
        both = torch.cat([self.convcorr2(self.convcorr1(correlation)), self.convflow2(self.convflow1(flow))], dim=1)
        return torch.cat([self.conv(both), flow], dim=1)


class _ConvGRU(nn.Module):
    def __init__(self, inputs: int, hidden: int, kernel: tuple[int, int]) -> None:
        super().__init__()
        padding = (kernel[0] // 2, kernel[1] // 2)
        self.convz = nn.Conv2d(hidden + inputs, hidden, kernel, padding=padding)
        self.convr = nn.Conv2d(hidden + inputs, hidden, kernel, padding=padding)
        self.convq = nn.Conv2d(hidden + inputs, hidden, kernel, padding=padding)

    def forward(self, hidden: Tensor, x: Tensor) -> Tensor:
        both = torch.cat([hidden, x], dim=1)
        update, reset = torch.sigmoid(self.convz(both)), torch.sigmoid(self.convr(both))
        candidate = torch.tanh(self.convq(torch.cat([reset * hidden, x], dim=1)))
        return (1 - update) * hidden + update * candidate


class _RecurrentBlock(nn.Module):
    def __init__(self, inputs: int, size: Size) -> None:
        super().__init__()
        for number, kernel in enumerate(size.kernels, start=1):
            self.add_module(f"convgru{number}", _ConvGRU(inputs, size.hidden, kernel))

    def forward(self, hidden: Tensor, x: Tensor) -> Tensor:
        for unit in self.children():
            hidden = unit(hidden, x)
        return hidden


class _FlowHead(nn.Module):
    def __init__(self, size: Size) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(size.hidden, size.head, 3, padding=1)
        self.conv2 = nn.Conv2d(size.head, 2, 3, padding=1)

    def forward(self, hidden: Tensor) -> Tensor:
        correction: Tensor = self.conv2(functional.relu(self.conv1(hidden)))
        return correction


class _UpdateBlock(nn.Module):
    def __init__(self, size: Size) -> None:
        super().__init__()
        self.motion_encoder = _MotionEncoder(size)
        self.recurrent_block = _RecurrentBlock(size.motion_out + size.context - size.hidden, size)
        self.flow_head = _FlowHead(size)

    def forward(self, hidden: Tensor, context: Tensor, correlation: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.recurrent_block(hidden, torch.cat([context, self.motion_encoder(flow, correlation)], dim=1))
        return hidden, self.flow_head(hidden)


class _MaskPredictor(nn.Module):
    """Predict weights of the 3 x 3 coarse neighbours for each of the 8 x 8 fine pixels of a coarse pixel."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.convrelu = _convolution(hidden, 256, 3)
        self.conv = nn.Conv2d(256, 9 * DOWNSCALE**2, 1)

    def forward(self, hidden: Tensor) -> Tensor:
        # The factor 0.25 balances gradients in training; the weights were trained with it.
        weights: Tensor = 0.25 * self.conv(self.convrelu(hidden))
        return weights


class RAFT(Loop, nn.Module):
    """Estimate the flow between two pictures.

    Args:
        size: "small" (990,162 parameters) or "large" (5,257,536).
        inputs: channels of a picture.
    """

    def __init__(self, size: str, inputs: int = 3) -> None:
        super().__init__()
        self.size = RAFT_SIZES[size]
        self.feature_encoder = _Encoder(self.size, inputs, self.size.features[-1], "instance")
        self.context_encoder = _Encoder(self.size, inputs, self.size.context, "batch" if size == "large" else "")
        self.update_block = _UpdateBlock(self.size)
        self.mask_predictor = _MaskPredictor(self.size.hidden) if self.size.learned_upsampling else None

    def forward(self, first: Tensor, second: Tensor, updates: int = 12) -> Tensor:
        """Return the flow from ``first`` to ``second``.

        Args:
            first, second: [N, inputs, H, W], pictures in -1 .. 1; H and W multiples of 8, at least 128.
            updates: number of updates of the flow.

        Returns:
            [N, 2, H, W] float32, (x, y), px, after the last update.
        """
        features = self.features(torch.cat([first, second])).chunk(2)
        *_, (flow, hidden) = self.refine(correlation_pyramid(*features), *self.context(first), updates)
        return self.upsample(flow, hidden)

    def features(self, pictures: Tensor) -> Tensor:
        """Compute the features to correlate: [N, inputs, H, W] -> [N, C, H / 8, W / 8], float32 or wider."""
        found: Tensor = self.feature_encoder(pictures)
        return found.to(torch.promote_types(found.dtype, torch.float32))

    def context(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Return the initial hidden state and the context, an input of every update, both [N, C, H / 8, W / 8]."""
        split = [self.size.hidden, self.size.context - self.size.hidden]
        hidden, context = self.context_encoder(picture).split(split, dim=1)
        return torch.tanh(hidden), functional.relu(context)

    def refine(
        self, pyramid: list[Tensor], hidden: Tensor, context: Tensor, updates: int, flow: Tensor | None = None
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the flow at an eighth of the size and the hidden state, after each update.

        Args:
            pyramid: from :func:`correlation_pyramid`.
            hidden, context: from :meth:`context`.
            updates: number of updates.
            flow: initial flow [N, 2, H / 8, W / 8], px of that size; None starts from zero.
        """
        count, _, height, width = hidden.shape
        grid = _grid(height, width, pyramid[0]).expand(count, 2, height, width)
        flow = torch.zeros_like(grid) if flow is None else flow
        for _ in range(updates):
            flow, hidden = self.turn(
                pyramid, grid, context, hidden, flow.detach()
            )  # no gradient through earlier updates
            yield flow, hidden

    def _turn(
        self, pyramid: list[Tensor], grid: Tensor, context: Tensor, hidden: Tensor, flow: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Update the flow once."""
        correlation = look_up(pyramid, grid + flow, self.size.radius)
        hidden, correction = self.update_block(hidden, context, correlation, flow)
        return flow + correction.to(flow.dtype), hidden

    def upsample(self, flow: Tensor, hidden: Tensor) -> Tensor:
        """Return the flow of :meth:`refine` at full size, [N, 2, H, W], px."""
        if self.mask_predictor is None:
            shape = [DOWNSCALE * side for side in flow.shape[2:]]
            return DOWNSCALE * functional.interpolate(flow, shape, mode="bilinear", align_corners=True)
        return convex_upsampling(flow, self.mask_predictor(hidden).to(flow.dtype))


def correlation_pyramid(first: Tensor, second: Tensor) -> list[Tensor]:
    """Correlate all pairs of pixels, with the second picture averaged over 1, 2, 4 and 8 pixels.

    Args:
        first, second: features [N, C, h, w].

    Returns:
        LEVELS tensors [N h w, 1, h / 2^l, w / 2^l].
    """
    count, channels, height, width = first.shape
    # Sums of up to 256 products exceed the 8 bits of precision of bfloat16.
    with torch.autocast(first.device.type, enabled=False):
        product = torch.matmul(first.flatten(2).transpose(1, 2), second.flatten(2)) / channels**0.5
    pyramid = [product.reshape(count * height * width, 1, height, width)]
    for _ in range(LEVELS - 1):
        pyramid.append(functional.avg_pool2d(pyramid[-1], 2))
    return pyramid


def look_up(pyramid: list[Tensor], centre: Tensor, radius: int) -> Tensor:
    """Sample, for each pixel of the first picture, the correlations around a position of the second.

    Sampling is bilinear, and zero outside the picture.

    Args:
        pyramid: from :func:`correlation_pyramid`.
        centre: [N, 2, h, w] (x, y), pixels of the finest level.
        radius: neighbours in each direction, in pixels of each level.

    Returns:
        [N, LEVELS (2 radius + 1)^2, h, w]. As in the published networks, the y offset varies fastest.
    """
    count, _, height, width = centre.shape
    steps = torch.arange(-radius, radius + 1, dtype=centre.dtype, device=centre.device)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1)
    centre = centre.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2)
    found = []
    for level, plane in enumerate(pyramid):
        # align_corners=False, where -1 and 1 are the outer edges, because a plane may be one pixel wide.
        x, y = (centre / 2**level + offsets).unbind(-1)
        where = torch.stack([(2 * x + 1) / plane.shape[-1] - 1, (2 * y + 1) / plane.shape[-2] - 1], dim=-1)
        found.append(functional.grid_sample(plane, where, align_corners=False).reshape(count, height, width, -1))
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2).contiguous()


def _grid(height: int, width: int, like: Tensor) -> Tensor:
    """Return (x, y) of every pixel, [2, height, width]."""
    rows, columns = (torch.arange(side, dtype=like.dtype, device=like.device) for side in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x, y])


def forward_splat(flow: Tensor) -> Tensor:
    """Propagate flow along itself: predict the next step's flow under constant motion.

    Every vector is added at its target, to the four surrounding pixels with bilinear weights. A pixel takes
    the weighted mean of the vectors that reach it, or 0 without any.

    Args:
        flow: [N, 2, H, W] (x, y), px.
    """
    count, _, height, width = flow.shape
    x, y = (_grid(height, width, flow) + flow).unbind(1)
    left, top = x.floor(), y.floor()
    sums = flow.new_zeros(count, 3, height * width)
    for column, row in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        weight = torch.where(inside, (1 - (x - column).abs()) * (1 - (y - row).abs()), 0.0)
        place = row.clamp(0, height - 1).long() * width + column.clamp(0, width - 1).long()
        laid = torch.cat([flow * weight[:, None], weight[:, None]], dim=1).flatten(2)
        sums.scatter_add_(2, place.flatten(1)[:, None].expand(-1, 3, -1), laid)
    return (sums[:, :2] / sums[:, 2:].clamp_min(1e-15)).unflatten(2, (height, width))  # type: ignore[no-any-return, no-untyped-call]


def convex_upsampling(flow: Tensor, weights: Tensor) -> Tensor:
    """Upsample flow by 8: fine pixels are convex combinations of 3 x 3 coarse neighbours (paper, section 3.3).

    Args:
        flow: [N, 2, h, w], px of that size.
        weights: [N, 9 * 8 * 8, h, w], before softmax.

    Returns:
        [N, 2, 8 h, 8 w], px.
    """
    count, _, height, width = flow.shape
    share = weights.view(count, 1, 9, DOWNSCALE, DOWNSCALE, height, width).softmax(dim=2)
    near = functional.unfold(DOWNSCALE * flow, 3, padding=1).view(count, 2, 9, 1, 1, height, width)
    fine = (share * near).sum(dim=2).permute(0, 1, 4, 2, 5, 3)
    return fine.reshape(count, 2, DOWNSCALE * height, DOWNSCALE * width)


_LONG = {"c": "corr", "f": "flow"}
_RENAMED: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^module\.", ""),  # saved from DataParallel
    (r"^fnet\.", "feature_encoder."),
    (r"^cnet\.", "context_encoder."),
    (r"^(\w+_encoder)\.conv1\.", r"\1.convnormrelu.0."),
    (r"^(\w+_encoder)\.norm1\.", r"\1.convnormrelu.1."),
    (r"^(\w+_encoder)\.conv2\.", r"\1.conv."),
    (r"(layer\d\.\d)\.conv(\d)\.", r"\1.convnormrelu\2.0."),
    (r"(layer\d\.\d)\.norm(\d)\.", r"\1.convnormrelu\2.1."),
    (r"^update_block\.encoder\.conv(c|f)(\d)\.", lambda m: f"update_block.motion_encoder.conv{_LONG[m[1]]}{m[2]}.0."),
    (r"^update_block\.encoder\.conv\.", "update_block.motion_encoder.conv.0."),
    (r"^update_block\.gru\.conv([zrq])\.", r"update_block.recurrent_block.convgru1.conv\1."),
    (r"^update_block\.gru\.conv([zrq])(\d)\.", r"update_block.recurrent_block.convgru\2.conv\1."),
    (r"^update_block\.mask\.0\.", "mask_predictor.convrelu.0."),
    (r"^update_block\.mask\.2\.", "mask_predictor.conv."),
)


def torchvision_name(name: str, *, bottleneck: bool = False) -> str:
    """Return torchvision's name for a tensor of the authors' repository (princeton-vl/RAFT); its own names stay.

    The authors' blocks register the norm of their shortcut twice, as ``norm3`` (``norm4`` in bottlenecks) and as
    ``downsample.1``. Both get the same name here.
    """
    name = re.sub(rf"\.norm{4 if bottleneck else 3}\.", ".downsample.1.", name)
    for pattern, replacement in _RENAMED:
        name = re.sub(pattern, replacement, name)
    return name
