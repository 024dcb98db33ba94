"""Draw a network's input, its reconstruction and the camera's picture side by side.

Panels from left to right: the events of the window (positive red, negative blue on white), the reconstruction, the
picture of the camera.
"""

from __future__ import annotations

import cv2
import numpy as np

from trainer.evaluation.reconstruct import Step
from trainer.pictures import GAP_PX, Image, draw_events, draw_grey

CAPTION_PX = 18
INK = (60, 60, 60)
FONT_SCALE = 0.4


def draw_step(step: Step, origin_seconds: float, *, with_camera: bool = True) -> Image:
    """Draw the panels side by side, with a line of text below each.

    Args:
        origin_seconds: origin of the times in the text.
        with_camera: whether to draw the third panel, white before the first picture; False for recordings without
            pictures.
    """
    height, width = step.prediction.shape
    camera = np.ones((height, width)) if step.camera is None else step.camera / 255
    panels = [draw_events(step.voxels), draw_grey(step.prediction), draw_grey(camera)]
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


def choose_steps(count: int, rows: int) -> frozenset[int]:
    """Choose ``rows`` of ``count`` evenly spaced steps: with the last, without the first (memory is empty there)."""
    rows = min(rows, count)
    return frozenset(int(step) for step in np.linspace(count / rows, count, rows).round() - 1)
