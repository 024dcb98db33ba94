"""Draw films of events, grey pictures and flow side by side, as PNG and as video. Images are RGB.

Events are drawn as the sum over the bins of a voxel grid, in the colours of :mod:`v2v_pictures.colours`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from v2v_pictures import colours, files
from v2v_pictures.canvas import SOFT, Canvas
from v2v_protocol.errors import UsageError

PANEL_GAP_PX = 4
SMALLEST_TILE_PX = 128
LEAST_COUNT = 1e-3
"""Smaller sums are rounding errors of interpolated events that cancel, and are drawn as 0."""
FULL_COLOUR_QUANTILE = 0.98
CODEC = "vp09"
"""VP9, the only codec in OpenCV's wheels that browsers also play."""

EVENTS = "events"
"""The name of a panel of events."""
_TITLE_PX, _NAMES_PX, _TIME_PX, _SMALL_PT = 40, 42, 44, 13

Image = npt.NDArray[np.uint8]
"""[..., h, w, 3] uint8, RGB."""


def draw_events(voxels: npt.NDArray[np.generic]) -> Image:
    """Draw signed counts [..., bins, H, W] as [..., H, W, 3], all in one scale."""
    counts = voxels.astype(np.float32).sum(axis=-3)
    counts[np.abs(counts) < LEAST_COUNT] = 0
    return colours.draw_events(counts, colours.full_colour([counts]))


def draw_grey(pictures: npt.NDArray[np.floating]) -> Image:
    """Draw grey values [..., H, W] in 0 .. 1 (clipped) as [..., H, W, 3]."""
    return colours.draw_grey(pictures)


def flow_scale(flow: npt.NDArray[np.floating]) -> float:
    """Return the length of flow, [..., 2, H, W], that is drawn in full colour, in px, at least 0.1."""
    return max(float(np.quantile(np.hypot(flow[..., 0, :, :], flow[..., 1, :, :]), FULL_COLOUR_QUANTILE)), 0.1)


def draw_flow(flow: npt.NDArray[np.floating], scale: float) -> Image:
    """Draw flow [..., 2, H, W] (x, y) px as [..., H, W, 3], with full colour at ``scale`` px and darker beyond it."""
    fields = flow.reshape(-1, *flow.shape[-3:])
    drawn = np.stack([colours.draw_flow(field, scale) for field in fields])
    return drawn.reshape(*flow.shape[:-3], *drawn.shape[1:])


def side_by_side(panels: Sequence[Image]) -> Image:
    """Join films [T, H, W, 3] side by side. Small ones are enlarged by an integer factor."""
    factor = max(1, -(-SMALLEST_TILE_PX // min(panels[0].shape[1:3])))
    tiles = [panel.repeat(factor, axis=1).repeat(factor, axis=2) for panel in panels]
    edge = ((0, 0), (0, PANEL_GAP_PX), (0, PANEL_GAP_PX), (0, 0))
    return np.concatenate([np.pad(tile, edge, constant_values=255) for tile in tiles], axis=2)


def contact_sheet(film: Image, steps: int = 5) -> Image:
    """Stack ``steps`` evenly spaced frames of a film [T, height, width, 3] vertically, including the last.

    Returns:
        [steps * height, width, 3], or [T * height, width, 3] if the film has fewer frames.
    """
    picks = np.unique(np.linspace(0, len(film) - 1, steps + 1).round().astype(int)[1:])
    return np.concatenate(list(film[picks]), axis=0)


def add_header(picture: Image, panels: Sequence[str], title: str = "", *, time_runs_down: bool = False) -> Image:
    """Add the names of a picture's equally wide columns above it, and a legend of the events' colours.

    Args:
        picture: [height, width, 3], as returned by :func:`side_by_side` and :func:`contact_sheet`.
        panels: names of its columns; if empty, the picture is returned unchanged.
        title: title above the names; "" for none.
        time_runs_down: whether to draw an arrow labelled "time" on the left.

    Returns:
        [height + header, width + margin, 3] uint8.
    """
    if not panels:
        return picture
    left, top = (_TIME_PX if time_runs_down else 0), _NAMES_PX + (_TITLE_PX if title else 0)
    height, width = picture.shape[:2]
    page = Canvas(left + width, top + height)
    if title:
        page.title(4, 4, title)
    for number, name in enumerate(panels):
        x = left + number * width / len(panels) + 2
        page.text(x, top - _NAMES_PX, name)
        if name == EVENTS:
            end = page.text(x, top - _NAMES_PX + 20, "brighter", colour=colours.BRIGHTER, size=_SMALL_PT)
            page.text(end + 6, top - _NAMES_PX + 20, "darker", colour=colours.DARKER, size=_SMALL_PT)
    if time_runs_down:
        page.text(2, top, "time", colour=SOFT)
        page.vector(left / 2, top + 26, 0, height - 34)
    drawn = page.image()
    drawn[top:, left:] = picture
    return drawn


def write_png(path: Path, image: Image) -> None:
    """Write an image as PNG and create missing folders.

    Raises:
        UsageError: the folder cannot be written to.
    """
    _make_folder(path)
    files.write_png(path, image)


def _make_folder(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error


class Video:
    """Write an MP4 video (VP9) frame by frame, as a context manager.

    Args:
        path: file to write.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, fps
        self._writer: cv2.VideoWriter | None = None

    def add(self, image: Image) -> None:
        """Append a frame [H, W, 3]. All frames must have the same size.

        Raises:
            UsageError: the folder cannot be written to, or OpenCV was built without the codec.
        """
        # Colour is stored at half resolution, so the encoder needs even sizes.
        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), constant_values=255)
        if self._writer is None:
            _make_folder(self._path)
            size = (image.shape[1], image.shape[0])
            self._writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*CODEC), self._fps, size)
            if not self._writer.isOpened():
                raise UsageError(f"{self._path}: OpenCV cannot write a video there with codec {CODEC}")
        self._writer.write(np.ascontiguousarray(image[..., ::-1]))

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._writer is not None:
            self._writer.release()
