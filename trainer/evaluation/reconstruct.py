"""Run a network over the windows of a recording.

The network's memory starts at zero before the first window and is kept until the last, as in the published test code.
There is no warm-up before the first window.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from skimage.exposure import equalize_hist

from trainer.evaluation.readers import EventWindow, RecordedImage, Recording
from trainer.evaluation.voxelise import VoxelSettings, voxel_grid
from trainer.models import VoxelNetwork
from v2v_protocol.errors import UsageError

Stretch = Literal["none", "min-max", "robust", "equalized"]
WINDOWS_PER_CALL = 8
"""Windows in one call of the network. It bounds the memory of activations, and does not change the result."""


@dataclass(frozen=True, eq=False)
class Step:
    """Hold the reconstruction of one window.

    Attributes:
        window: the window.
        events: number of its events.
        voxels: float32 [bins, H, W].
        prediction: float32 [H, W], clamped to 0 .. 1.
        camera: uint8 [H, W], the picture at the end of the window, or else the latest one before; None before the first
            picture.
        camera_time: time of that picture, in s.
    """

    window: EventWindow
    events: int
    voxels: npt.NDArray[np.float32]
    prediction: npt.NDArray[np.float32]
    camera: npt.NDArray[np.uint8] | None
    camera_time: float | None


def reconstruct(
    recording: Recording,
    windows: Sequence[EventWindow],
    network: VoxelNetwork,
    settings: VoxelSettings,
    *,
    device: str = "cpu",
    stretch: Stretch = "none",
) -> Iterator[Step]:
    """Yield one step for each window, in order.

    Events do not determine absolute brightness, so some authors map the values of each picture to 0 .. 1 before scoring
    it. ``stretch`` "min-max" maps from the minimum and maximum, "robust" from the 1st and 99th percentile, "equalized"
    by histogram equalisation with 256 values; "none" does not map.

    Raises:
        UsageError: the network has another number of bins, events lie outside the sensor, or the output is not finite.
    """
    if network.bins != settings.bins:
        raise UsageError(f"voxels have {settings.bins} bins, but the network takes {network.bins}")
    network = network.to(device).eval()
    state = None
    for first in range(0, len(windows), WINDOWS_PER_CALL):
        piece = windows[first : first + WINDOWS_PER_CALL]
        counts, grids = [], []
        for window in piece:
            events = recording.events(window)
            counts.append(len(events))
            grids.append(voxel_grid(events, recording.size, settings, (window.begin, window.end)))
        with torch.inference_mode():
            pictures, state = network(torch.from_numpy(np.stack(grids))[None].to(device), state)
        predictions = pictures[0, :, 0].float().cpu().numpy()
        if not np.isfinite(predictions).all():
            raise UsageError(
                f"{recording.path}: the network's output is not finite in windows {first} to "
                f"{first + len(piece) - 1}; check its weights, and whether its input is normalised as in training"
            )
        for window, count, grid, prediction in zip(piece, counts, grids, _stretch(predictions, stretch), strict=True):
            shown = window.target or _latest(recording.images, window.end)
            yield Step(
                window,
                count,
                grid,
                prediction,
                None if shown is None else recording.image(shown),
                None if shown is None else shown.time,
            )


def _stretch(pictures: npt.NDArray[np.float32], stretch: Stretch) -> npt.NDArray[np.float32]:
    """Map the values of each picture of [N, H, W] by ``stretch``, then clamp them to 0 .. 1."""
    if stretch == "equalized":
        equal = [equalize_hist(picture.clip(0, 1)) for picture in pictures]  # type: ignore[no-untyped-call]
        return np.stack(equal).astype(np.float32)
    if stretch != "none":
        ends = (0, 100) if stretch == "min-max" else (1, 99)
        low, high = np.percentile(pictures, ends, axis=(1, 2), keepdims=True)
        pictures = ((pictures - low) / np.maximum(high - low, 1e-6)).astype(np.float32)
    return pictures.clip(0, 1)


def _latest(images: Sequence[RecordedImage], time: float) -> RecordedImage | None:
    """Return the last picture that is not later than ``time``; None before the first."""
    position = bisect.bisect_right(images, time, key=lambda image: image.time)
    return images[position - 1] if position else None
