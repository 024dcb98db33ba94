"""Drawing: events, grey pictures and flow as colour images, side by side, as PNG and as video. Images are RGB.

Events are drawn as the sum over the bins of a voxel grid: red for more ON, blue for more OFF, white for none. Flow has
the colour of its direction, the stronger the longer; white is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

ON = (214, 40, 40)
OFF = (30, 96, 200)
GAP_PX = 4
SMALLEST_TILE_PX = 128
FULL_COLOUR_QUANTILE = 0.98
CODEC = "vp09"
"""VP9: the one codec of OpenCV's wheels that browsers show too."""

Image = npt.NDArray[np.uint8]


def draw_events(voxels: npt.NDArray[np.generic]) -> Image:
    """[..., bins, H, W] signed counts -> [..., H, W, 3]; full colour from the 98th percentile on."""
    counts = voxels.astype(np.float32).sum(axis=-3)
    strength = np.abs(counts)
    strongest = np.quantile(strength[strength > 0], FULL_COLOUR_QUANTILE) if strength.any() else 1.0
    share = np.sqrt(np.clip(strength / strongest, 0, 1))[..., None]  # the root lifts single events out of the white
    colour = np.where((counts > 0)[..., None], np.array(ON, np.float32), np.array(OFF, np.float32))
    drawn: Image = np.rint(255 + share * (colour - 255)).astype(np.uint8)
    return drawn


def draw_grey(pictures: npt.NDArray[np.floating]) -> Image:
    """[..., H, W] in 0 .. 1 (clipped) -> [..., H, W, 3]."""
    grey = np.rint(np.clip(pictures, 0, 1) * 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def flow_scale(flow: npt.NDArray[np.floating]) -> float:
    """The length in px, not 0, that is drawn in full colour."""
    return max(float(np.quantile(np.hypot(flow[..., 0, :, :], flow[..., 1, :, :]), FULL_COLOUR_QUANTILE)), 0.1)


def draw_flow(flow: npt.NDArray[np.floating], scale: float) -> Image:
    """[..., 2, H, W] (x, y) px -> [..., H, W, 3]; full colour from ``scale`` on."""
    x, y = flow[..., 0, :, :], flow[..., 1, :, :]
    # Three cosines a third of a turn apart: red points right, green down and to the left, blue up and to the left.
    turns = np.arctan2(y, x)[..., None] - np.array([0.0, 2.0, 4.0]) * np.pi / 3
    share = np.clip(np.hypot(x, y) / scale, 0, 1)[..., None]
    drawn: Image = np.rint(255 * (1 - share * (0.5 - 0.5 * np.cos(turns)))).astype(np.uint8)
    return drawn


def side_by_side(panels: Sequence[Image]) -> Image:
    """Films [T, H, W, 3] as one; small ones are enlarged by a whole factor."""
    factor = max(1, -(-SMALLEST_TILE_PX // min(panels[0].shape[1:3])))
    tiles = [panel.repeat(factor, axis=1).repeat(factor, axis=2) for panel in panels]
    edge = ((0, 0), (0, GAP_PX), (0, GAP_PX), (0, 0))
    return np.concatenate([np.pad(tile, edge, constant_values=255) for tile in tiles], axis=2)


def contact_sheet(film: Image, steps: int = 5) -> Image:
    """[T, height, width, 3] -> [steps * height, width, 3]: evenly spaced times below each other, the last included."""
    picks = np.unique(np.linspace(0, len(film) - 1, steps + 1).round().astype(int)[1:])
    return np.concatenate(list(film[picks]), axis=0)


def write_png(path: Path, image: Image) -> None:
    """
    Raises:
        UsageError: the folder cannot be written to.
    """
    encoded, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded:
        raise UsageError(f"{path}: a picture of shape {list(image.shape)} cannot be encoded as PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


class Video:
    """An MP4 video (VP9), a frame at a time; a context manager.

    Args:
        path: to write to.
        fps: frames a second.

    Raises:
        UsageError: the folder cannot be written to, or OpenCV was built without the codec.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._writer: cv2.VideoWriter | None = None

    def add(self, image: Image) -> None:
        """[H, W, 3], every time the same size."""
        # Colour is stored at half the size: the encoder wants even numbers.
        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), constant_values=255)
        if self._writer is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            size = (image.shape[1], image.shape[0])
            self._writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*CODEC), self._fps, size)
            if not self._writer.isOpened():
                raise UsageError(f"{self._path}: OpenCV cannot write a video ({CODEC}) there")
        self._writer.write(np.ascontiguousarray(image[..., ::-1]))

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._writer is not None:
            self._writer.release()
