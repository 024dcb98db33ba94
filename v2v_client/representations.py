"""Convert arrays of a batch to the inputs of other networks; leading dimensions, such as [B, T], are kept.

stacked_histogram(batch.event_counts)  # [B, T, 2 bins, H, W]
event_count_image(batch.event_counts)  # [B, T, 2, H, W]
exponential_surface(batch.time_surface, 0.05)  # [B, T, 2, bins, H, W]
normalised(batch.voxels)  # [B, T, bins, H, W]
"""

from __future__ import annotations

import torch

_ROUNDING = 1e-5
"""Deviation, as a share of the mean, that the rounding of float32 may give equal values."""


def stacked_histogram(event_counts: torch.Tensor, cutoff: int | None = None) -> torch.Tensor:
    """Return RVT's stacked histogram: the negative bins, then the positive ones, as channels.

    Gehrig and Scaramuzza, "Recurrent Vision Transformers for Object Detection with Event Cameras", CVPR 2023.

    Args:
        event_counts: [..., 2, bins, H, W], the array of that name.
        cutoff: larger counts become this; None leaves them.

    Returns:
        [..., 2 * bins, H, W] in the dtype of the counts; without a cutoff a view of them.
    """
    counts = event_counts if cutoff is None else event_counts.clamp(max=cutoff)
    return counts.flatten(-4, -3)


def event_count_image(event_counts: torch.Tensor) -> torch.Tensor:
    """Return the negative (0) and positive (1) events of each pixel and voxel grid.

    Args:
        event_counts: [..., 2, bins, H, W], the array of that name.

    Returns:
        [..., 2, H, W], int32, or float32 for counts of that dtype.
    """
    return event_counts.sum(-3, dtype=torch.float32 if event_counts.is_floating_point() else torch.int32)


def exponential_surface(time_surface: torch.Tensor, time_constant: float) -> torch.Tensor:
    """Return exp(-age / time_constant): 1 at an event, 0 where there was none.

    Lagorce et al., "HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern Recognition", TPAMI 2017.

    Args:
        time_surface: [..., 2, bins, H, W], the array of that name, ages in seconds.
        time_constant: seconds, above 0.

    Returns:
        float32 of the same shape, 0 to 1.
    """
    return time_surface.float().div(-time_constant).exp()


def normalised(voxels: torch.Tensor) -> torch.Tensor:
    """Return voxel grids of mean 0 and standard deviation 1 over the entries that are not zero, as E2VID takes them.

    Rebecq et al., "High Speed and High Dynamic Range Video with an Event Camera", TPAMI 2021. Zeros stay zeros. Where
    all other entries are equal, they become 0.

    Args:
        voxels: [..., bins, H, W], ``voxels`` or ``voxels_bilinear``.

    Returns:
        float32 of the same shape.
    """
    values, grid = voxels.float(), (-3, -2, -1)
    is_set = values != 0
    count = is_set.sum(grid, keepdim=True).clamp(min=1)
    mean = values.sum(grid, keepdim=True) / count
    centred = torch.where(is_set, values - mean, 0.0)
    deviation = (centred.square().sum(grid, keepdim=True) / count).sqrt()
    return torch.where(deviation > _ROUNDING * mean.abs(), centred / deviation, 0.0)
