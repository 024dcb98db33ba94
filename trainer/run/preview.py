"""What the network sees, should see and makes of it, side by side: a picture of some time steps, and a video of all.

Events are drawn as the sum over the bins of a voxel grid: red for more ON, blue for more OFF, white for none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from trainer.models import ReconstructionNetwork
from v2v_client import Batch
from v2v_protocol.errors import UsageError

ON = (214, 40, 40)  # RGB
OFF = (30, 96, 200)
GAP_PX = 4
SMALLEST_TILE_PX = 128
FRAMES_PER_SECOND = 8
CODEC = "vp09"
"""VP9: the one codec of OpenCV's wheels that browsers show too."""

Image = npt.NDArray[np.uint8]


def draw_events(voxels: npt.NDArray[Any]) -> Image:
    """[..., bins, H, W] signed counts -> [..., H, W, 3] uint8 RGB; full colour from the 98th percentile on."""
    counts = voxels.astype(np.float32).sum(axis=-3)
    strength = np.abs(counts)
    strongest = np.quantile(strength[strength > 0], 0.98) if strength.any() else 1.0
    share = np.sqrt(np.clip(strength / strongest, 0, 1))[..., None]  # the root lifts single events out of the white
    colour = np.where((counts > 0)[..., None], np.array(ON, np.float32), np.array(OFF, np.float32))
    drawn: Image = (255 + share * (colour - 255)).round().astype(np.uint8)
    return drawn


def draw_pictures(pictures: npt.NDArray[np.floating]) -> Image:
    """[..., 1, H, W] in 0 .. 1 (clipped) -> [..., H, W, 3] uint8."""
    grey = (np.clip(pictures[..., 0, :, :], 0, 1) * 255).round().astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def side_by_side(
    voxels: npt.NDArray[Any], target: npt.NDArray[np.floating], prediction: npt.NDArray[np.floating]
) -> Image:
    """One clip as a film of events, target and reconstruction.

    Args:
        voxels: [T, bins, H, W].
        target, prediction: [T, 1, H, W] in 0 .. 1.

    Returns:
        [T, height, width, 3] uint8 RGB; small pictures are enlarged by a whole factor.
    """
    factor = max(1, -(-SMALLEST_TILE_PX // min(target.shape[-2:])))
    tiles = [draw_events(voxels), draw_pictures(target), draw_pictures(prediction)]
    tiles = [tile.repeat(factor, axis=1).repeat(factor, axis=2) for tile in tiles]
    return np.concatenate([_framed(tile) for tile in tiles], axis=2)


@torch.no_grad()
def films(network: ReconstructionNetwork, batch: Batch, device: torch.device) -> list[Image]:
    """What a network makes of each sample of a batch that lies on the CPU: films of :func:`side_by_side`."""
    training = network.training
    network.eval()
    voxels, frames = batch.arrays["voxels"], batch.arrays["frames"]
    prediction = network.forward_sequence(voxels.to(device)).float().cpu()
    network.train(training)
    return [
        side_by_side(*arrays)
        for arrays in zip(voxels.numpy(), (frames / 255.0).numpy(), prediction.numpy(), strict=True)
    ]


def contact_sheet(film: Image, steps: int = 5) -> Image:
    """[T, height, width, 3] -> [steps * height, width, 3]: evenly spaced times below each other, the last included."""
    picks = np.unique(np.linspace(0, len(film) - 1, steps + 1).round().astype(int)[1:])
    return np.concatenate(list(film[picks]), axis=0)


def write_png(path: Path, image: Image) -> None:
    """Write an RGB picture.

    Raises:
        UsageError: the folder cannot be written to.
    """
    encoded, data = cv2.imencode(".png", image[..., ::-1])
    if not encoded:
        raise UsageError(f"{path}: a picture of shape {list(image.shape)} cannot be encoded as PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def write_video(path: Path, film: Image, frames_per_second: float = FRAMES_PER_SECOND) -> None:
    """Write [T, height, width, 3] uint8 RGB as MP4.

    Raises:
        UsageError: OpenCV cannot write there, or was built without the codec.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    even = film[:, : film.shape[1] // 2 * 2, : film.shape[2] // 2 * 2]  # colour is stored at half the size
    size = (even.shape[2], even.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), frames_per_second, size)
    try:
        if not writer.isOpened():
            raise UsageError(f"{path}: OpenCV cannot write {CODEC} there; run.preview_every = 0 does without previews")
        for image in even:
            writer.write(np.ascontiguousarray(image[..., ::-1]))
    finally:
        writer.release()


def _framed(tiles: Image) -> Image:
    return np.pad(tiles, ((0, 0), (0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255)
