"""Class masks beside the video, as the camera sees them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.labels import numbered_files, read_mask, view_mask
from v2v_server.worker.arrays.context import SampleContext, makes, only_sidecar


@makes("masks")
def masks(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the class mask of each delivered frame, [T, 1, H, W]."""
    files = numbered_files(only_sidecar("masks", context.video, context.clip.sidecars)[1], ".png")
    view: Callable[[int], npt.NDArray[np.uint8]] = lru_cache(maxsize=1)(lambda frame: _mask(context, files, frame))
    for target, frame in zip(out[:, 0], context.target_frames, strict=True):
        target[...] = view(frame)  # a paused camera repeats its frame


def _mask(context: SampleContext, files: dict[int, Traversable], frame: int) -> npt.NDArray[np.uint8]:
    if frame not in files:
        raise ValueError(f"has no file of frame {frame}: add one")
    mask = read_mask(files[frame], context.clip.picture_px)
    return view_mask(mask, context.clip.usable, context.params, context.recipe)
