"""Warp pictures by a displacement field.

    warp(I, d)(x) = I(x + d(x))

d is defined on the grid of the result. To bring the picture at time t-1 onto the grid of time t, d is therefore the
*backward* flow (on the grid of t, pointing to where each pixel was at t-1). Negated forward flow is an approximation,
exact only where the motion does not change from pixel to pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from v2v_protocol.errors import UsageError


def sampling_points(displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Return the position (x, y) in px, each [N, H, W], that each pixel samples for a displacement [N, 2, H, W]."""
    height, width = displacement.shape[-2:]
    columns = torch.arange(width, device=displacement.device, dtype=displacement.dtype)
    rows = torch.arange(height, device=displacement.device, dtype=displacement.dtype)
    return columns + displacement[:, 0], rows[:, None] + displacement[:, 1]


def warp(pictures: Tensor, displacement: Tensor) -> Tensor:
    """Sample each picture at displaced positions: bilinear between pixel centres, 0 outside the picture.

    It computes in float32 or wider, even under autocast: half-precision coordinates are off by whole pixels.

    Args:
        pictures: [N, C, H, W].
        displacement: [N, 2, H, W], px in (x, y), y pointing down.

    Returns:
        [N, C, H, W]; gradients flow to both arguments.

    Raises:
        UsageError: the shapes do not match.
    """
    count, _, height, width = pictures.shape
    if displacement.shape != (count, 2, height, width):
        raise UsageError(
            f"displacement of shape {list(displacement.shape)} for pictures {list(pictures.shape)}: "
            f"give {[count, 2, height, width]}"
        )
    dtype = torch.promote_types(pictures.dtype, torch.float32)
    with torch.autocast(pictures.device.type, enabled=False):
        x, y = sampling_points(displacement.to(dtype))
        # align_corners=True: -1 and 1 are the centres of the first and the last pixel, W - 1 px apart.
        grid = torch.stack([x * (2 / max(width - 1, 1)) - 1, y * (2 / max(height - 1, 1)) - 1], dim=-1)
        return F.grid_sample(pictures.to(dtype), grid, mode="bilinear", padding_mode="zeros", align_corners=True)


def inside(displacement: Tensor) -> Tensor:
    """Return which pixels of the result sample a position inside the picture: bool [N, 1, H, W]."""
    height, width = displacement.shape[-2:]
    x, y = sampling_points(displacement.to(torch.promote_types(displacement.dtype, torch.float32)))
    return ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).unsqueeze(1)
