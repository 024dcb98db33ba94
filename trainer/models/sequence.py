"""What every reconstruction network shares: voxel sequences in, image sequences out, memory handed in and out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from v2v_protocol.errors import UsageError


def normalize_voxels(voxels: Tensor) -> Tensor:
    """Shift and scale the non-zero values of each voxel grid to mean 0 and (population) standard deviation 1.

    Zeros stay zeros. A grid without events, or with one value only, becomes all zeros or stays finite (the deviation is
    taken as at least 1e-6). The rule under which E2VID (Rebecq et al. 2019) and FireNet (Scheerlinck et al. 2020) were
    trained; V2V and the "+" networks take the counts as they are. Nothing here waits for the device.

    Args:
        voxels: [N, bins, H, W], floating point.
    """
    occupied = voxels != 0
    count = occupied.sum(dim=(1, 2, 3), keepdim=True).clamp_min(1)
    mean = voxels.sum(dim=(1, 2, 3), keepdim=True) / count
    centred = torch.where(occupied, voxels - mean, 0.0)
    deviation = (centred.square().sum(dim=(1, 2, 3), keepdim=True) / count).sqrt()
    return centred / deviation.clamp_min(1e-6)


class ReconstructionNetwork(nn.Module):
    """A recurrent network from voxel grids to grey pictures. Subclasses give :meth:`unroll`.

    The memory is a value: it goes in as ``state`` and comes out again, and the module keeps nothing between calls. None
    is the state after a reset (zeros). Calls on pieces of a sequence, each given the state that the one before
    returned, equal one call on the whole.

    ``forward`` takes the whole sequence, so that wrappers which hook into it (DistributedDataParallel) see one call per
    training step. Memory of the activations is proportional to T: evaluate long recordings in short pieces.

    Attributes:
        bins: bins of a voxel grid.
        size_multiple: height and width are padded with zeros at the bottom and the right to a multiple of this.
        normalizes: True puts every voxel grid through :func:`normalize_voxels` first.
    """

    def __init__(self, *, bins: int, size_multiple: int, normalizes: bool) -> None:
        super().__init__()
        self.bins = bins
        self.size_multiple = size_multiple
        self.normalizes = normalizes

    def unroll(self, x: Tensor, state: Any, steps: int) -> tuple[Tensor, Any]:
        """
        Args:
            x: voxel grids [T*B, bins, H, W], time-major, H and W multiples of ``size_multiple``.
            state: memory before the first step.
            steps: T.

        Returns:
            Pictures [T*B, 1, H, W] and the memory after the last step.
        """
        raise NotImplementedError

    def forward(self, voxels: Tensor, state: Any = None) -> tuple[Tensor, Any]:
        """Reconstruct a piece of a sequence.

        Args:
            voxels: [B, T, bins, H, W], any dtype (int8 counts as they come from the stream are converted here, on the
                device); not normalised.
            state: what the call on the piece before returned, or None at the start of a sequence.

        Returns:
            Pictures [B, T, 1, H, W], nominally in [0, 1] but not clamped, in the dtype of the weights (also under
            autocast); and the state after the last step.

        Raises:
            UsageError: another shape.
        """
        if voxels.ndim != 5 or voxels.shape[2] != self.bins or 0 in voxels.shape:
            raise UsageError(
                f"voxels of shape {list(voxels.shape)}: this network takes [B, T, {self.bins}, H, W], none of them 0"
            )
        batch, steps, _, height, width = voxels.shape
        below, right = -height % self.size_multiple, -width % self.size_multiple
        x = F.pad(voxels.transpose(0, 1).flatten(0, 1), (0, right, 0, below))
        x = x.to(next(self.parameters()).dtype)
        if self.normalizes:
            x = normalize_voxels(x)
        pictures, state = self.unroll(x, state, steps)
        return torch.unflatten(pictures[..., :height, :width], 0, (steps, batch)).transpose(0, 1), state

    def forward_sequence(self, voxels: Tensor) -> Tensor:
        """Reconstruct whole sequences from the state after a reset: [B, T, bins, H, W] -> [B, T, 1, H, W]."""
        pictures: Tensor = self(voxels)[0]
        return pictures


def predict(layer: nn.Module, x: Tensor) -> Tensor:
    """The last, 1x1 convolution, outside autocast: a bfloat16 picture would have steps of 1/256 near white."""
    with torch.autocast(x.device.type, enabled=False):
        picture: Tensor = layer(x.to(next(layer.parameters()).dtype))
        return picture
