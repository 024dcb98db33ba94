"""Define the inputs of the RAFT comparison: two pictures, and weights from a formula instead of a file."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from skimage import data
from torch import Tensor

HEIGHT, WIDTH = 130, 141
"""Not multiples of 8: padding matters."""
SAMPLED = (slice(None), slice(None), slice(3, None, 9), slice(1, None, 9))
"""The part of a flow that the recording keeps."""


def pictures() -> tuple[Tensor, Tensor]:
    """[2, 1, H, W] in 0 .. 1: two parts of a photograph that move by (6, -4) and (-3, 2) px."""
    photograph = np.array(data.camera(), np.uint8)

    def part(top: int, left: int) -> np.ndarray:
        return photograph[top : top + HEIGHT, left : left + WIDTH]

    pairs = np.stack([[part(100, 150), part(104, 144)], [part(210, 250), part(208, 253)]])
    pairs = pairs[:, :, None].astype(np.float32) / 255
    return torch.from_numpy(pairs[:, 0].copy()), torch.from_numpy(pairs[:, 1].copy())


def formula_weights(like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return numbers for every entry of a state dict, spread over -1 .. 1 by multiples of the golden ratio (mod 1).

    They are scaled so that activations shrink slightly from layer to layer, which keeps rounding errors from growing.
    """
    made = {}
    for number, (name, value) in enumerate(like.items()):
        turns = (np.arange(1, value.numel() + 1, dtype=np.float64) * 0.6180339887498949 + number * 0.37) % 1.0
        spread = torch.from_numpy(2 * turns - 1).reshape(value.shape)
        if name.endswith("num_batches_tracked"):
            made[name] = torch.zeros_like(value)
        elif value.ndim == 4:
            made[name] = (spread * (4.0 / value[0].numel()) ** 0.5).to(value.dtype)
        elif name.endswith(("running_var", "1.weight")):
            made[name] = (1.0 + 0.5 * spread).to(value.dtype)
        else:
            made[name] = (0.1 * spread).to(value.dtype)
    return made
