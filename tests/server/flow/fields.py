"""Cameras without chance, and pictures that move by whole pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from skimage import data

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams

RECIPE = Recipe(voxels_per_clip=4, bins=2, crop_height_px=64, crop_width_px=80)
"""Eight steps; a voxel spans two."""


_PLAIN = SampleParams(
    threshold_pos=0.2, threshold_neg=0.2, noise_sigma=0.0, hot_pixel_count=0, hot_pixel_sigma=0.0, pauses=(),
    scale=1.0, crop_top_px=0, crop_left_px=0, flip=False, contrast=0.0, noise_key=(0, 0, 0, 0),
)  # fmt: skip


def camera_params(**changes: Any) -> SampleParams:
    """A virtual camera that sees the picture as it is; ``changes`` are fields of it."""
    return replace(_PLAIN, **changes)


def panned(count: int, height: int, width: int, right: int, down: int) -> np.ndarray:
    """[count, height, width] uint8: what the photograph shows moves by (right, down) whole pixels a frame."""
    picture = np.array(data.camera(), np.uint8)
    rows = 150 - down * np.arange(count)
    columns = 150 - right * np.arange(count)
    return np.stack([picture[y : y + height, x : x + width] for y, x in zip(rows, columns, strict=True)])
