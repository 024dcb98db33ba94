"""What a network sees, what it makes of it, and what the camera saw: as one picture a sequence, and as a video.

Panels from left to right: the events of the window (positive red, negative blue on white), the reconstruction, the
picture of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
import numpy.typing as npt

from trainer.evaluation.reconstruct import Step
from v2v_protocol.errors import UsageError

Image = npt.NDArray[np.uint8]

GAP_PX = 4
CAPTION_PX = 18
INK = (60, 60, 60)
POSITIVE = (40, 40, 214)  # BGR
NEGATIVE = (200, 96, 30)
FULL_COLOUR_QUANTILE = 0.98
FONT_SCALE = 0.4
LARGEST_TIMEBASE = 65_535
"""Denominator of the time of a frame that MPEG-4 can hold."""


def draw_events(voxels: npt.NDArray[np.float32]) -> Image:
    """A voxel grid [bins, H, W], summed over its bins, as BGR [H, W, 3]; full colour at the 98 % quantile."""
    total = voxels.sum(axis=0)
    strength = np.abs(total)
    strongest = np.quantile(strength[strength > 0], FULL_COLOUR_QUANTILE) if strength.any() else 1.0
    # The square root lifts single events out of the white.
    share = np.sqrt(np.clip(strength / strongest, 0, 1))[..., None]
    colour = np.where((total > 0)[..., None], np.array(POSITIVE, np.float32), np.array(NEGATIVE, np.float32))
    image: Image = np.rint(255 + share * (colour - 255)).astype(np.uint8)
    return image


def grey_levels(prediction: npt.NDArray[np.float32]) -> Image:
    """0 .. 1 -> uint8, to the nearest."""
    image: Image = np.rint(prediction.clip(0, 1) * 255).astype(np.uint8)
    return image


def draw_step(step: Step, origin_seconds: float, *, with_camera: bool = True) -> Image:
    """The panels side by side with a line of text below.

    Args:
        step: to draw.
        origin_seconds: what times in the text count from.
        with_camera: draw the third panel, white where there is no picture yet; False for recordings without pictures.
    """
    height, width = step.prediction.shape
    camera = np.full((height, width), 255, np.uint8) if step.camera is None else step.camera
    panels = [
        draw_events(step.voxels),
        *(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) for grey in (grey_levels(step.prediction), camera)),
    ]
    texts = [
        f"{step.events} events, {(step.window.end - step.window.begin) * 1e3:.1f} ms",
        f"reconstruction, {step.window.end - origin_seconds:.3f} s",
        "no picture" if step.camera_time is None else f"camera, {step.camera_time - origin_seconds:.3f} s",
    ]
    shown = len(panels) if with_camera else len(panels) - 1
    tiles = []
    for panel, text in zip(panels[:shown], texts[:shown], strict=True):
        tile = cv2.copyMakeBorder(panel, 0, CAPTION_PX, 0, GAP_PX, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        cv2.putText(tile, text, (2, height + 13), cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, INK, 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles)


def chosen_steps(count: int, rows: int) -> frozenset[int]:
    """``rows`` of ``count`` steps, evenly spaced; the last one among them, the first (the network starts blind) not."""
    rows = min(rows, count)
    return frozenset(int(step) for step in np.linspace(count / rows, count, rows).round() - 1)


def write_png(path: Path, rows: Sequence[Image]) -> None:
    """Rows below each other.

    Raises:
        UsageError: the folder cannot be written to.
    """
    encoded, data = cv2.imencode(".png", np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded:
        raise UsageError(f"{path}: this picture cannot be encoded as PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


def _rate(fps: float) -> float:
    """The rate with as many of OpenCV's three decimals as MPEG-4 can hold: 149.993 would be 149993 / 1000."""
    decimals = next((number for number in (3, 2, 1) if fps * 10**number <= LARGEST_TIMEBASE), 0)
    return min(round(fps, decimals), float(LARGEST_TIMEBASE))


class Video:
    """An MPEG-4 video, a frame at a time; a context manager.

    Args:
        path: to write to.
        fps: frames a second; rounded to what the format can hold (three decimals below 65.5, two below 655).

    Raises:
        UsageError: the folder cannot be written to, or the encoder does not open.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, _rate(fps)
        self._writer: cv2.VideoWriter | None = None

    def add(self, image: Image) -> None:
        """BGR [H, W, 3], every time the same size."""
        # The encoder wants even numbers.
        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), constant_values=255)
        if self._writer is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            fourcc = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._path), fourcc, self._fps, (image.shape[1], image.shape[0]))
            if not self._writer.isOpened():
                raise UsageError(f"{self._path}: the video cannot be written")
        self._writer.write(image)

    def __enter__(self) -> Video:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
