"""Compute LPIPS v0.1, the distance of two pictures in the features of an ImageNet network (Zhang et al., CVPR 2018).

Features of both pictures are taken after several ReLUs, divided by their length over the channels, subtracted and
squared. Trained non-negative weights sum them over the channels; the sum is averaged over the picture and added over
the layers:

    d(a, b) = sum_l mean_(h,w) sum_c w_lc (a_l / (|a_l| + 1e-10) - b_l / (|b_l| + 1e-10))_c^2

The weights of the network and of the heads are files of the caller; they are not downloaded. V2V trains with VGG16 and
evaluates with AlexNet.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from trainer.losses.backbones import BACKBONES
from trainer.weights import read_tensors
from v2v_protocol.errors import UsageError

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and standard deviation of ImageNet for pictures in -1 .. 1: red, green, blue."""

HEADS_FROM = "the wheel of the Python package lpips 0.1.4, lpips/weights/v0.1/{net}.pth"

LENGTH_FLOOR = 1e-10
SMALLEST_SQUARE = 1e-30


def unit_length(features: Tensor) -> Tensor:
    """Divide features, [B, C, H, W], by their length over the channels, as LPIPS defines it. Zero stays zero.

    The published |f| = sqrt(sum f^2) has an infinite derivative where all channels are 0, and infinity times the
    squares' derivative of 0 is NaN. A single such position, common after a ReLU, makes the whole gradient NaN.
    SMALLEST_SQUARE under the root makes the derivative finite. It is too small to change values: its root is at most
    1e-5 of the divisor, which includes LENGTH_FLOOR.
    """
    length = (features.square().sum(dim=1, keepdim=True) + SMALLEST_SQUARE).sqrt()
    return features / (length + LENGTH_FLOOR)


def _layer_distance(first: Tensor, second: Tensor, head: Tensor) -> Tensor:
    """Return the distance [N] from features [N, C, H, W] of both pictures and weights [C]."""
    difference = unit_length(first.to(head.dtype)) - unit_length(second.to(head.dtype))
    return (difference.square() * head[:, None, None]).sum(dim=1).mean(dim=(1, 2))


class LPIPS(nn.Module):
    """Compute the metric with frozen parameters. Gradients reach only the prediction.

    The constructor leaves the weights at their random initial values; use :meth:`from_files`.

    Args:
        net: "vgg", "alex" or "squeeze".

    Raises:
        UsageError: ``net`` is another name.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: str) -> None:
        super().__init__()
        if net not in BACKBONES:
            raise UsageError(f"LPIPS network {net!r}: give one of {', '.join(BACKBONES)}")
        self.net = net
        self.backbone = BACKBONES[net]
        self.features = nn.ModuleList(self.backbone.layers())
        for layer, channels in enumerate(self.backbone.channels):
            self.register_buffer(f"head{layer}", torch.zeros(channels))
        self.register_buffer("shift", torch.tensor(SHIFT).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(3, 1, 1))
        self.requires_grad_(False)

    @classmethod
    def from_files(cls, net: str, backbone: str | Path, heads: str | Path) -> LPIPS:
        """Create the metric with its published weights.

        Args:
            net: "vgg", "alex" or "squeeze".
            backbone: file with torchvision's state dict of that network, whole (its classifier is ignored) or
                ``features`` only.
            heads: file with the state dict ``lin0.model.1.weight`` ... of LPIPS v0.1.

        Raises:
            UsageError: a file is missing or has other tensors; the message says where to get the right one.
        """
        metric = cls(net)
        origin = metric.backbone.weights_from
        given = {
            name.removeprefix("features."): tensor
            for name, tensor in _read(backbone, f"{net} network", origin).items()
            if not name.startswith("classifier.")
        }
        _require(given, metric.features.state_dict(), backbone, origin)
        metric.features.load_state_dict(given)
        origin = HEADS_FROM.format(net=net)
        given = _read(heads, f"heads for {net}", origin)
        names = {f"lin{layer}.model.1.weight": f"head{layer}" for layer in range(len(metric.backbone.channels))}
        wanted = {name: metric.get_buffer(own)[None, :, None, None] for name, own in names.items()}
        _require(given, wanted, heads, origin)
        for name, own in names.items():
            metric.get_buffer(own).copy_(given[name].flatten())
        return metric

    def _taps(self, pictures: Tensor) -> list[Tensor]:
        x = (2 * pictures - 1 - self.shift) / self.scale  # broadcasts one channel to three
        taps = []
        for position, layer in enumerate(self.features):
            x = layer(x)
            if position in self.backbone.taps:
                taps.append(x)
        return taps

    def forward(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the distance of each picture to its target.

        Args:
            prediction: [..., C, H, W] in 0 .. 1 (not enforced), C = 1 (grey, repeated) or 3, with any number of leading
                dimensions: [B, T, 1, H, W] is one pass over B*T pictures.
            target: same shape; gets no gradient.

        Returns:
            [...], one distance per picture. Under autocast the features are in half precision, but their comparison is
            in full precision.

        Raises:
            UsageError: the shapes differ, or the pictures are too small for the network.
        """
        leading, (channels, height, width) = prediction.shape[:-3], prediction.shape[-3:]
        if prediction.shape != target.shape or channels not in (1, 3):
            raise UsageError(
                f"LPIPS of {list(prediction.shape)} and {list(target.shape)}: give equal shapes [..., 1 or 3, H, W]"
            )
        smallest = self.backbone.smallest_px
        if min(height, width) < smallest:
            raise UsageError(f"LPIPS({self.net}) of {height} x {width} pictures: give at least {smallest} x {smallest}")
        with torch.no_grad():
            target_taps = self._taps(target.reshape(-1, channels, height, width))
        taps = self._taps(prediction.reshape(-1, channels, height, width))
        with torch.autocast(prediction.device.type, enabled=False):
            distance = torch.zeros((), dtype=self.shift.dtype, device=prediction.device)
            for layer, (first, second) in enumerate(zip(taps, target_taps, strict=True)):
                # Recomputed in the backward pass: its saved tensors would be several times the size of the features.
                distance = distance + checkpoint(
                    _layer_distance,
                    first,
                    second,
                    self.get_buffer(f"head{layer}"),
                    use_reentrant=False,
                    preserve_rng_state=False,
                )
        return distance.reshape(leading)


def _read(path: str | Path, what: str, origin: str) -> dict[str, Tensor]:
    if not Path(path).is_file():
        raise UsageError(f"LPIPS {what}: no file {path}. It is not downloaded automatically; get it from {origin}")
    return read_tensors(path)


def _require(given: dict[str, Tensor], wanted: dict[str, Tensor], path: str | Path, origin: str) -> None:
    wrong = sorted(
        name
        for name in given.keys() | wanted.keys()
        if name not in given or name not in wanted or given[name].shape != wanted[name].shape
    )
    if wrong:
        raise UsageError(
            f"{path}: {len(wrong)} of {len(wanted)} LPIPS weights are missing, unknown or of another shape, first "
            f"{wrong[0]}. Get the file from {origin}"
        )
